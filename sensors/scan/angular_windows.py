"""Angular windows: rings and columns of a sweep that can meet a box."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MARGIN_RAD = np.radians(0.2)
_SUPPORT = np.linspace(0.0, 1.0, 7)
_TURN = 2.0 * np.pi

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Arcs:
    """N azimuths from `start` on, `width` wide, counter-clockwise, rad: (N,) float64; a width of 2 pi is all."""

    start: Array
    width: Array

    def columns(self, azimuth: Array, spread: float) -> tuple[Ints, Ints, Ints]:
        """Return the runs of columns that look into the arcs.

        Args:
            azimuth: (C,) of the columns, ascending or descending over at most one turn, rad.
            spread: most that a ray leaves its column's azimuth, rad.

        Returns:
            (K,) arc, first column and column after the last of each run, in the order of the arcs; an arc that the
            field of view cuts in two has two runs.
        """
        low = self.start - spread
        width = self.width[:, None] + 2.0 * spread
        turn = np.ceil((min(azimuth[0], azimuth[-1]) - low - width[:, 0]) / _TURN)
        start = low[:, None] + _TURN * (turn[:, None] + np.arange(3.0))
        first, after = _between(azimuth, start, start + width)
        arc, slot = np.nonzero(after > first)
        return arc, first[arc, slot], after[arc, slot]


@dataclass(frozen=True, slots=True, eq=False)
class AngularWindows:
    """Angles spanned by N sets of points as seen from the origin of the sensor frame.

    Attributes:
        arcs: azimuths, all around where the sensor is above, below or within.
        low, high: (N,) elevations, rad.
        near: (N,) lower bound of the horizontal distance, m.
    """

    arcs: Arcs
    low: Array
    high: Array
    near: Array

    def rings(self, elevation: Array, spread: float) -> tuple[Ints, Ints]:
        """Return (N,) the first ring that looks into each window and the ring after the last.

        Args:
            elevation: (R,) of the rings, descending, rad.
            spread: most that a ray leaves its ring's elevation, rad.
        """
        return _between(elevation, self.low - spread, self.high + spread)


def angular_windows(points: Array) -> AngularWindows:
    """Return the windows of the convex hulls of (N, K, 3) points in the sensor frame; never too small."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    arcs = arcs_of(x, y, np.zeros((len(points), 1)))
    # A hull's distance is the largest, over all directions, of its support's smallest projection: each direction
    # gives a lower bound, so a few of them give a good one.
    toward = arcs.start[:, None] + arcs.width[:, None] * _SUPPORT
    along = x[:, None] * np.cos(toward)[..., None] + y[:, None] * np.sin(toward)[..., None]
    near = np.where(arcs.width < _TURN, np.maximum(along.min(axis=2).max(axis=1), 0.0), 0.0)
    far = np.sqrt((x * x + y * y).max(axis=1))
    bottom, top = z.min(axis=1), z.max(axis=1)
    return AngularWindows(
        arcs=arcs,
        low=np.arctan2(bottom, np.where(bottom < 0.0, near, far)) - _MARGIN_RAD,
        high=np.arctan2(top, np.where(top > 0.0, near, far)) + _MARGIN_RAD,
        near=near,
    )


def arcs_of(x: Array, y: Array, radius: Array) -> Arcs:
    """Return the arcs that the convex hulls of discs span as seen from the origin; never too small.

    Args:
        x: (N, K) middles of the K discs of each hull, m.
        radius: (N, K or 1) of the discs, m.
    """
    # If the hull leaves out the origin, all of it lies less than a quarter turn from its middle.
    middle_x, middle_y = x.sum(axis=1, keepdims=True), y.sum(axis=1, keepdims=True)
    ahead, aside = middle_x * x + middle_y * y, middle_x * y - middle_y * x
    angle = np.arctan2(aside, ahead)
    half = np.arcsin(np.minimum(radius / np.maximum(np.sqrt(x * x + y * y), 1e-9), 1.0))
    right, left = (angle - half).min(axis=1) - _MARGIN_RAD, (angle + half).max(axis=1) + _MARGIN_RAD
    start = np.arctan2(middle_y, middle_x)[:, 0] + right
    return Arcs(start, np.where(left - right < np.pi, left - right, _TURN))


def _between(angles: Array, low: Array, high: Array) -> tuple[Ints, Ints]:
    """Return first and after-last index of monotonic angles within [low, high]."""
    if angles[0] <= angles[-1]:
        return np.searchsorted(angles, low, "left"), np.searchsorted(angles, high, "right")
    up = angles[::-1]
    return len(up) - np.searchsorted(up, high, "right"), len(up) - np.searchsorted(up, low, "left")
