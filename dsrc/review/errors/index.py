"""ErrorIndex: every error of a run in columns, the worst first, and the frames with the most of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.detection_table import join_tables
from dsrc.evaluation.metrics.ap import Curve
from dsrc.review.errors.filters import FN, FP, KINDS, POOR, ErrorFilter
from dsrc.review.errors.judged import UNKNOWN, Counts, JudgedRun
from dsrc.review.sources.base import Setup
from sim.rows import Rows

POOR_IOU = 0.7
"""IoU below which a true positive is poor."""
_CLEAR_POINTS = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable(Rows):
    """E errors of a run, a row each.

    Attributes:
        kind: (E,) uint8 `FN`, `FP` or `POOR`.
        method: (E,) int64 row in `methods`.
        row: (E,) int64 frame in its source.
        frame: (E,) int64 number of the frame.
        ego_id: (E,) int64 agent that detects.
        box: (E, 7) float32 x, y, z, l, w, h, yaw in the ego LiDAR's frame: of the object, or of a false detection.
        score: (E,) float32 of the detection; of a missed object that of a match below the threshold, NaN without one.
        iou: (E,) float64 of detection and object, of the pair that overlaps most where there is no match.
        label: (E,) int64 class of the object, -1 without one.
        object_id: (E,) int64; of a false detection the object that it overlaps most, -1 without one.
        rank: (E,) int64 place of the detection in its frame, best first; -1 without one.
        distance_m: (E,) float64 from the ego's LiDAR in the plane.
        points: (E, 4) int32 on the object, see `DetectionTable`; -1 without one.
        seen_by: (E,) uint8 who has points on the object, see `Frame.seen_by`; `UNKNOWN` without one.
        loss: (E,) float64 see `error_loss`.
        methods: names of the sets.
        conditions: titles of their conditions.
        setups: of their detections.
    """

    SHARED: ClassVar = ("methods", "conditions", "setups")

    kind: NDArray[np.uint8]
    method: NDArray[np.int64]
    row: NDArray[np.int64]
    frame: NDArray[np.int64]
    ego_id: NDArray[np.int64]
    box: NDArray[np.float32]
    score: NDArray[np.float32]
    iou: NDArray[np.float64]
    label: NDArray[np.int64]
    object_id: NDArray[np.int64]
    rank: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    points: NDArray[np.int32]
    seen_by: NDArray[np.uint8]
    loss: NDArray[np.float64]
    methods: tuple[str, ...]
    conditions: tuple[str, ...]
    setups: tuple[Setup, ...]

    def worst_first(self) -> "ErrorTable":
        """Errors by falling loss; equal ones by frame, kind and distance."""
        return self[np.lexsort((self.distance_m, self.kind, self.row, -self.loss))]

    def in_order(self) -> "ErrorTable":
        """Errors by frame, those of a frame the worst first."""
        return self[np.lexsort((self.distance_m, self.kind, -self.loss, self.row))]


@dataclass(frozen=True, slots=True, eq=False)
class FrameRanking:
    """Frames of a run, the worst first.

    Attributes:
        row: (F,) int64 frame in its source.
        loss: (F,) float64 sum of its errors' losses.
        missed, false, poor: (F,) int64 errors of each kind.
    """

    row: NDArray[np.int64]
    loss: NDArray[np.float64]
    missed: NDArray[np.int64]
    false: NDArray[np.int64]
    poor: NDArray[np.int64]


def error_loss(
    kind: NDArray[np.uint8], score: NDArray[np.float32], iou: NDArray[np.float64], points_left: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(E,) loss of errors, 0 to 2: how little excuse there is.

    A missed object has 1, and up to 1 more the more points are left on it; a false detection twice its score; a poor
    one what its IoU lacks to 1.
    """
    seen = np.maximum(points_left, 0)
    missed = 1.0 + seen / (seen + _CLEAR_POINTS)
    return np.where(kind == FN, missed, np.where(kind == FP, 2.0 * np.nan_to_num(score), 1.0 - iou)).astype(np.float64)


class ErrorIndex:
    """Errors of one or more methods over the same run.

    Attributes:
        runs: by name of the method.

    Raises:
        ValueError: two runs have one name.
    """

    def __init__(self, runs: Sequence[JudgedRun]) -> None:
        self.runs: Mapping[str, JudgedRun] = {run.method: run for run in runs}
        if len(self.runs) < len(runs):
            raise ValueError("two runs have one name")

    def errors(self, threshold: float, iou: float, only: ErrorFilter | None = None) -> ErrorTable:
        """Errors, the worst first."""
        only, names = only or ErrorFilter(), list(self.runs)
        runs = [(0, JudgedRun("", Setup(), join_tables([]))), *((names.index(n), run) for n, run in self._asked(only))]
        tables = [_columns(run, number, threshold, iou, only) for number, run in runs]
        columns: dict[str, Any] = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
        setups = tuple(run.setup for run in self.runs.values())
        conditions = tuple(setup.condition.label for setup in setups)
        return ErrorTable(**columns, methods=tuple(names), conditions=conditions, setups=setups).worst_first()

    def counts(self, threshold: float, iou: float, only: ErrorFilter | None = None) -> dict[str, Counts]:
        """Counts of TP, FP and FN of each method among the objects of a filter."""
        only = only or ErrorFilter()
        return {
            name: run.counts(threshold, iou, only.objects(run), only.places(run)) for name, run in self._asked(only)
        }

    def curves(self, iou: float, only: ErrorFilter | None = None) -> dict[str, Curve]:
        """Precision over recall of each method among the objects of a filter, with the average precision."""
        only = only or ErrorFilter()
        return {name: run.curve(iou, only.objects(run), only.places(run)) for name, run in self._asked(only)}

    def _asked(self, only: ErrorFilter) -> list[tuple[str, JudgedRun]]:
        return [(name, run) for name, run in self.runs.items() if not only.methods or name in only.methods]


def _columns(run: JudgedRun, number: int, threshold: float, iou: float, only: ErrorFilter) -> dict[str, NDArray]:
    """Columns of the errors of a run, whose method has a number."""
    table, matches = run.table, run.at(iou)
    found, objects = run.found(threshold, iou), only.objects(run)
    missed = np.flatnonzero(~found & objects)
    false = np.flatnonzero((table.score >= threshold) & (matches.matched < 0) & only.places(run))
    hits = np.flatnonzero(found & objects)
    overlap = run.iou_with(matches.found_by[hits], hits)
    poor, poor_overlap = hits[overlap < POOR_IOU], overlap[overlap < POOR_IOU]

    score = np.append(table.score, np.float32(np.nan))
    rank = np.append(run.rank, -1)
    truth = np.concatenate([missed, poor])
    by = matches.found_by[truth]
    near = run.nearest[false]
    points = np.concatenate([table.points, np.full((1, 4), -1, np.int32)])
    kind = np.repeat(np.array([FN, POOR, FP], np.uint8), [len(missed), len(poor), len(false)])
    frame = np.concatenate([run.truth_frame_of[truth], run.frame_of[false]])
    errors = {
        "kind": kind,
        "method": np.full(len(kind), number, np.int64),
        "row": table.position[frame],
        "frame": table.index[frame],
        "ego_id": table.ego_id[frame],
        "box": np.concatenate([table.truth[truth], table.boxes[false]]),
        "score": np.concatenate([score[by], table.score[false]]),
        "iou": np.concatenate([_missed_iou(run, missed, matches.found_by), poor_overlap, run.nearest_iou[false]]),
        "label": np.concatenate([table.label[truth], np.append(table.label, -1)[near]]),
        "object_id": np.concatenate([table.object_id[truth], np.append(table.object_id, -1)[near]]),
        "rank": np.concatenate([rank[by], run.rank[false]]),
        "distance_m": np.concatenate([run.truth_distance_m[truth], run.distance_m[false]]),
        "points": np.concatenate([table.points[truth], points[near]]),
        "seen_by": np.concatenate([run.visibility[truth], np.append(run.visibility, np.uint8(UNKNOWN))[near]]),
    }
    errors["loss"] = error_loss(kind, errors["score"], errors["iou"], errors["points"][:, 3])
    kept = np.isin(kind, [KINDS.index(name) for name in only.kinds])
    if only.classes or only.seen_by:
        # A false detection has the properties of the object that it overlaps most.
        kept[kind == FP] &= np.append(objects, False)[near]
    return {name: column[kept] for name, column in errors.items()}


def _missed_iou(run: JudgedRun, missed: NDArray[np.int64], found_by: NDArray[np.int64]) -> NDArray[np.float64]:
    """IoU of missed objects with their match below the threshold, else the largest with any detection."""
    by = found_by[missed]
    iou = run.best_iou[missed].copy()
    iou[by >= 0] = run.iou_with(by[by >= 0], missed[by >= 0])
    return iou


def worst_frames(errors: ErrorTable, rows: NDArray[np.int64]) -> FrameRanking:
    """Frames by falling loss.

    Args:
        rows: (F,) frames of the run in its source, ascending; those without errors are at the end.
    """
    place = np.searchsorted(rows, errors.row)
    loss = np.bincount(place, errors.loss, len(rows)).astype(np.float64)
    kinds = [np.bincount(place[errors.kind == kind], minlength=len(rows)) for kind in (FN, FP, POOR)]
    order = np.argsort(-loss, kind="stable")
    missed, false, poor = (count[order].astype(np.int64) for count in kinds)
    return FrameRanking(rows[order], loss[order], missed, false, poor)


def next_error(errors: ErrorTable, row: int, after: int = -1, step: int = 1) -> int | None:
    """Next error from a place on the timeline, a row of `errors`; None when there is none.

    Args:
        errors: in the order of the frames, see `ErrorTable.in_order`.
        after: the selected error, a row of `errors`; -1 for none: then those of the frame itself come first.
        step: 1 for the next, -1 for the one before.
    """
    places = np.arange(len(errors))
    if step > 0:
        ahead = places > after if after >= 0 else errors.row >= row
    else:
        ahead = places < after if after >= 0 else errors.row <= row
    found = np.flatnonzero(ahead)
    return None if not len(found) else int(found[0 if step > 0 else -1])


def changes(
    before: JudgedRun, after: JudgedRun, threshold: float, iou: float, only: ErrorFilter | None = None
) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Objects of both runs that the first alone finds, and those that the second alone does, by frame and id.

    Args:
        only: objects of the second run to look at; None for all.
    """
    both = before.keys() & after.keys(None if only is None else only.objects(after))
    had, has = (run.keys(run.found(threshold, iou)) & both for run in (before, after))
    return had - has, has - had
