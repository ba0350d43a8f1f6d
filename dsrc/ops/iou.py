"""Overlap of rotated boxes: bird's-eye and 3D intersection over union, and non-maximum suppression."""

import numpy as np
import powerboxes
from numpy.typing import ArrayLike, NDArray

# powerboxes is wrong (negative and NaN areas included) where edges of two boxes coincide exactly, as those of equal
# boxes do. Moving one set by 0.03 micrometres avoids that, in 8.4 million coincident pairs, for an error below 1e-6.
_NUDGE = np.array([3.1e-8, 1.7e-8, 0.0, 0.0, 1.3e-6])


def bev_iou(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return (n, m) float64 IoU of the footprints of boxes a (n, 7) and b (m, 7), x, y, z, l, w, h, yaw.

    The IoU of a box without area, or with a number that is not finite, is 0.
    """
    a, b = _rows(a), _rows(b)
    out = np.zeros((len(a), len(b)))
    rows, columns = np.flatnonzero(_has_area(a)), np.flatnonzero(_has_area(b))
    if len(rows) and len(columns):
        # About a common origin near the boxes: world coordinates of kilometres would cost digits.
        origin = a[rows[0], :2]
        nudged = _footprint(b[columns], origin) + _NUDGE
        distance = powerboxes.rotated_iou_distance(_footprint(a[rows], origin), nudged)
        out[np.ix_(rows, columns)] = np.clip(1.0 - distance, 0.0, 1.0)
    return out


def paired_volume_iou(
    a: NDArray[np.float64], b: NDArray[np.float64], footprint_iou: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (k,) IoU of the volumes of upright boxes a (k, 7) and b (k, 7) whose footprints overlap by (k,)."""
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    shared_area = footprint_iou * (area_a + area_b) / (1.0 + footprint_iou)
    top = np.minimum(a[:, 2] + 0.5 * a[:, 5], b[:, 2] + 0.5 * b[:, 5])
    bottom = np.maximum(a[:, 2] - 0.5 * a[:, 5], b[:, 2] - 0.5 * b[:, 5])
    shared = shared_area * np.maximum(top - bottom, 0.0)
    union = area_a * a[:, 5] + area_b * b[:, 5] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=(shared > 0) & (union > 0))


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


def _rows(boxes: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(boxes, np.float64).reshape(-1, 7)


def _has_area(boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.isfinite(boxes).all(axis=1) & (boxes[:, 3] > 0) & (boxes[:, 4] > 0)


def _footprint(boxes: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 5) x, y, l, w and yaw in degrees."""
    return np.column_stack([boxes[:, :2] - origin, boxes[:, 3:5], np.degrees(boxes[:, 6])])
