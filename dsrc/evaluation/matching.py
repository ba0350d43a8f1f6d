"""Matching detections to ground truth in one frame, by the rule of the OpenCOOD tools."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Match(NamedTuple):
    """The outcome for the D detections of one frame, best first.

    Attributes:
        truth: (D,) int64 row of the matched ground truth, -1 for a false positive.
        order: (D,) int64 row of the detection: `truth[i]` is the fate of detection `order[i]`.
    """

    truth: NDArray[np.int64]
    order: NDArray[np.int64]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(D,) true positives, best detection first."""
        return self.truth >= 0


def match(iou: NDArray[np.floating], scores: NDArray[np.floating], threshold: float) -> Match:
    """Let each detection, best first, take the ground truth that it overlaps most of those still free.

    It is a true positive when that overlap reaches the threshold. (VOC differs: there a detection whose best ground
    truth is taken is false even if it overlaps another one enough.)

    Args:
        iou: (D, N) overlaps.
        scores: (D,).
        threshold: least IoU of a match.
    """
    order = np.argsort(-scores, kind="stable")
    truth = np.full(len(order), -1, np.int64)
    if iou.shape[1] == 0:
        return Match(truth, order)
    free = np.array(iou, np.float64)
    for place in np.flatnonzero(free.max(axis=1)[order] >= threshold):
        row = order[place]
        best = int(free[row].argmax())
        if free[row, best] >= threshold:
            truth[place] = best
            free[:, best] = -1.0
    return Match(truth, order)
