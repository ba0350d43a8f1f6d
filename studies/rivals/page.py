"""Tables of report.md: what each method or part gives, with intervals by drive and over trainings.

They are made from the differences that `dsrc benchmark` wrote beside the report; `studies.rivals.train QUESTION --docs
studies/rivals/report.md` brings these there, and then runs this.

Usage:
    python -m studies.rivals.page
"""

import argparse
import csv
import math
from pathlib import Path

from scipy import stats

from dsrc.evaluation.metrics.intervals import LEVEL, Difference, Interval
from dsrc.evaluation.results import CLEAN, MEAN_CORRUPTED
from dsrc.tables.document import replace_block
from dsrc.tables.table import Column, Strong, Table, TableRow
from studies.rivals.questions import QUESTIONS

PAGE = Path(__file__).with_name("report.md")
SHOWN = (
    ("published, AP@0.5", "differences_paper", MEAN_CORRUPTED, 0.5),
    ("published, AP@0.7", "differences_paper", MEAN_CORRUPTED, 0.7),
    ("ours, AP@0.5", "differences", MEAN_CORRUPTED, 0.5),
    ("ours, AP@0.7", "differences", MEAN_CORRUPTED, 0.7),
    ("clean, AP@0.5", "differences", CLEAN, 0.5),
    ("clean, AP@0.7", "differences", CLEAN, 0.7),
)
"""Columns: title, file, condition and overlap."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    for question in QUESTIONS:
        for folder in sorted(PAGE.with_suffix("").glob(f"{question}/*/differences.csv")):
            replace_block(PAGE, f"{question}_gains", gains(folder.parent).markdown())
            print(f"{PAGE}: {question}")


def read_differences(path: Path) -> dict[tuple[str, str, str, float], tuple[Difference, int]]:
    """Differences of a file with their numbers of pairs of trainings, by method, baseline, condition and overlap."""
    texts = ("method", "baseline", "condition", "resolved", "seeds")
    found = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            values = {key: float(value) if value else None for key, value in row.items() if key not in texts}
            one = Difference.of_listed({key: row[key] for key in texts} | values)
            found[one.method, one.baseline, one.condition, one.iou] = one, len(row["seeds"].split())
    return found


def over_trainings(one: Difference, pairs: int) -> Interval:
    """Interval of a difference over pairs of trainings: Student's t; unknown with fewer than two pairs."""
    if pairs < 2 or math.isnan(one.value.spread):
        return Interval(math.nan, math.nan)
    half = float(stats.t.ppf(0.5 + LEVEL / 2.0, pairs - 1)) * one.value.spread / pairs**0.5
    return Interval(one.value.mean - half, one.value.mean + half)


def gains(folder: Path) -> Table:
    """Table of the differences of a benchmark: a row per pair of methods.

    A cell has the difference, its interval by drive in brackets and that over trainings in parentheses; bold where both
    exclude 0.
    """
    files = {name: read_differences(folder / f"{name}.csv") for name in {name for _, name, _, _ in SHOWN}}
    pairs = dict.fromkeys((method, baseline) for method, baseline, _, _ in files["differences"])
    rows = [
        TableRow(
            f"{method} − {baseline}",
            tuple(_cell(*files[name][method, baseline, kind, iou]) for _, name, kind, iou in SHOWN),
        )
        for method, baseline in pairs
    ]
    return Table("gains", "", "difference", tuple(Column(title) for title, *_ in SHOWN), tuple(rows))


def _cell(one: Difference, pairs: int) -> str:
    trained = over_trainings(one, pairs)
    text = f"{100 * one.value.mean:+.1f} {one.by_drive.points}"
    if math.isnan(trained.low):
        return text
    text += f" ({trained.points[1:-1]})"
    return Strong(text) if one.by_drive.excludes_zero and trained.excludes_zero else text


if __name__ == "__main__":
    main()
