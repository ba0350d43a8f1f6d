"""Differences of methods by the score from which boxes count, sorted inside frames as OpenCOOD does.

Usage:
    python -m studies.dsrc_paper.score_thresholds runs/twins --docs studies/dsrc_paper/report.md
    python -m studies.dsrc_paper.score_thresholds runs/benchmark --baseline V2VNet CoBEVT --scores 0.2 0.25

Read from the detections that a benchmark has stored, under its ideal channel, of severity 3 where it has several; boxes
below a detector's own least score are not among them. Trainings and corruptions are averaged; where two methods have
trainings of two or more common numbers, only these count.
In brackets is the 95 % interval of 1,000 resamples of the drives, those of one run of traffic together, see
dsrc/evaluation/metrics/intervals.py; bold numbers are those whose interval excludes 0. With several baselines the
intervals are left out. The drives have to be where they were.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.intervals import (
    IOUS,
    RESAMPLES,
    RankedDetections,
    draw_weights,
    resampled_ap,
)
from dsrc.evaluation.report.differences import SEED
from dsrc.evaluation.stored import StoredRun
from sim.errors import UserError
from studies.dsrc_paper.stored_pairs import StoredPairs, with_interval
from studies.look import put_table

SCORES = (0.2, 0.25, 0.3, 0.35, 0.4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of a benchmark, with its cells")
    parser.add_argument("--method", default="DSRC", help="method, by its name in the tables")
    parser.add_argument(
        "--baseline", nargs="+", default=["AttFuse (plain student)"], help="methods that it is compared with"
    )
    parser.add_argument("--scores", nargs="+", type=float, default=SCORES, help="least scores of boxes that count")
    parser.add_argument(
        "--docs", type=Path, help="Markdown document that gets the table, between markers score_thresholds_FOLDER"
    )
    options = parser.parse_args()
    if not all(0.0 <= score <= 1.0 for score in options.scores):
        parser.error(f"--scores: expected numbers from 0 to 1, found {' '.join(map(str, options.scores))}")
    try:
        stored = StoredPairs.read(options.results)
        for option, wanted in (("method", [options.method]), ("baseline", options.baseline)):
            stored.check(f"--{option}", wanted)
        several = ["difference"] if len(options.baseline) > 1 else []
        head = [*several, "boxes count from", *(f"{score:g}" for score in options.scores)]
        put_table(options.docs, f"score_thresholds_{options.results.name}", head, rows_of(options, stored))
    except UserError as error:
        parser.error(str(error))


def rows_of(options: argparse.Namespace, stored: StoredPairs) -> list[list[str]]:
    """Return the table's rows: a baseline's by group and IoU, several baselines' by baseline and group."""
    rows, several, units = [], len(options.baseline) > 1, len(set(stored.traffic))
    for baseline in options.baseline:
        for group, pair in stored.pairs(options.method, baseline).items():
            found, other = (resampled(options, stored, own) for own in pair)
            cells = [[with_interval(gain, units, shown=not several) for gain in at_score] for at_score in found - other]
            if several:
                rows.append([f"{options.method} − {baseline}", group, *map(" / ".join, cells)])
            else:
                columns = zip(*cells, strict=True)
                rows += [[f"{group}, {iou:g}", *column] for iou, column in zip(IOUS, columns, strict=True)]
    return rows


def resampled(options: argparse.Namespace, stored: StoredPairs, runs: Sequence[StoredRun]) -> NDArray[np.float64]:
    """Return (S, T, 1 + R) mean AP of a method's runs in the sample and in its resamples, by score and IoU."""
    found = np.zeros((len(options.scores), len(IOUS), 1 + RESAMPLES))
    for run in runs:
        matches, frames = stored.matches(run)
        drawn = draw_weights(np.repeat(stored.traffic, frames), RESAMPLES, np.random.default_rng(SEED))
        weights = np.concatenate([np.ones((1, matches.frames), np.float32), drawn])
        for row, least in enumerate(options.scores):
            ranked = RankedDetections.of(matches, inside_frames=True, least_score=least)
            found[row] += resampled_ap(ranked, weights) / len(runs)
    return found


if __name__ == "__main__":
    main()
