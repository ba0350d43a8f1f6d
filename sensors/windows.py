"""Angular windows: which rings and columns of a sweep can meet a box at all."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MARGIN_RAD = np.radians(0.2)
_SUPPORT = np.linspace(0.0, 1.0, 9)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """What N sets of points span as seen from the origin of the sensor frame.

    Attributes:
        azimuth: (N,) where each window starts, rad; it grows counter-clockwise.
        width: (N,) rad, 2 pi where the sensor is above, below or within.
        low, high: (N,) elevations, rad.
        near: (N,) lower bound of the horizontal distance, m.
    """

    azimuth: NDArray[np.float64]
    width: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    near: NDArray[np.float64]

    def columns(self, azimuth: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (N, C) whether columns fired at (C,) azimuths lie in each window."""
        past_start = np.mod(azimuth - self.azimuth[:, None], 2.0 * np.pi)
        return past_start <= self.width[:, None]

    def rings(self, elevation: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (N, R) whether rings at (R,) elevations lie in each window."""
        return (elevation >= self.low[:, None]) & (elevation <= self.high[:, None])


def windows_of(points: NDArray[np.float64]) -> Windows:
    """Return the windows of the convex hulls of (N, K, 3) points in the sensor frame; never too small."""
    x, y, z = np.moveaxis(points, -1, 0)
    start, width = _arc(np.arctan2(y, x))
    # A hull's distance is the largest, over all directions, of its support's smallest projection: each direction
    # gives a lower bound, so a few of them give a good one.
    toward = start[:, None] + width[:, None] * _SUPPORT
    along = x[:, None] * np.cos(toward)[..., None] + y[:, None] * np.sin(toward)[..., None]
    near = np.maximum(along.min(axis=2).max(axis=1), 0.0)
    far = np.hypot(x, y).max(axis=1)
    bottom, top = z.min(axis=1), z.max(axis=1)
    full = width >= np.pi
    near[full] = 0.0
    return Windows(
        azimuth=start - _MARGIN_RAD,
        width=np.where(full, 2.0 * np.pi, np.minimum(width + 2.0 * _MARGIN_RAD, 2.0 * np.pi)),
        low=np.arctan2(bottom, np.where(bottom < 0.0, near, far)) - _MARGIN_RAD,
        high=np.arctan2(top, np.where(top > 0.0, near, far)) + _MARGIN_RAD,
        near=near,
    )


def _arc(angles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return start and width of the shortest arc over each row of (N, K) angles: what the widest gap leaves."""
    ordered = np.sort(angles, axis=1)
    gaps = np.diff(ordered, axis=1, append=ordered[:, :1] + 2.0 * np.pi)
    widest = gaps.argmax(axis=1)
    rows = np.arange(len(angles))
    start = ordered[rows, (widest + 1) % angles.shape[1]]
    return start, 2.0 * np.pi - gaps[rows, widest]
