"""Average precision of 2,000 frames: ours against a loop over shapely polygons with the same result.

Frames are made from a seed: 26 to 50 vehicles in lanes, and detections as a detector's are, some 20 to 60: most
vehicles are found, off by some decimetres and degrees, some twice, some not, and there are boxes where nothing is.

    python -m benchmarks.evaluation            # the loop goes through all frames, a quarter of a minute
    python -m benchmarks.evaluation --quick    # the loop goes through every tenth
"""

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from shapely.geometry import Polygon

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, FrameResult, average_precision, evaluate, metric_name
from dsrc.ops.detections import Detections
from sim.boxes import Boxes

FRAMES = 2000
_LANE_M, _GAP_M = 3.6, 8.0


def make_frame(rng: np.random.Generator) -> FrameResult:
    """Draw a frame: vehicles that do not touch, and detections of them."""
    count = int(rng.integers(26, 51))
    # Places of a street's lanes, two of three along it; sizes of cars, vans and trucks.
    spots = rng.permutation(24 * 12)[:count]
    xy = np.stack([(spots % 24 - 12) * _GAP_M, (spots // 24 - 6) * _LANE_M], axis=1)
    size = np.array([[4.5, 1.8, 1.5], [5.9, 2.0, 2.6], [7.4, 2.4, 3.2]])[rng.choice(3, count, p=[0.8, 0.15, 0.05])]
    yaw = rng.choice([0.0, np.pi], count) + rng.normal(0.0, 0.05, count)
    truth = np.column_stack([xy, 0.5 * size[:, 2] - 1.9, size * rng.uniform(0.95, 1.05, (count, 3)), yaw])
    found = truth[rng.random(count) < 0.85]
    again = found[rng.random(len(found)) < 0.1]
    invented = truth[rng.integers(0, count, rng.poisson(0.15 * count))]
    parts = [(found, 0.2, 0.75), (again, 0.5, 0.4), (invented, 6.0, 0.3)]
    boxes = np.concatenate([_off(rng, part, spread) for part, spread, _ in parts])
    score = np.concatenate([np.clip(rng.normal(mean, 0.15, len(part)), 0.2, 0.999) for part, _, mean in parts])
    best = np.argsort(-score, kind="stable")
    return FrameResult(
        Detections(Boxes.from_array(boxes[best]), score[best].astype(np.float32)), Boxes.from_array(truth)
    )


def _off(rng: np.random.Generator, boxes: NDArray[np.float64], spread_m: float) -> NDArray[np.float64]:
    """Boxes displaced by about `spread_m`, turned and resized a little."""
    moved = boxes.copy()
    moved[:, :2] += rng.normal(0.0, spread_m, (len(boxes), 2))
    moved[:, 2] += rng.normal(0.0, 0.1, len(boxes))
    moved[:, 3:6] *= rng.uniform(0.92, 1.08, (len(boxes), 3))
    moved[:, 6] += rng.normal(0.0, 0.05, len(boxes))
    return moved


def make_frames(count: int) -> list[FrameResult]:
    """Frames, the same in every run."""
    rng = np.random.default_rng(0)
    return [make_frame(rng) for _ in range(count)]


def shapely_metrics(frames: Sequence[FrameResult]) -> dict[str, float]:
    """Average precisions as in `EvalResult.metrics`, by a loop over pairs of polygons and over detections.

    Faster than the loop of the published tools, which intersects every pair anew at each threshold and computes the
    union too: here each pair is intersected once.
    """
    flags: dict[tuple[str, float], list[bool]] = {(space, t): [] for space in SPACES for t in THRESHOLDS}
    scores: list[float] = []
    truths = 0
    for frame in frames:
        found, truth = frame.detections.boxes, frame.truth
        overlap = _overlaps(found, truth)
        order = sorted(range(len(found)), key=lambda row: -frame.detections.score[row])
        scores += [float(frame.detections.score[row]) for row in order]
        truths += len(truth)
        for (space, threshold), hits in flags.items():
            left = list(range(len(truth)))
            for row in order:
                values = [overlap[space][row][j] for j in left]
                best = int(np.argmax(values)) if values else -1
                hits.append(best >= 0 and values[best] >= threshold)
                if hits[-1]:
                    left.pop(best)
    named = {}
    by_score = sorted(range(len(scores)), key=lambda row: -scores[row])
    for (space, threshold), hits in flags.items():
        for opencood, ranked in ((False, [hits[row] for row in by_score]), (True, hits)):
            recall, precision, right = [], [], 0
            for rank, hit in enumerate(ranked, start=1):
                right += hit
                recall.append(right / truths)
                precision.append(right / rank)
            ap = average_precision(np.array(recall), np.array(precision), truths)
            named[metric_name(space, threshold, opencood=opencood)] = ap
    return named


def _overlaps(found: Boxes, truth: Boxes) -> dict[str, list[list[float]]]:
    """IoU of footprints and of volumes, pair by pair."""
    seen, real = ([Polygon(corners[:4, :2]) for corners in boxes.corners()] for boxes in (found, truth))
    plane: list[list[float]] = []
    space: list[list[float]] = []
    for a, box in zip(seen, found.array, strict=True):
        plane.append([])
        space.append([])
        for b, other in zip(real, truth.array, strict=True):
            shared = a.intersection(b).area
            plane[-1].append(shared / (a.area + b.area - shared))
            top = min(box[2] + box[5] / 2, other[2] + other[5] / 2)
            bottom = max(box[2] - box[5] / 2, other[2] - other[5] / 2)
            shared *= max(top - bottom, 0.0)
            space[-1].append(shared / (a.area * box[5] + b.area * other[5] - shared))
    return {"bev": plane, "3d": space}


def timed(run: Callable[[], dict[str, float]], times: int = 1) -> tuple[dict[str, float], float, float]:
    """Result of a call, and the least wall and CPU seconds of several calls."""
    wall, cpu = [], []
    for _ in range(times):
        start, busy = time.perf_counter(), time.process_time()
        made = run()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - busy)
    return made, min(wall), min(cpu)


def main(quick: bool = False) -> None:
    """Time the average precision of 2,000 frames: a table for people, then one line of JSON.

    Args:
        quick: the loop goes through every tenth frame.
    """
    frames = make_frames(FRAMES)
    asked = frames[::10] if quick else frames
    evaluate(frames[:20])
    _, all_s, all_cpu_s = timed(lambda: evaluate(frames).metrics(), 3)
    ours, ours_s, ours_cpu_s = timed(lambda: evaluate(asked).metrics(), 3)
    loop, loop_s, loop_cpu_s = timed(lambda: shapely_metrics(asked))
    difference = max(abs(ours[name] - loop[name]) for name in ours)
    pairs = sum(len(f.detections) * len(f.truth) for f in frames)
    rows = (
        ("ours", len(frames), f"{all_s:.2f}", f"{all_cpu_s:.2f}"),
        ("ours", len(asked), f"{ours_s:.3f}", f"{ours_cpu_s:.3f}"),
        ("shapely loop", len(asked), f"{loop_s:.1f}", f"{loop_cpu_s:.1f}"),
    )
    console = Console(width=100, highlight=False)
    title = "AP in bird's-eye view and 3D, at 0.3, 0.5, 0.7, in both orders"
    console.print(Table.of(("what", "frames", "s", "CPU s"), rows, title=title))
    console.print(
        f"Of CPU time {loop_cpu_s / ours_cpu_s:.0f} times faster; the APs differ by {difference:.1e} at most."
    )
    print(
        json.dumps(
            {
                "ap_speedup": round(loop_cpu_s / ours_cpu_s, 1),
                "ap_speedup_wall": round(loop_s / ours_s, 1),
                "ap_s": round(all_s, 3),
                "ap_difference": difference,
                "frames": len(frames),
                "frames_of_loop": len(asked),
                "pairs": pairs,
                "ap_bev_50": round(ours[metric_name("bev", 0.5)], 4),
                "cores": os.cpu_count(),
            }
        )
    )


if __name__ == "__main__":
    tyro.cli(main)
