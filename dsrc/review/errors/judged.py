"""JudgedRun: detections of a method over a run, or in a frame, matched once; a threshold only moves the cut."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.detection_table import DetectionTable
from dsrc.evaluation.metrics.ap import Curve, Pairs, curve_of, overlapping_pairs
from dsrc.review.sources.base import Setup
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY
from sim.boxes import Boxes

UNKNOWN = 255
"""Visibility where the points on objects are unknown."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of true positives, false positives and false negatives."""

    tp: int = 0
    fp: int = 0
    fn: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(self.tp + other.tp, self.fp + other.fp, self.fn + other.fn)

    @property
    def precision(self) -> float | None:
        """TP / (TP + FP); None without detections."""
        total = self.tp + self.fp
        return self.tp / total if total else None

    @property
    def recall(self) -> float | None:
        """TP / (TP + FN); None without objects."""
        total = self.tp + self.fn
        return self.tp / total if total else None


class RunMatches(NamedTuple):
    """Matches of D detections and N true boxes of a run at one IoU, for any threshold of the score.

    Matching is greedy by score: a higher threshold cuts the list and changes nothing before the cut.

    Attributes:
        matched: (D,) int64 row of the true box that each detection hits, -1 for a false positive.
        found_by: (N,) int64 row of the detection of each true box, -1 without one.
    """

    matched: NDArray[np.int64]
    found_by: NDArray[np.int64]


class JudgedRun:
    """Detections of a method under a setup, with everything that tells a right one from a wrong one.

    Attributes:
        method: name of the set.
        setup: of the detections.
        table: detections and true boxes.
        frame_of: (D,) int64 frame of each detection, a row of the table.
        rank: (D,) int64 place of each detection in its frame, best first.
        truth_frame_of: (N,) int64 frame of each true box.
        nearest: (D,) int64 row of the true box that each detection overlaps most, -1 without overlap.
        nearest_iou: (D,) float64 bird's-eye IoU with it.
        best_iou: (N,) float64 largest IoU of each true box with any detection.
    """

    def __init__(self, method: str, setup: Setup, table: DetectionTable) -> None:
        self.method, self.setup, self.table = method, setup, table
        frames = np.arange(len(table))
        self.frame_of = np.repeat(frames, table.found)
        self.truth_frame_of = np.repeat(frames, table.truths)
        self.rank = np.arange(len(table.score)) - np.repeat(np.cumsum(table.found) - table.found, table.found)
        results = table.results()
        found, truth = [r.detections.boxes.array for r in results], [r.truth.array for r in results]
        self._pairs: Pairs = overlapping_pairs(found, truth).ranked()
        self.nearest = np.full(len(table.score), -1, np.int64)
        self.nearest_iou = np.zeros(len(table.score))
        at, truth_row, iou = self._pairs
        first = np.append(True, np.diff(at) > 0) if len(at) else np.zeros(0, bool)
        self.nearest[at[first]], self.nearest_iou[at[first]] = truth_row[first], iou[first]
        self.best_iou = np.zeros(len(table.truth))
        np.maximum.at(self.best_iou, truth_row, iou)
        self._at: dict[float, RunMatches] = {}

    def at(self, iou: float) -> RunMatches:
        """Matches at a positive IoU, cached."""
        if iou not in self._at:
            matched = self._pairs.matched(iou, len(self.table.score))
            found_by = np.full(len(self.table.truth), -1, np.int64)
            hit = np.flatnonzero(matched >= 0)
            found_by[matched[hit]] = hit
            self._at[iou] = RunMatches(matched, found_by)
        return self._at[iou]

    def keys(self, among: NDArray[np.bool_] | None = None) -> set[tuple[int, int]]:
        """Frames in the source and ids of true boxes, those of unknown ids, -1, left out.

        Args:
            among: (N,) mask of these boxes; None for all.
        """
        known = (self.table.object_id >= 0) & (True if among is None else among)
        rows = self.table.position[self.truth_frame_of[known]]
        return set(zip(rows.tolist(), self.table.object_id[known].tolist(), strict=True))

    def kept(self, threshold: float) -> int:
        """Number of detections that reach a threshold: of one frame they are the first."""
        return int(np.count_nonzero(self.table.score >= threshold))

    def found(self, threshold: float, iou: float) -> NDArray[np.bool_]:
        """(N,) true boxes hit by a detection that reaches the threshold."""
        by = self.at(iou).found_by
        return (by >= 0) & (np.append(self.table.score, np.float32(-1.0))[by] >= threshold)

    def iou_with(self, rows: NDArray[np.int64], truth: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K,) IoU of detections with true boxes of the same frames; 0 without overlap."""
        count = max(len(self.table.truth), 1)
        keys = self._pair_keys
        wanted = rows * count + truth
        place = np.minimum(np.searchsorted(keys[0], wanted), max(len(keys[0]) - 1, 0))
        if not len(keys[0]):
            return np.zeros(len(rows))
        return np.where(keys[0][place] == wanted, keys[1][place], 0.0)

    def nearest_at(self, iou: float, row: int) -> tuple[int, float]:
        """Row of the true box that a detection hits, else of the one that it overlaps most, -1 without, and the IoU."""
        hit = int(self.at(iou).matched[row])
        if hit < 0:
            return int(self.nearest[row]), float(self.nearest_iou[row])
        return hit, float(self.iou_with(np.array([row]), np.array([hit]))[0])

    @cached_property
    def boxes(self) -> Boxes:
        """The detections, each in the frame of its ego's LiDAR."""
        return Boxes.from_array(self.table.boxes)

    @cached_property
    def truth(self) -> Boxes:
        """The true boxes, alike."""
        return Boxes.from_array(self.table.truth, self.table.label, self.table.object_id)

    @cached_property
    def _pair_keys(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Sorted numbers of the overlapping pairs, and their IoU."""
        key = self._pairs.detection * max(len(self.table.truth), 1) + self._pairs.truth
        order = np.argsort(key)
        return key[order], self._pairs.iou[order]

    @cached_property
    def distance_m(self) -> NDArray[np.float64]:
        """(D,) distance of each detection from the ego's LiDAR in the plane, m."""
        return np.hypot(*self.table.boxes[:, :2].T.astype(np.float64))

    @cached_property
    def truth_distance_m(self) -> NDArray[np.float64]:
        """(N,) the same of each true box."""
        return np.hypot(*self.table.truth[:, :2].T.astype(np.float64))

    @cached_property
    def visibility(self) -> NDArray[np.uint8]:
        """(N,) who has points on each true box before the corruption: values of `Frame.seen_by`, or `UNKNOWN`."""
        ego, everyone = self.table.points[:, 0], self.table.points[:, 1]
        seen = np.where(ego > 0, BY_EGO, np.where(everyone > 0, BY_HELPER, BY_NOBODY))
        return np.where(everyone < 0, UNKNOWN, seen).astype(np.uint8)

    def counts(
        self,
        threshold: float,
        iou: float,
        among: NDArray[np.bool_] | None = None,
        asked: NDArray[np.bool_] | None = None,
    ) -> Counts:
        """Counts of the run.

        Args:
            among: (N,) true boxes to count; detections of the others count neither way. None for all.
            asked: (D,) detections whose false positives count. None for all.
        """
        hit, score, truths = self.ranked(iou, among, asked)
        kept = score >= threshold
        tp = int(np.count_nonzero(hit & kept))
        return Counts(tp, int(np.count_nonzero(kept)) - tp, truths - tp)

    def curve(
        self, iou: float, among: NDArray[np.bool_] | None = None, asked: NDArray[np.bool_] | None = None
    ) -> Curve:
        """Precision over recall with the average precision, as `dsrc evaluate` has it; arguments as of `counts`."""
        return curve_of(*self.ranked(iou, among, asked))

    def ranked(
        self, iou: float, among: NDArray[np.bool_] | None = None, asked: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], int]:
        """Hits and scores of the detections that count, and the number of true boxes that do."""
        matched = self.at(iou).matched
        if among is None and asked is None:
            return matched >= 0, self.table.score, len(self.table.truth)
        counted = np.ones(len(matched), bool) if asked is None else asked | (matched >= 0)
        truths = len(self.table.truth)
        if among is not None:
            counted &= (matched < 0) | np.append(among, False)[matched]
            truths = int(np.count_nonzero(among))
        return matched[counted] >= 0, self.table.score[counted], truths
