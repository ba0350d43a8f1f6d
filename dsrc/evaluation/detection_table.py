"""DetectionTable: detections of a method and the true boxes of the same frames, stored to be scored and reviewed again.

Boxes are float32 and matches are made of these, so that a table that is read again gives the same average precision.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.evaluation.metrics.ap import FrameResult
from dsrc.ops.detections import Detections
from sensors.frame import Frame, count_points
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.packed import read_arrays

MOST_ROWS = 5_000_000
"""Largest number of boxes in a table that is read: a hundred frames of the densest detector have a thousandth."""
LEAST_SIZE_M = 1e-3
"""Least side of a stored box, m: a network's underflow gives 0, and overlaps no true box either way."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable:
    """D detections and N true boxes of F frames of a drive, in the ego LiDAR's frame, frame by frame.

    Attributes:
        position: (F,) int64 position of each frame in its drive.
        index: (F,) int64 number of each frame.
        ego_id: (F,) int64 agent that detects.
        found: (F,) int64 detections of each frame.
        boxes: (D, 7) float32 x, y, z, l, w, h, yaw, best first in each frame.
        score: (D,) float32 in [0, 1].
        truths: (F,) int64 true boxes of each frame.
        truth: (N, 7) float32.
        label: (N,) int64 index into `sim.boxes.CLASSES`.
        object_id: (N,) int64.
        points: (N, 4) int32 points on each true box: the ego's and all agents', then both after the corruption; -1 for
            unknown.
        ego_share: (N,) float32 visibility from the ego: the share of its rays on a box that nothing else stops; NaN for
            unknown.
    """

    position: NDArray[np.int64]
    index: NDArray[np.int64]
    ego_id: NDArray[np.int64]
    found: NDArray[np.int64]
    boxes: NDArray[np.float32]
    score: NDArray[np.float32]
    truths: NDArray[np.int64]
    truth: NDArray[np.float32]
    label: NDArray[np.int64]
    object_id: NDArray[np.int64]
    points: NDArray[np.int32]
    ego_share: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.position)

    def results(self) -> list[FrameResult]:
        """Detections and true boxes of each frame, for `dsrc.evaluation.metrics.ap.match_frames`."""
        results = []
        for rows, here in zip(_rows(self.found), _rows(self.truths), strict=True):
            detections = Detections(Boxes.from_array(self.boxes[rows]), self.score[rows])
            truth = Boxes.from_array(self.truth[here], self.label[here], self.object_id[here])
            results.append(FrameResult(detections, truth))
        return results

    def frames(self) -> list["DetectionTable"]:
        """Tables of one frame each; their arrays are views."""
        per_frame = [slice(row, row + 1) for row in range(len(self))]
        tables = []
        for frame, found, true in zip(per_frame, _rows(self.found), _rows(self.truths), strict=True):
            columns: dict[str, Any] = {}
            for name in _COLUMNS:
                rows = frame if name in _PER_FRAME else found if name in _PER_DETECTION else true
                columns[name] = getattr(self, name)[rows]
            tables.append(DetectionTable(**columns))
        return tables

    def objects(self, drive: NDArray[np.integer]) -> NDArray[np.int64]:
        """(N,) number of the object of each true box, from 0 on: boxes of one drive, id and size are one object's.

        Readers of frames without tracks number the boxes of each frame anew, so that another size is another object.

        Args:
            drive: (F,) number of the drive of each frame.
        """
        size_cm = np.round(100.0 * self.truth[:, 3:6])
        keys = np.column_stack([np.repeat(drive, self.truths), self.object_id, size_cm]).astype(np.int64)
        return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)

    def arrays(self) -> dict[str, NDArray]:
        """Columns as they are stored, by name; see `read_table`."""
        return {name: np.asarray(getattr(self, name), kind) for name, (kind, _) in _COLUMNS.items()}


_PER_FRAME = ("position", "index", "ego_id", "found", "truths")
_PER_DETECTION = ("boxes", "score")
# Kind in the file and width of a row.
_COLUMNS: dict[str, tuple[str, int | None]] = {
    "position": ("<i4", None),
    "index": ("<i8", None),
    "ego_id": ("<i8", None),
    "found": ("<i4", None),
    "boxes": ("<f4", 7),
    "score": ("<f4", None),
    "truths": ("<i4", None),
    "truth": ("<f4", 7),
    "label": ("|u1", None),
    "object_id": ("<i8", None),
    "points": ("<i4", 4),
    "ego_share": ("<f4", None),
}
_IN_MEMORY = {
    "boxes": np.float32,
    "score": np.float32,
    "truth": np.float32,
    "points": np.int32,
    "ego_share": np.float32,
}


def one_frame(
    position: int,
    index: int,
    ego_id: int,
    detections: Detections,
    truth: Boxes,
    points: NDArray[np.integer] | None = None,
    ego_share: NDArray[np.floating] | None = None,
) -> DetectionTable:
    """Table of one frame.

    Args:
        position: of the frame in its drive.
        detections: in the ego LiDAR's frame, in any order.
        truth: N true boxes in the same frame.
        points: (N, 4) see `DetectionTable`; None for unknown.
        ego_share: (N,) see `DetectionTable`; None for unknown.
    """
    n, best = len(truth), np.argsort(-detections.score, kind="stable")
    boxes = detections.boxes.array[best].astype(np.float32)
    boxes[:, 3:6] = np.maximum(boxes[:, 3:6], np.float32(LEAST_SIZE_M))
    return DetectionTable(
        position=np.array([position], np.int64),
        index=np.array([index], np.int64),
        ego_id=np.array([ego_id], np.int64),
        found=np.array([len(detections)], np.int64),
        boxes=boxes,
        score=np.asarray(detections.score[best], np.float32),
        truths=np.array([n], np.int64),
        truth=truth.array.astype(np.float32),
        label=truth.label,
        object_id=truth.object_id,
        points=np.full((n, 4), -1, np.int32) if points is None else np.asarray(points, np.int32),
        ego_share=np.full(n, np.nan, np.float32) if ego_share is None else np.asarray(ego_share, np.float32),
    )


def join_tables(parts: Sequence[DetectionTable]) -> DetectionTable:
    """Table of the frames of all parts, in their order."""
    joined: dict[str, Any] = {}
    for name, (_, width) in _COLUMNS.items():
        none = np.zeros(0 if width is None else (0, width), _IN_MEMORY.get(name, np.int64))
        joined[name] = np.concatenate([none, *(getattr(part, name) for part in parts)])
    return DetectionTable(**joined)


def read_table(path: Path, arrays: Mapping[str, NDArray], hint: str = "") -> DetectionTable:
    """Table of stored columns, each checked.

    Args:
        path: file of the columns, for messages.
        arrays: by name, see `DetectionTable.arrays`.

    Raises:
        DataError: a column is missing, or has a wrong kind, shape or value; names file and column.
    """

    def wrong(name: str, expected: str, found: object) -> DataError:
        return DataError(complaint(path, name, expected, found, hint))

    columns: dict[str, Any] = {}
    for name, (kind, width) in _COLUMNS.items():
        column = arrays.get(name)
        if column is None or not np.can_cast(column.dtype, kind):
            raise wrong(name, f"an array of {np.dtype(kind)}", "none" if column is None else str(column.dtype))
        if len(column.shape) != (1 if width is None else 2) or (width is not None and column.shape[1] != width):
            raise wrong(name, "shape (n,)" if width is None else f"shape (n, {width})", str(column.shape))
        if len(column) > MOST_ROWS:
            raise wrong(name, f"at most {MOST_ROWS} rows", len(column))
        columns[name] = column.astype(_IN_MEMORY.get(name, np.int64))
    for name, least in (("position", 0), ("found", 0), ("truths", 0), ("points", -1)):
        if (columns[name] < least).any():
            raise wrong(name, f"numbers of at least {least}", int(columns[name].min()))
    rows = {"frames": len(columns["position"])}
    rows |= {"detections": int(columns["found"].sum()), "true boxes": int(columns["truths"].sum())}
    for name, column in columns.items():
        per = "frames" if name in _PER_FRAME else "detections" if name in _PER_DETECTION else "true boxes"
        if len(column) != rows[per]:
            raise wrong(name, f"one row for each of {rows[per]} {per}", len(column))
    for name in ("boxes", "truth", "score"):
        if not np.isfinite(columns[name]).all():
            raise wrong(name, "finite numbers", "NaN or infinity")
    for name in ("boxes", "truth"):
        if len(columns[name]) and not (columns[name][:, 3:6] > 0).all():
            raise wrong(name, "positive sizes", f"{columns[name][:, 3:6].min():g} m")
    score = columns["score"]
    if len(score) and not 0.0 <= score.min() <= score.max() <= 1.0:
        raise wrong("score", "0 to 1", f"{score.min():g} to {score.max():g}")
    first = np.zeros(len(score) + 1, bool)
    first[np.cumsum(columns["found"]) - columns["found"]] = True
    if ((score[1:] > score[:-1]) & ~first[1:-1]).any():
        raise wrong("score", "the best first in each frame", "another order")
    if (columns["label"] >= len(CLASSES)).any():
        raise wrong("label", f"numbers below {len(CLASSES)}", int(columns["label"].max()))
    return DetectionTable(**columns)


def read_table_file(path: Path, hint: str = "") -> DetectionTable:
    """Table of a file of columns, other arrays beside them ignored; raises as `read_table`."""
    return read_table(path, read_arrays(path, "table of detections"), hint)


def _rows(counts: NDArray[np.int64]) -> list[slice]:
    """Return the rows of each of F groups."""
    ends = np.cumsum(counts).tolist()
    return [slice(end - count, end) for end, count in zip(ends, counts.tolist(), strict=True)]


def points_left(clean: Frame, corrupted: Frame) -> NDArray[np.int32]:
    """(A, N) points that each agent has on each object in a corrupted frame, where it believes them to be.

    Points of our own sweeps know their object; those of other tools' are counted in the boxes, at least 1 where the
    annotation says that a ray hit, as in `Frame.points_on`, and a point is left.

    Args:
        corrupted: the same with other sweeps.
    """
    left = clean.points_on.copy()
    for row, (before, after) in enumerate(zip(clean.agents, corrupted.agents, strict=True)):
        if after.sweep is before.sweep:
            continue
        if (before.sweep.object_id >= 0).any():
            left[row] = count_points(after.sweep, clean.truth.object_id)
            continue
        _, boxes = points_in_boxes(clean.truth, after.sweep.points, after.sweep.world_from_lidar)
        counts = np.bincount(boxes, minlength=len(clean.truth))
        left[row] = np.where(clean.points_on[row] > 0, counts, 0)
    return left


def points_table(
    clean: Frame, left: NDArray[np.int32], agent_ids: Sequence[int], object_ids: NDArray[np.int64]
) -> NDArray[np.int32]:
    """(N, 4) points on objects: the ego's, all agents', and both after the corruption.

    Args:
        left: see `points_left`.
        agent_ids: agents that take part, the ego first.
        object_ids: (N,) objects of the frame.
    """
    ids = [agent.agent_id for agent in clean.agents]
    agents = np.array([ids.index(agent_id) for agent_id in agent_ids], np.int64)
    objects = np.searchsorted(clean.truth.object_id, object_ids)
    counts = [counts[np.ix_(agents, objects)] for counts in (clean.points_on, left)]
    return np.stack([table for count in counts for table in (count[0], count.sum(axis=0))], axis=1).astype(np.int32)
