"""Points in boxes: pairs of many points and many boxes, each point near few boxes."""

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes

SLACK_M = 1e-9
"""Tolerance of `Boxes.contains`."""


def points_in_boxes(
    boxes: Boxes,
    points: NDArray[np.float32],
    boxes_from_points: NDArray[np.float64] | None = None,
    margin: float = 0.0,
    hull: bool = False,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of a point and a box around it, faces included, equal to `Boxes.contains`.

    Args:
        points: (P, 3 or more) x, y, z, m.
        boxes_from_points: (4, 4) from the points' frame to the boxes'; None for one frame.
        margin: grow every face outwards by this, m.
        hull: take the boxes' axis-aligned hulls without margin, their faces rounded to float32 as the points are.

    Returns:
        (K,) rows of the points, ascending, and (K,) rows of their boxes.
    """
    matrix = np.eye(4) if boxes_from_points is None else boxes_from_points
    corners = boxes.corners()
    if hull:
        corners = corners.astype(np.float32).astype(np.float64)
    low, high = corners.min(axis=1), corners.max(axis=1)
    reach = 0.5 * boxes.size + margin + SLACK_M
    from dsrc.data import points_in_boxes_kernel as kernel  # takes half a second

    turn = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)
    found, pairs = len(points), np.zeros((0, 2), np.int32)
    while found > len(pairs):
        pairs = np.zeros((found, 2), np.int32)
        found = kernel.pairs_inside(points, matrix, low, high, margin, boxes.center, reach, turn, hull, pairs)
    return pairs[:found, 0].astype(np.intp), pairs[:found, 1].astype(np.intp)
