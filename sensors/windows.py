"""Angular windows: which rings and columns of a sweep can meet a box at all."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MARGIN_RAD = np.radians(0.2)
_SUPPORT = np.linspace(0.0, 1.0, 9)
_TURN = 2.0 * np.pi


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

    def columns(
        self, azimuth: NDArray[np.float64], spread: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the runs of columns that look into the windows, give or take `spread`.

        Args:
            azimuth: (C,) of the columns, ascending or descending over at most one turn, rad.
            spread: most that a ray leaves its column's azimuth, rad.

        Returns:
            (K,) window, first column and column after the last of each run, in the order of the windows; a window that
            the field of view cuts in two has two runs.
        """
        turn = np.ceil((azimuth.min() - spread - self.azimuth - self.width) / _TURN)
        start = self.azimuth[:, None] + _TURN * np.stack([turn, turn + 1.0, turn + 2.0], axis=-1) - spread
        return _filled(_between(azimuth, start, start + self.width[:, None] + 2.0 * spread))

    def rings(self, elevation: NDArray[np.float64], spread: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (N,) the first ring that looks into each window, give or take `spread`, and the one after the last.

        Args:
            elevation: (R,) of the rings, descending, rad.
            spread: most that a ray leaves its ring's elevation, rad.
        """
        return _between(elevation, self.low - spread, self.high + spread)


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
        width=np.where(full, _TURN, np.minimum(width + 2.0 * _MARGIN_RAD, _TURN)),
        low=np.arctan2(bottom, np.where(bottom < 0.0, near, far)) - _MARGIN_RAD,
        high=np.arctan2(top, np.where(top > 0.0, near, far)) + _MARGIN_RAD,
        near=near,
    )


def _arc(angles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return start and width of the shortest arc over each row of (N, K) angles: what the widest gap leaves."""
    ordered = np.sort(angles, axis=1)
    gaps = np.diff(ordered, axis=1, append=ordered[:, :1] + _TURN)
    widest = gaps.argmax(axis=1)
    rows = np.arange(len(angles))
    start = ordered[rows, (widest + 1) % angles.shape[1]]
    return start, _TURN - gaps[rows, widest]


def _between(
    angles: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first and after-last index of monotonic angles within [low, high]."""
    if angles[0] <= angles[-1]:
        return np.searchsorted(angles, low, "left"), np.searchsorted(angles, high, "right")
    up = angles[::-1]
    return len(up) - np.searchsorted(up, high, "right"), len(up) - np.searchsorted(up, low, "left")


def _filled(
    runs: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    first, after = runs
    row, slot = np.nonzero(after > first)
    return row, first[row, slot], after[row, slot]
