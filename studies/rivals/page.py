"""Tables of report.md: what each method or part gives, with intervals by drive and over trainings.

They are made from the differences that `dsrc benchmark` wrote beside the report, where `studies.rivals.train QUESTION
--docs studies/rivals/report.md` brings them.

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
from studies.look import COLORS, FAINT, HIGHLIGHT, new_figure, save, style
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
TITLES = {
    "rivals": "DSRC and its rivals",
    "lengths": "DSRC after trainings of three lengths",
    "parts": "What each factor gives",
    "scale": "At the paper's size",
}
"""Titles of the figures."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    found = {question: sorted(PAGE.with_suffix("").glob(f"{question}/*/differences.csv")) for question in QUESTIONS}
    if not any(found.values()):
        raise SystemExit(f"{PAGE}: no results beside it; studies.rivals.train --docs brings them")
    for question, files in found.items():
        for file in files:
            replace_block(PAGE, f"{question}_gains", gains(file.parent).markdown())
            draw(file.parent, TITLES[question])
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

    A cell has the difference, its interval by drive in brackets and that over trainings in parentheses; bold where it
    is resolved.
    """
    files = {name: read_differences(folder / f"{name}.csv") for name in {name for _, name, _, _ in SHOWN}}
    rows = [
        TableRow(
            f"{method} − {baseline}",
            tuple(_cell(*files[name][method, baseline, kind, iou]) for _, name, kind, iou in SHOWN),
        )
        for method, baseline in pairs_of(folder)
    ]
    return Table("gains", "", "difference", tuple(Column(title) for title, *_ in SHOWN), tuple(rows))


def draw(folder: Path, about: str) -> Path:
    """Draw the differences at an overlap of 0.7 in the mean of the corruptions, with both intervals."""
    panels = [column for column in SHOWN if column[2:] == (MEAN_CORRUPTED, 0.7)]
    with style():
        pairs = pairs_of(folder)
        note = (
            "Points of AP@0.7, mean of six corruptions. Thick: 95 % by drive; thin: over trainings; orange: beyond both"
        )
        figure = new_figure(9.5, 1.5 + 0.27 * len(pairs), about, note)
        for axes, (title, name, kind, iou) in zip(figure.subplots(1, len(panels), sharey=True), panels, strict=True):
            found = read_differences(folder / f"{name}.csv")
            for row, pair in enumerate(pairs):
                one, count = found[*pair, kind, iou]
                trained, resolved = over_trainings(one, count), resolves(one, count)
                color = HIGHLIGHT if resolved else COLORS[0]
                axes.plot([100.0 * bound for bound in trained], [row, row], color=color, lw=1.0)
                axes.plot([100.0 * bound for bound in one.by_drive], [row, row], color=color, lw=4.0, alpha=0.55)
                axes.plot(100.0 * one.value.mean, row, "o", color=color, ms=5.0)
            axes.axvline(0.0, color=FAINT, lw=0.8)
            axes.set_title(title.partition(",")[0])
            axes.grid(axis="x")
            axes.set_yticks(range(len(pairs)), labels=[f"{method} − {baseline}" for method, baseline in pairs])
        axes.invert_yaxis()
        return save(figure, folder / "gains.png", 64)


def pairs_of(folder: Path) -> list[tuple[str, str]]:
    """Pairs of methods of a benchmark, in their order."""
    return list(
        dict.fromkeys((method, baseline) for method, baseline, *_ in read_differences(folder / "differences.csv"))
    )


def resolves(one: Difference, pairs: int) -> bool:
    """Whether a difference exceeds what other drives and other trainings change together.

    The one interval holds the trainings fixed, the other the drives; their bounds next to 0 are added in quadrature.
    """
    trained, sign = over_trainings(one, pairs), math.copysign(1.0, one.value.mean)
    bounds = (interval.low if sign > 0.0 else interval.high for interval in (one.by_drive, trained))
    return abs(one.value.mean) > math.hypot(*(abs(one.value.mean - bound) for bound in bounds))


def _cell(one: Difference, pairs: int) -> str:
    trained = over_trainings(one, pairs)
    text = f"{100 * one.value.mean:+.1f} {one.by_drive.points}"
    if math.isnan(trained.low):
        return text
    text += f" ({trained.points[1:-1]})"
    return Strong(text) if resolves(one, pairs) else text


if __name__ == "__main__":
    main()
