"""Matching detections to ground truth in one frame, by the rule of the OpenCOOD tools."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Match(NamedTuple):
    """Match of the D detections of one frame, most confident first.

    Attributes:
        truth: (D,) int64 row of the matched true box, -1 for a false positive.
        order: (D,) int64 row of the detection: `truth[i]` belongs to detection `order[i]`.
    """

    truth: NDArray[np.int64]
    order: NDArray[np.int64]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(D,) true positives, best detection first."""
        return self.truth >= 0


def match(iou: NDArray[np.floating], scores: NDArray[np.floating], threshold: float) -> Match:
    """Match detections, most confident first, each with the free true box that it overlaps most.

    It is a true positive when that overlap reaches the threshold. (VOC differs: there a detection whose best true box
    is taken is false even if it overlaps another one enough.)

    Args:
        iou: (D, N) overlaps.
        scores: (D,).
        threshold: least IoU of a match.
    """
    order = np.argsort(-scores, kind="stable")
    ranked = np.asarray(iou)[order]
    place, truth = np.nonzero(ranked >= threshold)
    best_first = np.lexsort((-ranked[place, truth], place))
    return Match(match_greedily(place[best_first], truth[best_first], len(order)), order)


def match_greedily(place: NDArray[np.integer], truth: NDArray[np.integer], places: int) -> NDArray[np.int64]:
    """Match pairs greedily: (places,) int64 true box of each detection, -1 for none.

    Args:
        place: (K,) detections of the pairs that overlap enough, ascending.
        truth: (K,) true boxes of the pairs; those of one detection by overlap, descending.
    """
    matched = np.full(places, -1, np.int64)
    taken: set[int] = set()
    served = -1
    # Pairs that overlap enough are few, and an array of Python's own is quicker to walk through than numpy's.
    for detection, box in zip(place.tolist(), truth.tolist(), strict=True):
        if detection != served and box not in taken:
            matched[detection] = box
            taken.add(box)
            served = detection
    return matched
