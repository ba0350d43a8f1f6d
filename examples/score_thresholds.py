"""Differences of methods by the score from which boxes count, sorted inside frames as OpenCOOD does.

Usage:
    python examples/score_thresholds.py runs/twins --docs docs/results.md
    python examples/score_thresholds.py runs/benchmark --baseline V2VNet CoBEVT --scores 0.2 0.25

Read from the detections that a benchmark has stored, under its ideal channel. Trainings and corruptions are averaged.
In brackets is the 95 % interval of 1,000 resamples of the drives, see dsrc/evaluation/metrics/intervals.py; bold
numbers are those whose interval excludes 0. With several baselines the intervals are left out.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from look import put_table
from numpy.typing import NDArray

from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.metrics.intervals import (
    IOUS,
    RESAMPLES,
    RankedDetections,
    draw_weights,
    percentile_interval,
    resampled_ap,
)
from dsrc.evaluation.stored import StoredRun, read_index
from sim.errors import UserError

SCORES = (0.2, 0.25, 0.3, 0.35, 0.4)
GROUPS = {
    "clean": ("physical", True),
    "mean of the corruptions as published": ("paper", False),
    "mean of our corruptions": ("physical", False),
}
"""Family of each row, and whether it is of clean frames."""


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
    try:
        runs = [run for run in read_index(options.results).runs if run.channel == "ideal" and not run.swept]
        names = sorted({run.method for run in runs})
        for option, wanted in (("method", [options.method]), ("baseline", options.baseline)):
            for name in wanted:
                if name not in names:
                    parser.error(f"--{option}: expected one of {', '.join(names)}, found {name}")
        aps = {
            name: {group: resampled(options, runs, name, group) for group in GROUPS}
            for name in (options.method, *options.baseline)
        }
    except UserError as error:
        parser.error(str(error))
    rows, several = [], len(options.baseline) > 1
    for baseline in options.baseline:
        for group in GROUPS:
            gains, units = aps[options.method][group][0] - aps[baseline][group][0], aps[baseline][group][1]
            cells = [[text_of(gain, units, short=several) for gain in at_score] for at_score in gains]
            if several:
                rows.append([f"{options.method} − {baseline}", group, *map(" / ".join, cells)])
            else:
                rows += [
                    [f"{group}, {iou:g}", *column] for iou, column in zip(IOUS, zip(*cells, strict=True), strict=True)
                ]
    head = [*(["difference"] if several else []), "boxes count from", *(f"{score:g}" for score in options.scores)]
    put_table(options.docs, f"score_thresholds_{options.results.name}", head, rows)


def resampled(
    options: argparse.Namespace, runs: Sequence[StoredRun], name: str, group: str
) -> tuple[NDArray[np.float64], int]:
    """Return (S, T, 1 + R) mean AP of a method in the sample and in its resamples, by score and IoU, and its drives."""
    family, clean = GROUPS[group]
    chosen = [run for run in runs if (run.method, run.family, run.kind == "clean") == (name, family, clean)]
    found = np.zeros((len(options.scores), len(IOUS), 1 + RESAMPLES))
    for run in chosen:
        parts = [[read_cell(options.results / "cells", key).matches for key in keys] for keys in run.cells]
        cells = [cell for own in parts for cell in own]
        truths = np.concatenate([cell.truth_counts for cell in cells])
        counts = np.concatenate([cell.detection_counts for cell in cells])
        # Cells keep the detections of a frame by falling score, frame after frame.
        frame = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        hit = np.stack([np.concatenate([cell.matched["bev", iou] for cell in cells]) >= 0 for iou in IOUS])
        score = np.concatenate([cell.score for cell in cells])
        drive = np.repeat(np.arange(len(parts)), [sum(cell.frames for cell in own) for own in parts])
        drawn = draw_weights(drive, RESAMPLES, np.random.default_rng(0))
        weights = np.concatenate([np.ones((1, len(truths)), np.float32), drawn])
        for row, least in enumerate(options.scores):
            kept = score >= least  # what is left out had suppressed nothing that is kept
            ranked = RankedDetections(frame[kept], hit[:, kept], truths)
            found[row] += resampled_ap(ranked, weights) / len(chosen)
    return found, len(run.cells)


def text_of(gains: NDArray[np.float64], drives: int, *, short: bool) -> str:
    """Return a difference in points with its interval, which `short` leaves out; bold where it excludes 0."""
    interval = percentile_interval(gains[1:], drives)
    text = f"{100 * gains[0]:+.1f}"
    if not short:
        text += f" {interval.points}"
    return f"**{text}**" if interval.excludes_zero else text


if __name__ == "__main__":
    main()
