"""Detections that a benchmark has stored, by pairs of methods that are compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import open_drive, scenario_of, traffic_runs
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.detect import join_results
from dsrc.evaluation.metrics.ap import Matches
from dsrc.evaluation.metrics.intervals import percentile_interval
from dsrc.evaluation.report.dataset_results import PAPER_SEVERITY
from dsrc.evaluation.stored import StoredRun, read_index
from sensors.corruptions import CLEAN
from sim.errors import DataError, SettingsError, complaint

GROUPS = {
    "clean": ("physical", True),
    "mean of the corruptions as published": ("paper", False),
    "mean of our corruptions": ("physical", False),
}
"""Family of the corruptions of a group, and whether it is of clean frames."""


@dataclass(frozen=True)
class StoredPairs:
    """Stored detections on one data set, under the ideal channel, of severity 3 where there are several.

    Attributes:
        results: folder of the benchmark.
        runs: of all methods and conditions.
        places: (D,) name of the scenario of each drive, of the drive itself where it has none.
        traffic: (D,) number of the run of traffic of each drive.
    """

    results: Path
    runs: tuple[StoredRun, ...]
    places: tuple[str, ...]
    traffic: NDArray[np.int64]

    @classmethod
    def read(cls, results: Path) -> Self:
        """Read the index of a benchmark's detections; its drives have to be where they were.

        Raises:
            DataError: there is none, it has several data sets or several severities other than the paper's, or a drive
                is not where it was.
        """
        index = read_index(results)
        if len(datasets := sorted({drive.dataset for drive in index.drives})) > 1:
            raise DataError(complaint(results, "datasets", "one", ", ".join(datasets)))
        severities = {run.severity for run in index.runs if run.kind != CLEAN}
        shown = {PAPER_SEVERITY} & severities or severities
        if len(shown) > 1:
            raise DataError(complaint(results, "severity", f"{PAPER_SEVERITY} or one", sorted(shown)))
        runs = [run for run in index.runs if run.channel == "ideal" and not run.swept]
        runs = [run for run in runs if run.kind == CLEAN or run.severity in shown]
        drives = [open_drive(Path(drive.path)) for drive in index.drives]
        places = tuple(scenario_of(drive) or drive.drive.name for drive in drives)
        return cls(results, tuple(runs), places, np.array(traffic_runs(drives)))

    def check(self, field: str, methods: Sequence[str]) -> None:
        """Check that methods are there.

        Raises:
            SettingsError: one is not.
        """
        known = sorted({run.method for run in self.runs})
        for name in methods:
            if name not in known:
                raise SettingsError(complaint(self.results, field, f"one of {', '.join(known)}", name))

    def pair(self, method: str, baseline: str, group: str) -> tuple[list[StoredRun], list[StoredRun]]:
        """Return the runs of two methods in one of `GROUPS`.

        Where they have trainings of two or more common numbers, only these count.
        """
        family, clean = GROUPS[group]
        chosen = [run for run in self.runs if (run.family, run.kind == CLEAN) == (family, clean)]
        both = [[run for run in chosen if run.method == name] for name in (method, baseline)]
        common = set.intersection(*({run.training for run in own} for own in both))
        if len(common) > 1:
            both = [[run for run in own if run.training in common] for own in both]
        return both[0], both[1]

    def pairs(self, method: str, baseline: str) -> dict[str, tuple[list[StoredRun], list[StoredRun]]]:
        """Return the runs of two methods by the groups in which both have some."""
        return {group: pair for group in GROUPS if all(pair := self.pair(method, baseline, group))}

    def matches(self, run: StoredRun) -> tuple[Matches, list[int]]:
        """Return the matches of a run's detections with true boxes, and the frames of each drive."""
        parts = [join_results([read_cell(self.results / "cells", key) for key in keys]) for keys in run.cells]
        return join_results(parts).matches, [part.matches.frames for part in parts]


def with_interval(gains: NDArray[np.float64], units: int, *, shown: bool = True) -> str:
    """Return a difference in points with its interval, none of one unit; bold where it excludes 0.

    Args:
        gains: (1 + R,) difference in the sample, then in its resamples.
        units: number of units drawn from.
        shown: False leaves the interval out.
    """
    interval = percentile_interval(gains[1:], units)
    text = f"{100 * gains[0]:+.1f}" + (f" {interval.points}" if shown and units > 1 else "")
    return f"**{text}**" if interval.excludes_zero else text
