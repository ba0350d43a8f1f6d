"""Difference of two methods by the score from which boxes count, sorted inside frames as the paper's numbers are.

Usage:
    python examples/score_thresholds.py runs/twins --docs docs/results.md
    python examples/score_thresholds.py runs/benchmark --method "Maximum + DSRC" --baseline F-Cooper

Read from the detections that a benchmark has stored; trainings are averaged. Intervals are not computed.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from look import put_table
from numpy.typing import NDArray

from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.metrics.ap import curve_of
from dsrc.evaluation.stored import StoredRun, read_index
from sim.errors import UserError

SCORES = (0.2, 0.25, 0.3, 0.35, 0.4)
IOUS = (0.5, 0.7)
ROWS = {
    "clean": ("physical", True),
    "mean of the corruptions as published": ("paper", False),
    "mean of our corruptions": ("physical", False),
}
"""Family of each row, and whether it is of clean frames."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of a benchmark, with its cells")
    parser.add_argument("--method", default="DSRC", help="method, by its name in the tables")
    parser.add_argument("--baseline", default="AttFuse (plain student)", help="method that it is compared with")
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the table, between its markers")
    options = parser.parse_args()
    try:
        runs = [run for run in read_index(options.results).runs if run.channel == "ideal" and not run.swept]
        names = sorted({run.method for run in runs})
        for option in ("method", "baseline"):
            if getattr(options, option) not in names:
                parser.error(f"--{option}: expected one of {', '.join(names)}, found {getattr(options, option)}")
        rows = []
        for title, (family, clean) in ROWS.items():
            chosen = [run for run in runs if run.family == family and (run.kind == "clean") is clean]
            method, baseline = (
                mean_ap(options.results, [run for run in chosen if run.method == name])
                for name in (options.method, options.baseline)
            )
            gains = 100.0 * (method - baseline)
            rows.append([title, *(" / ".join(f"{gain:+.1f}" for gain in at_score) for at_score in gains)])
        put_table(options.docs, "score_thresholds", ["boxes count from", *map(str, SCORES)], rows)
    except UserError as error:
        parser.error(str(error))


def mean_ap(results: Path, runs: Sequence[StoredRun]) -> NDArray[np.float64]:
    """Return (S, 2) average precision in bird's-eye view, sorted inside frames: mean of runs, by score and IoU."""
    found = np.zeros((len(SCORES), len(IOUS)))
    for run in runs:
        parts = [read_cell(results / "cells", key).matches for keys in run.cells for key in keys]
        score, truth = np.concatenate([part.score for part in parts]), sum(part.truth for part in parts)
        for column, iou in enumerate(IOUS):
            hit = np.concatenate([part.matched["bev", iou] for part in parts]) >= 0
            for row, least in enumerate(SCORES):
                kept = score >= least  # what is left out had suppressed nothing that is kept
                found[row, column] += curve_of(hit[kept], score[kept], truth).ap_opencood / len(runs)
    return found


if __name__ == "__main__":
    main()
