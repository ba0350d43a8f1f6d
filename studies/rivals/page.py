"""Tables of report.md: what each method or part gives, with intervals by drive and over trainings.

They are made from the differences that `dsrc benchmark` wrote beside the report, where `studies.rivals.train QUESTION
--docs studies/rivals/report.md` brings them.

Usage:
    python -m studies.rivals.page
"""

import argparse
import csv
import math
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Gain:
    """What a method gives in a column of the tables.

    Attributes:
        value: difference of two methods, with its interval by drive.
        trained: its interval over trainings, see `over_trainings`.
    """

    value: Difference
    trained: Interval

    @property
    def together(self) -> Interval:
        """Interval over drives and trainings: the distances of the two intervals' bounds, added in quadrature.

        The one holds the trainings fixed, the other the drives; unknown with one training.
        """
        mean, (low, high) = self.value.value.mean, self.value.by_drive
        if math.isnan(self.trained.low):
            return Interval(math.nan, math.nan)
        return Interval(
            mean - math.hypot(mean - low, mean - self.trained.low),
            mean + math.hypot(high - mean, self.trained.high - mean),
        )

    @property
    def text(self) -> str:
        """Points, the interval by drive in brackets, that over trainings in parentheses; bold if resolved by both."""
        text = f"{100 * self.value.value.mean:+.1f} {self.value.by_drive.points}"
        if math.isnan(self.trained.low):
            return text
        text += f" ({self.trained.points[1:-1]})"
        return Strong(text) if self.together.excludes_zero else text


Gains = dict[tuple[str, str], list[Gain]]
"""Gains of pairs of method and baseline, one for each column of `SHOWN`."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    found = {question: sorted(PAGE.with_suffix("").glob(f"{question}/*/differences.csv")) for question in QUESTIONS}
    if not any(found.values()):
        raise SystemExit(f"{PAGE}: no results beside it; studies.rivals.train --docs brings them")
    for question, files in found.items():
        if len(files) > 1:
            raise SystemExit(f"{PAGE}: {question}: expected results on one data set, found {len(files)}")
        for file in files:
            rows = read_gains(file.parent)
            replace_block(PAGE, f"{question}_gains", gains(rows).markdown())
            draw(rows, file.parent, TITLES[question])
            print(f"{PAGE}: {question}")


def read_gains(folder: Path) -> Gains:
    """Read the differences of a benchmark, in their order."""
    texts = ("method", "baseline", "condition", "resolved", "seeds")
    found = {}
    for name in {name for _, name, _, _ in SHOWN}:
        with (folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(line for line in file if not line.startswith("#")):
                values = {key: float(value) if value else None for key, value in row.items() if key not in texts}
                one = Difference.of_listed({key: row[key] for key in texts} | values)
                gain = Gain(one, over_trainings(one, len(row["seeds"].split())))
                found[one.method, one.baseline, name, one.condition, one.iou] = gain
    pairs = dict.fromkeys((method, baseline) for method, baseline, *_ in found)
    return {pair: [found[*pair, name, kind, iou] for _, name, kind, iou in SHOWN] for pair in pairs}


def over_trainings(one: Difference, pairs: int) -> Interval:
    """Interval of a difference over pairs of trainings: Student's t; unknown with fewer than two pairs."""
    if pairs < 2 or math.isnan(one.value.spread):
        return Interval(math.nan, math.nan)
    half = float(stats.t.ppf(0.5 + LEVEL / 2.0, pairs - 1)) * one.value.spread / pairs**0.5
    return Interval(one.value.mean - half, one.value.mean + half)


def gains(rows: Gains) -> Table:
    """Table of what each method gives: a row per pair of methods."""
    lines = [TableRow(_titled(pair), tuple(gain.text for gain in row)) for pair, row in rows.items()]
    return Table("gains", "", "difference", tuple(Column(title) for title, *_ in SHOWN), tuple(lines))


def draw(rows: Gains, folder: Path, about: str) -> Path:
    """Draw the differences at an overlap of 0.7 in the mean of the corruptions, with both intervals."""
    panels = [place for place, column in enumerate(SHOWN) if column[2:] == (MEAN_CORRUPTED, 0.7)]
    with style():
        note = (
            "Points of AP@0.7, mean of six corruptions. Thick: 95 % by drive; thin: over trainings; orange: beyond both"
        )
        figure = new_figure(9.5, 1.5 + 0.27 * len(rows), about, note)
        for axes, panel in zip(figure.subplots(1, len(panels), sharey=True), panels, strict=True):
            for height, gain in enumerate(row[panel] for row in rows.values()):
                color = HIGHLIGHT if gain.together.excludes_zero else COLORS[0]
                axes.plot([100.0 * bound for bound in gain.trained], [height, height], color=color, lw=1.0)
                by_drive = [100.0 * bound for bound in gain.value.by_drive]
                axes.plot(by_drive, [height, height], color=color, lw=4.0, alpha=0.55)
                axes.plot(100.0 * gain.value.value.mean, height, "o", color=color, ms=5.0)
            axes.axvline(0.0, color=FAINT, lw=0.8)
            axes.set_title(SHOWN[panel][0].partition(",")[0])
            axes.grid(axis="x")
            axes.set_yticks(range(len(rows)), labels=list(map(_titled, rows)))
        axes.invert_yaxis()
        return save(figure, folder / "gains.png", 64)


def _titled(pair: tuple[str, str]) -> str:
    return " − ".join(pair)


if __name__ == "__main__":
    main()
