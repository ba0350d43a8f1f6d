"""Angular windows: rings and columns of a sweep that can meet a hull, in compiled loops."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled

_MARGIN_RAD = np.radians(0.2)
_DIRECTIONS = 7
_TURN = 2.0 * np.pi

Array = NDArray[np.float64]


class Angles(NamedTuple):
    """Angles spanned by a hull as seen from the origin of the sensor frame.

    Attributes:
        start, width: azimuths from `start` on, counter-clockwise, rad; a width of 2 pi is all.
        low, high: elevations, rad.
        near: lower bound of the horizontal distance, m.
    """

    start: float
    width: float
    low: float
    high: float
    near: float


@compiled()
def arc_of(x: Array, y: Array, radius: float) -> tuple[float, float]:
    """Return start and width of the azimuths that the convex hull of (K,) discs spans; never too small.

    All around where the origin is above, below or within.
    """
    # If the hull leaves out the origin, all of it lies less than a quarter turn from its middle.
    middle_x, middle_y = x.sum(), y.sum()
    right, left = np.inf, -np.inf
    for disc in range(len(x)):
        ahead, aside = middle_x * x[disc] + middle_y * y[disc], middle_x * y[disc] - middle_y * x[disc]
        distance = max(np.sqrt(x[disc] * x[disc] + y[disc] * y[disc]), 1e-9)
        angle, half = np.arctan2(aside, ahead), np.arcsin(min(radius / distance, 1.0))
        right, left = min(right, angle - half), max(left, angle + half)
    right, left = right - _MARGIN_RAD, left + _MARGIN_RAD
    return np.arctan2(middle_y, middle_x) + right, left - right if left - right < np.pi else _TURN


@compiled()
def angles_of(points: Array) -> Angles:
    """Return the angles of the convex hull of (K, 3) points in the sensor frame; never too small."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    start, width = arc_of(x, y, 0.0)
    near, bottom, top = 0.0, z.min(), z.max()
    # A hull's distance is the largest, over all directions, of its support's smallest projection: each direction
    # gives a lower bound, so a few of them give a good one.
    for part in range(_DIRECTIONS if width < _TURN else 0):
        toward = start + width * part / (_DIRECTIONS - 1)
        near = max(near, (x * np.cos(toward) + y * np.sin(toward)).min())
    far = np.sqrt((x * x + y * y).max())
    low = np.arctan2(bottom, near if bottom < 0.0 else far) - _MARGIN_RAD
    return Angles(start, width, low, np.arctan2(top, near if top > 0.0 else far) + _MARGIN_RAD, near)


@compiled()
def between(angles: Array, low: float, high: float) -> tuple[int, int]:
    """Return the first row of monotonic angles within [low, high] and the one after the last."""
    if angles[0] <= angles[-1]:
        return int(np.searchsorted(angles, low, "left")), int(np.searchsorted(angles, high, "right"))
    up = angles[::-1]
    return len(up) - int(np.searchsorted(up, high, "right")), len(up) - int(np.searchsorted(up, low, "left"))


@compiled()
def runs_of(azimuth: Array, start: float, width: float, spread: float) -> list[tuple[int, int]]:
    """Return the runs of columns that look into an arc, first column and the one after the last.

    Args:
        azimuth: (C,) of the columns, ascending or descending over at most one turn, rad.
        spread: most that a ray leaves its column's azimuth, rad.

    Returns:
        None to three without common columns; two for an arc that the field of view cuts.
    """
    low, wide = start - spread, min(width + 2.0 * spread, _TURN)
    turn = np.ceil((min(azimuth[0], azimuth[-1]) - low - wide) / _TURN)
    found = [between(azimuth, low + _TURN * (turn + i), low + _TURN * (turn + i) + wide) for i in range(3)]
    return [(first, after) for first, after in found if after > first]
