"""Non-maximum suppression of rotated boxes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dsrc.ops.iou import bev_iou


def rotated_nms(boxes: ArrayLike, scores: ArrayLike, iou: float, limit: int = 1000) -> NDArray[np.int64]:
    """Suppress boxes that overlap a better one.

    Args:
        boxes: (n, 7) x, y, z, l, w, h, yaw.
        scores: (n,) confidences.
        iou: footprint overlap with a better kept box above which a box is dropped.
        limit: number of best boxes that are considered.

    Returns:
        (k,) int64 rows of the kept boxes, best first; of equal scores the earlier row first.
    """
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    left = np.argsort(-np.asarray(scores), kind="stable")[:limit]
    half_diagonal = 0.5 * np.hypot(boxes[:, 3], boxes[:, 4])
    kept = []
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        # Footprints farther apart than their half diagonals together cannot touch.
        distance = np.hypot(*(boxes[left, :2] - boxes[best, :2]).T)
        near = distance <= half_diagonal[left] + half_diagonal[best]
        drop = np.zeros(len(left), bool)
        drop[near] = bev_iou(boxes[left[near]], boxes[best])[:, 0] > iou
        left = left[~drop]
    return np.array(kept, np.int64)
