"""Fakes: a detector that reads the truth, a corruption by a number, and a drive from formulas."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from dsrc.data.drives import open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample, SampleRequest
from dsrc.evaluation.detect import Method, evaluate_drive, frame_positions, join_results
from dsrc.evaluation.metrics.ap import evaluate_matches
from dsrc.evaluation.results import Row, make_row, summary_rows
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sensors.corruptions import Condition, corruption_kinds
from sensors.frame import Frame
from tests.dsrc.data.toy import toy_frame

GRID = GridSpec(range_m=(-51.2, -25.6, -3, 51.2, 25.6, 3))


class PointCounter:
    """Detects exactly the true boxes that hold enough points of the clouds that it is given."""

    def __init__(self, need: int = 3, offset: float = 0.0, grid: GridSpec = GRID) -> None:
        self.settings = SampleRequest(grid)
        self.need, self.offset = need, offset
        self.seen = []

    def detect(self, sample: Sample) -> Detections:
        self.seen.append(sample)
        points = np.concatenate([cloud[:, :3] for cloud in sample.clouds])
        counts = sample.boxes.contains(points).sum(axis=1)
        order = np.argsort(-counts, kind="stable")[: (counts >= self.need).sum()]
        boxes = sample.boxes[order].array
        boxes[:, 0] += self.offset
        score = (counts[order] / (counts[order] + 10.0)).astype(np.float32)
        return Detections(type(sample.boxes).from_array(boxes), score)


def halve(frame: Frame, kind: str, severity: int, seed: int, family: str = "physical", **_: object) -> Frame:
    """Leave every `2 * severity`-th point."""
    return frame.with_sweeps([agent.sweep[:: 2 * severity] for agent in frame.agents])


def write_drives(root: Path, drives: int = 2, frames: int = 3) -> list[Path]:
    paths = []
    for drive in range(drives):
        path = root / f"drive_{drive}"
        for index in range(frames):
            write_frame(path, toy_frame(index, seed=drive))
        paths.append(path)
    return paths


def detect_all(
    methods: Sequence[Method],
    drives: Sequence[Path],
    corruptions: Sequence[str] = ("clean",),
    severity: int = 3,
    seed: int = 0,
    limit: int | None = None,
    count_frame: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Return rows by condition and method, then the summaries: methods in frames of drives, clean and corrupted."""
    conditions = [Condition(), *(Condition(kind, severity) for kind in corruption_kinds(corruptions))]
    readers = [open_drive(drive) for drive in drives]
    parts = {}
    for reader, positions in zip(readers, frame_positions(readers, limit), strict=True):
        work = dict.fromkeys(conditions, methods)
        for key, result in evaluate_drive(reader, positions, work, seed, count_frame).items():
            parts.setdefault(key, []).append(result)
    rows = []
    for (condition, name), several in parts.items():
        whole = join_results(several)
        found = evaluate_matches(whole.matches)
        rows.append(make_row(name, condition.kind, condition.severity, found, whole.seconds, whole.traffic))
    return [*rows, *summary_rows(rows)]
