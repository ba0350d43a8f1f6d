"""What stands between a sensor and an object: the road user whose box most of the lines of sight meet."""

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix, transform_points

_SHARE = 0.8
"""Share of a box's half sides at which lines of sight end: at its very edges they would pass."""
_TOWARDS = np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 1]], np.float64)


def hidden_by(place: NDArray[np.float64], boxes: Boxes, row: int, own: int) -> int:
    """Return the row of the box that most lines of sight from a sensor to a box meet first; -1 where they meet none.

    Six lines go to the middle of the box, its four upright edges and its roof. The static world is not looked at.

    Args:
        place: (3,) of the sensor.
        boxes: of all road users, in the frame of `place`.
        row: the box that is looked at.
        own: object id of the sensor's carrier, whose body is no obstacle.
    """
    pose = np.asarray(pose_matrix(boxes.center[row], boxes.yaw[row]), np.float64)
    ends: NDArray[np.float64] = transform_points(pose, 0.5 * _SHARE * _TOWARDS * boxes.size[row]).astype(np.float64)
    first, by = np.full(len(ends), np.inf), np.full(len(ends), -1)
    for other in range(len(boxes)):
        if other == row or boxes.object_id[other] == own:
            continue
        at = _meets(place, ends, boxes, other)
        nearer = at < first
        first[nearer], by[nearer] = at[nearer], other
    blocked = by[by >= 0]
    return int(np.bincount(blocked).argmax()) if len(blocked) else -1


def _meets(place: NDArray[np.float64], ends: NDArray[np.float64], boxes: Boxes, row: int) -> NDArray[np.float64]:
    """(K,) share of each line at which it enters a box; infinite where it passes."""
    back = invert(np.asarray(pose_matrix(boxes.center[row], boxes.yaw[row]), np.float64))
    start, end = transform_points(back, place[None])[0], transform_points(back, ends)
    half, way = 0.5 * boxes.size[row], end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - start) / way, (half - start) / way
    # A line along a face: within the slab all the way, or never.
    still, inside = way == 0.0, np.abs(start) <= half
    low = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=1)
    high = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=1)
    return np.where((low <= high) & (high > 0.0) & (low < 1.0), np.maximum(low, 0.0), np.inf)
