"""Which detections of one frame are right, and which objects they miss, at one score and one IoU."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.matching import match as match_by_score
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from sim.boxes import Boxes


@dataclass(frozen=True, slots=True)
class Counts:
    """Detections right (TP), wrong (FP) and objects missed (FN)."""

    right: int = 0
    wrong: int = 0
    missed: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(self.right + other.right, self.wrong + other.wrong, self.missed + other.missed)

    @property
    def precision(self) -> float | None:
        """Share of the detections that are right; None without detections."""
        total = self.right + self.wrong
        return self.right / total if total else None

    @property
    def recall(self) -> float | None:
        """Share of the objects that are found; None without objects."""
        total = self.right + self.missed
        return self.right / total if total else None


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Detections of one frame, best first, matched with its truth at one IoU.

    Matching goes by score, so that a higher threshold cuts the list and changes nothing before the cut.

    Attributes:
        score: (N,) float32 descending.
        right: (N,) bool whether a detection has an object.
        found_by: (M,) int64 row of the detection that found each object, -1 for none.
    """

    score: NDArray[np.float32]
    right: NDArray[np.bool_]
    found_by: NDArray[np.int64]

    def kept(self, threshold: float) -> int:
        """Return how many detections reach the threshold."""
        return int(np.count_nonzero(self.score >= threshold))

    def found(self, threshold: float) -> NDArray[np.bool_]:
        """Return (M,) which objects are found by a detection that reaches the threshold."""
        return (self.found_by >= 0) & (self.found_by < self.kept(threshold))

    def counts(self, threshold: float) -> Counts:
        """Return the numbers of TP, FP and FN at a threshold."""
        kept = self.kept(threshold)
        right = int(np.count_nonzero(self.right[:kept]))
        return Counts(right, kept - right, len(self.found_by) - right)


def match(detections: Detections, truth: Boxes, iou: float) -> Matches:
    """Match detections, best score first, each with the free object that it overlaps most.

    Args:
        detections: N detections in the frame of `truth`, best first.
        truth: M boxes.
        iou: bird's-eye IoU from which a detection counts as right.
    """
    overlap = np.asarray(bev_iou(detections.boxes.array, truth.array), np.float64).reshape(len(detections), len(truth))
    partner = match_by_score(overlap, detections.score, iou).truth
    found_by = np.full(len(truth), -1, np.int64)
    found_by[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    return Matches(detections.score, partner >= 0, found_by)
