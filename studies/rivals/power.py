"""How many trainings resolve a difference: power of a paired t test, from the pairs of trainings that exist.

A pair is a training of each of two methods from the same seed. The spread of their differences is taken from the result
file of earlier pairs, with the upper end of its 80 % interval beside it, since a few pairs tell the spread badly.

Usage:
    python -m studies.rivals.power
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from dsrc.tables.table import Column, Table, TableRow

PAIRS = Path(__file__).parents[1] / "dsrc_paper/report/dsrc-sim-twins/results.csv"
METHOD, BASELINE = "DSRC", "AttFuse (plain student)"
LEVEL, POWER = 0.05, 0.8
EFFECTS = (0.01, 0.02, 0.03)
MOST = 60
"""Pairs of trainings at which the search ends."""


def differences(family: str, metric: str) -> list[float]:
    """Differences of the two methods, training by training, of the mean of a metric over a family of corruptions."""
    with PAIRS.open(encoding="utf-8", newline="") as file:
        rows = [
            row
            for row in csv.DictReader(line for line in file if not line.startswith("#"))
            if row["condition"] != "clean" and row["family"] == family
        ]

    def mean(name: str, seed: str) -> float:
        return float(
            np.mean([float(row[metric]) for row in rows if (row["method"], row["training_seed"]) == (name, seed)])
        )

    seeds = sorted({row["training_seed"] for row in rows if row["method"] == METHOD})
    return [mean(METHOD, seed) - mean(BASELINE, seed) for seed in seeds]


def power(effect: float, spread: float, pairs: int) -> float:
    """Probability that a two-sided paired t test at `LEVEL` finds an effect.

    The mean over quantiles of the measured spread: the noncentral t distribution of SciPy fails at few pairs.
    """
    free = pairs - 1
    measured = np.sqrt(stats.chi2.ppf((np.arange(4000) + 0.5) / 4000, free) / free)
    limit, shift = stats.t.ppf(1.0 - LEVEL / 2.0, free) * measured, effect / spread * pairs**0.5
    return float((stats.norm.sf(limit - shift) + stats.norm.cdf(-limit - shift)).mean())


def pairs_for(effect: float, spread: float) -> int:
    """Fewest pairs of trainings, at least two, with `POWER` to find an effect; `MOST` where more are needed."""
    return next((pairs for pairs in range(2, MOST) if power(effect, spread, pairs) >= POWER), MOST)


def spread_of(values: Sequence[float]) -> tuple[float, float]:
    """Standard deviation of values, and the upper end of its 80 % interval (chi-squared)."""
    found, free = float(np.std(values, ddof=1)), len(values) - 1
    return found, found * float(np.sqrt(free / stats.chi2.ppf(0.1, free)))


def power_table() -> Table:
    """Table of differences, their spread between trainings, and the pairs that each effect needs."""
    columns = [
        Column("gain", digits=1, scale=100.0),
        *(Column(t, digits=2, scale=100.0) for t in ("spread", "at most")),
    ]
    columns += [Column(f"pairs for {100 * effect:g}", align="left") for effect in EFFECTS]
    rows = []
    for family, named in (("paper", "published"), ("physical", "physical")):
        for metric, iou in (("ap_bev_50", 0.5), ("ap_bev_70", 0.7)):
            values = differences(family, metric)
            spread, most = spread_of(values)
            need = [f"{pairs_for(effect, spread)} to {pairs_for(effect, most)}" for effect in EFFECTS]
            rows.append(TableRow(f"{named}, AP@{iou}", (float(np.mean(values)), spread, most, *need)))
    title = f"{METHOD} less its plain twin, mean of six corruptions, points of AP"
    return Table("power", title, "corruptions", tuple(columns), tuple(rows))


def main() -> None:
    from rich.console import Console

    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    Console(highlight=False).print(power_table())


if __name__ == "__main__":
    main()
