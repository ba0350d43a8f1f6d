"""Matching of the detections of one frame with its ground truth, at one IoU and any score threshold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.matching import match as match_by_score
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from sim.boxes import Boxes


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


@dataclass(frozen=True, slots=True, eq=False)
class RankedMatches:
    """Matches of one frame at one IoU, in order of the score.

    Matching is greedy by score: a higher threshold cuts the list and changes nothing before the cut.

    Attributes:
        score: (N,) float32 descending.
        tp: (N,) bool, True for a true positive.
        found_by: (M,) int64 row of the detection matched with each object, -1 without one.
        nearest: (N,) int64 row of the matched object, for a false positive of the one most overlapped, -1 without.
        overlap: (N,) float64 bird's-eye IoU with that object.
    """

    score: NDArray[np.float32]
    tp: NDArray[np.bool_]
    found_by: NDArray[np.int64]
    nearest: NDArray[np.int64]
    overlap: NDArray[np.float64]

    def kept(self, threshold: float) -> int:
        """Number of detections that reach the threshold."""
        return int(np.count_nonzero(self.score >= threshold))

    def found(self, threshold: float) -> NDArray[np.bool_]:
        """(M,) mask of the objects matched by a detection that reaches the threshold."""
        return (self.found_by >= 0) & (self.found_by < self.kept(threshold))

    def counts(self, threshold: float) -> Counts:
        """Numbers of TP, FP and FN at a threshold."""
        kept = self.kept(threshold)
        tp = int(np.count_nonzero(self.tp[:kept]))
        return Counts(tp, kept - tp, len(self.found_by) - tp)


def ranked_matches(detections: Detections, truth: Boxes, iou: float) -> RankedMatches:
    """Match detections greedily by score, each with the unmatched object of the highest IoU.

    Args:
        detections: N detections in the frame of `truth`, best first.
        iou: least bird's-eye IoU of a true positive.
    """
    overlap = np.asarray(bev_iou(detections.boxes.array, truth.array), np.float64).reshape(len(detections), len(truth))
    partner = match_by_score(overlap, detections.score, iou).truth
    found_by = np.full(len(truth), -1, np.int64)
    found_by[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    most = overlap.argmax(axis=1) if len(truth) else np.zeros(len(detections), np.int64)
    nearest = np.where(partner >= 0, partner, most)
    shared = overlap[np.arange(len(detections)), nearest] if len(truth) else np.zeros(len(detections))
    return RankedMatches(
        detections.score, partner >= 0, found_by, np.where(shared > 0.0, nearest, -1).astype(np.int64), shared
    )
