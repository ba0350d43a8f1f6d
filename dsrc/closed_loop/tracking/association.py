"""Association of detections with tracks, and duplicates."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dsrc.ops.iou import bev_iou

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


def squared_distances(offset: Array, variance: Array) -> Array:
    """Return (...) squared Mahalanobis distances of offsets (..., 2), m, of covariances (..., 2, 2), m2."""
    return _squared(offset[..., 0], offset[..., 1], variance[..., 0, 0], variance[..., 1, 1], variance[..., 0, 1])


def pair_distances(mean: Array, covariance: Array, points: Array, variance: Array) -> Array:
    """Return (N, M) squared Mahalanobis distances of every point from every mean.

    Args:
        mean: (N, 2) m.
        covariance: (N, 2, 2) of the means, m2.
        points: (M, 2) m.
        variance: (M, 2, 2) of the points, m2.
    """
    x, y = (points[None, :, axis] - mean[:, None, axis] for axis in (0, 1))
    xx, yy, xy = (covariance[:, None, a, b] + variance[None, :, a, b] for a, b in ((0, 0), (1, 1), (0, 1)))
    return _squared(x, y, xx, yy, xy)


def _squared(x: Array, y: Array, xx: Array, yy: Array, xy: Array) -> Array:
    return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


def assigned(cost: Array, allowed: NDArray[np.bool_], limit: float) -> tuple[Rows, Rows]:
    """Return rows and columns of the pairs of the cheapest assignment.

    A track or a detection without a partner costs `limit` per pair that it could have made, so a pair that is not
    allowed costs as much as none: it can neither be chosen nor displace another.

    Args:
        cost: (N, M) not negative, below `limit` where allowed.
        allowed: (N, M) pairs inside the gate.
    """
    rows, columns = linear_sum_assignment(np.where(allowed, cost, limit))
    inside = allowed[rows, columns]
    return rows[inside], columns[inside]


def overlaps(a: Array, b: Array, alike: NDArray[np.bool_], iou: float) -> NDArray[np.bool_]:
    """Return the (N, M) mask of boxes a (N, 7) and b (M, 7) of one kind whose footprints overlap by `iou` or more.

    Args:
        a: x, y, z, l, w, h, yaw.
        b: the same.
        alike: (N, M) pairs of one kind.
    """
    out = np.zeros(alike.shape, bool)
    # The distance of the centres first, then their line as a separating axis: few pairs of a scene are left.
    reach = 0.5 * (np.hypot(a[:, 3], a[:, 4])[:, None] + np.hypot(b[:, 3], b[:, 4])[None, :])
    x, y = b[None, :, 0] - a[:, None, 0], b[None, :, 1] - a[:, None, 1]
    rows, columns = np.nonzero(alike & (x * x + y * y < reach * reach))
    if len(rows):
        x, y = x[rows, columns], y[rows, columns]
        touching = x * x + y * y <= _reach(a[rows], x, y) + _reach(b[columns], x, y)
        rows, columns = rows[touching], columns[touching]
    if len(rows):
        near_rows, row = np.unique(rows, return_inverse=True)
        near_columns, column = np.unique(columns, return_inverse=True)
        out[rows, columns] = bev_iou(a[near_rows], b[near_columns])[row, column] >= iou
    return out


def centred(a: Array, b: Array) -> NDArray[np.bool_]:
    """Return the (N, M) mask of boxes a (N, 7) and b (M, 7) of which one has the other's centre in its footprint."""
    offset = b[None, :, :2] - a[:, None, :2]
    return _holds(a[:, None], offset) | _holds(b[None, :], -offset)


def _holds(box: Array, offset: Array) -> NDArray[np.bool_]:
    """Return whether points at offsets (..., 2) from the centres of boxes (..., 7) lie in their footprints."""
    c, s = np.cos(box[..., 6]), np.sin(box[..., 6])
    along, across = c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]
    return np.asarray((np.abs(along) <= 0.5 * box[..., 3]) & (np.abs(across) <= 0.5 * box[..., 4]))


def _reach(box: Array, x: Array, y: Array) -> Array:
    """Return (K,) half extents of boxes (K, 7) along vectors (K,), times the vectors' lengths."""
    c, s = np.cos(box[:, 6]), np.sin(box[:, 6])
    return 0.5 * (box[:, 3] * np.abs(c * x + s * y) + box[:, 4] * np.abs(c * y - s * x))


def originals(same: NDArray[np.bool_]) -> Rows:
    """Return the rows of which no kept earlier row is the same; rows (N, N) of `same` are in order of preference."""
    drop = np.zeros(len(same), bool)
    for row in np.flatnonzero(np.triu(same, 1).any(axis=1)):
        if not drop[row]:
            drop[row + 1 :] |= same[row, row + 1 :]
    return np.flatnonzero(~drop)
