"""Which points lie in which boxes: many points, many boxes, each point near few of them."""

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.geometry import transform_points

SLACK_M = 1e-9
"""That of `Boxes.contains`."""


def points_in_boxes(
    boxes: Boxes,
    points: NDArray[np.float32],
    boxes_from_points: NDArray[np.float64] | None = None,
    margin: float = 0.0,
    hull: bool = False,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find every pair of a point and a box that it lies in, faces included, as `Boxes.contains` has it.

    Args:
        boxes: N boxes.
        points: (P, 3 or more) x, y, z, m.
        boxes_from_points: (4, 4) from the points' frame to the boxes'; None where they are one.
        margin: grow every face outwards by this, m.
        hull: take the boxes' axis-aligned hulls, as they are, compared in float32 so that a face means the
            same for both.

    Returns:
        (K,) rows of the points, ascending, and (K,) those of their boxes.
    """
    matrix = np.eye(4) if boxes_from_points is None else boxes_from_points
    corners = boxes.corners()
    if hull:
        corners = corners.astype(np.float32).astype(np.float64)
    low, high = corners.min(axis=1), corners.max(axis=1)
    reach = 0.5 * boxes.size + margin + SLACK_M
    try:
        from dsrc.data import kernel
    except ImportError:
        place = transform_points(matrix, points[:, :3].astype(np.float64))
        inside = [((place >= a) & (place <= b)).all(axis=1) for a, b in zip(low, high, strict=True)] if hull else []
        mask = np.reshape(inside, (len(boxes), len(points))) if hull else boxes.contains(place, margin)
        rows, owners = np.nonzero(mask.T)
        return rows, owners
    turn = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)
    found, pairs = len(points), np.zeros((0, 2), np.int32)
    while found > len(pairs):
        pairs = np.zeros((found, 2), np.int32)
        found = kernel.pairs_inside(points, matrix, low, high, margin, boxes.center, reach, turn, hull, pairs)
    return pairs[:found, 0].astype(np.intp), pairs[:found, 1].astype(np.intp)
