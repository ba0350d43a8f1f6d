"""Difference of two methods place by place, and its intervals over drives and over places.

Usage:
    python -m studies.dsrc_paper.places runs/twins --docs studies/dsrc_paper/report.md

Read from the detections that a benchmark has stored, sorted over all frames. Trainings and corruptions are averaged. A
place is a scenario; its row is the difference of the AP on its frames alone. The intervals of 95 % are of 1,000
resamples of the drives, those of one scenario and seed together, then of the places with all their drives
(dsrc/evaluation/metrics/intervals.py); bold numbers are those whose interval excludes 0.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.intervals import RESAMPLES, RankedDetections, draw_weights, resampled_ap
from dsrc.evaluation.report.differences import SEED
from dsrc.evaluation.stored import StoredRun
from sim.errors import UserError
from studies.dsrc_paper.stored_pairs import StoredPairs, with_interval
from studies.look import put_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of a benchmark, with its cells")
    parser.add_argument("--method", default="DSRC", help="method, by its name in the tables")
    parser.add_argument("--baseline", default="AttFuse (plain student)", help="method that it is compared with")
    parser.add_argument(
        "--docs", type=Path, help="Markdown document that gets the table, between markers places_FOLDER"
    )
    options = parser.parse_args()
    try:
        stored = StoredPairs.read(options.results)
        stored.check("--method", [options.method])
        stored.check("--baseline", [options.baseline])
        pairs = stored.pairs(options.method, options.baseline)
        head = ["place", "drives", "frames", "boxes", *(f"{group}, 0.5 / 0.7" for group in pairs)]
        put_table(options.docs, f"places_{options.results.name}", head, rows_of(stored, pairs))
    except UserError as error:
        parser.error(str(error))


def rows_of(stored: StoredPairs, pairs: dict[str, tuple[list[StoredRun], list[StoredRun]]]) -> list[list[str]]:
    """Return a row for each place, and one for all of them by drive and by place."""
    matches, frames = stored.matches(next(iter(pairs.values()))[0][0])
    names = list(dict.fromkeys(stored.places))
    place = np.repeat([names.index(name) for name in stored.places], frames)
    alone = np.stack([place == number for number in range(len(names))]).astype(np.float32)
    weights = np.concatenate(
        [
            np.ones((1, len(place)), np.float32),
            alone,
            draw_weights(np.repeat(stored.traffic, frames), RESAMPLES, np.random.default_rng(SEED)),
            draw_weights(place, RESAMPLES, np.random.default_rng(SEED)),
        ]
    )
    gains = [mean_ap(stored, ours, weights) - mean_ap(stored, others, weights) for ours, others in pairs.values()]
    first = 1 + len(names)
    drives, boxes = np.bincount([names.index(name) for name in stored.places]), alone @ matches.truth_counts
    rows = [
        [
            name,
            str(drives[k]),
            str(int(alone[k].sum())),
            str(int(boxes[k])),
            *(_points(gain[:, 1 + k]) for gain in gains),
        ]
        for k, name in enumerate(names)
    ]
    runs = len(set(stored.traffic))
    by_drive = "all, by drive" if runs == len(stored.places) else f"all, by drive ({runs} runs of traffic)"
    resamples = np.arange(first, len(weights)).reshape(2, RESAMPLES)
    for title, units, drawn in ((by_drive, runs, resamples[0]), ("all, by place", len(names), resamples[1])):
        cells = (" / ".join(with_interval(own[[0, *drawn]], units) for own in gain) for gain in gains)
        rows.append([title, str(len(stored.places)), str(len(place)), str(int(boxes.sum())), *cells])
    return rows


def mean_ap(stored: StoredPairs, runs: Sequence[StoredRun], weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (T, W) mean AP of a method's runs under (W, F) weights of the frames."""
    return np.mean([resampled_ap(RankedDetections.of(stored.matches(run)[0]), weights) for run in runs], axis=0)


def _points(gains: NDArray[np.float64]) -> str:
    return " / ".join("-" if np.isnan(gain) else f"{round(100 * gain, 1) + 0.0:+.1f}" for gain in gains)


if __name__ == "__main__":
    main()
