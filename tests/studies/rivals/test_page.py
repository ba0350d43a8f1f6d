"""Tables of the report: a difference with its interval by drive and over trainings."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from dsrc.evaluation.metrics.intervals import Difference, Interval
from dsrc.tables.table import Stat, Strong
from studies.rivals.page import gains, over_trainings, read_gains


def difference(mean: float, spread: float, by_drive: tuple[float, float], condition: str, iou: float) -> Difference:
    interval = Interval(*by_drive)
    return Difference("DSRC", "plain twin", condition, iou, Stat(mean, spread), interval, interval, (0, 1, 2))


def test_an_interval_over_trainings_is_that_of_a_paired_t_test() -> None:
    values = np.array([0.021, 0.008, 0.016])
    found = over_trainings(difference(*Stat.of(list(values)), (0.0, 1.0), "clean", 0.5), len(values))
    known = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert found == pytest.approx((known.low, known.high))
    assert all(map(math.isnan, over_trainings(difference(0.02, math.nan, (0.0, 1.0), "clean", 0.5), 1)))


def test_bold_is_what_both_intervals_resolve(tmp_path: Path) -> None:
    both, wide, one_drive = (0.02, 0.002, (0.01, 0.03)), (0.02, 0.02, (0.01, 0.03)), (0.02, 0.002, (-0.01, 0.05))
    shown = {
        ("clean", 0.5): both,
        ("clean", 0.7): wide,
        ("mean_corrupted", 0.5): one_drive,
        ("mean_corrupted", 0.7): both,
    }
    for name in ("differences", "differences_paper"):
        listed = [difference(*values, *place).listed() for place, values in shown.items()]
        with (tmp_path / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(listed[0]))
            writer.writeheader()
            writer.writerows(listed)
    (row,) = gains(read_gains(tmp_path)).rows
    assert row.title == "DSRC − plain twin"
    bold = [isinstance(cell, Strong) for cell in row.cells]
    assert bold == [False, True, False, True, True, False]
    assert row.cells[-2] == "+2.0 [+1.0, +3.0] (+1.5, +2.5)"
