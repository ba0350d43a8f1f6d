"""Paths and speed profiles of scripted actors."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from sim.geometry import Array

_GRAIN_M = 0.25
_SMOOTH_M = 3.0
"""Smoothing length of corners, m: continuous heading and yaw rate."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePath:
    """Path of an actor, resampled and smooth.

    Attributes:
        points: (K, 3) m, about `_GRAIN_M` apart.
        along: (K,) distance from its start, m.
        heading: (K,) direction at each point, rad, unwrapped.
        pitch: (K,) slope there, rad, positive downhill as for bodies.
    """

    points: Array
    along: Array
    heading: Array
    pitch: Array

    @classmethod
    def through(cls, points: ArrayLike, smooth_m: float = _SMOOTH_M) -> Self:
        """Path along a (K, 2) or (K, 3) line, with corners rounded over about `smooth_m`."""
        line = np.asarray(points, np.float64)
        if line.shape[1] == 2:
            line = np.column_stack([line, np.zeros(len(line))])
        line = _resampled(line)
        reach = round(0.5 * smooth_m / _GRAIN_M)
        if reach > 0 and len(line) > 2:
            # Twice a moving average is a triangle: the curvature of a corner rises and falls without jumps.
            for _ in range(2):
                line = _averaged(line, reach)
            line = _resampled(line)
        step = np.diff(line, axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        slope = np.gradient(line, axis=0)
        return cls(
            points=line,
            along=np.concatenate([[0.0], np.cumsum(length)]),
            heading=np.unwrap(np.arctan2(slope[:, 1], slope[:, 0])),
            pitch=-np.arctan2(slope[:, 2], np.hypot(slope[:, 0], slope[:, 1])),
        )

    @property
    def length(self) -> float:
        """Length seen from above, m."""
        return float(self.along[-1])

    def at(self, along_m: ArrayLike) -> tuple[Array, Array, Array]:
        """Return (..., 3) positions, (...) headings and pitches at distances along the path, clamped to its ends."""
        where = np.asarray(along_m, np.float64)
        xyz = np.stack([np.interp(where, self.along, self.points[:, k]) for k in range(3)], axis=-1)
        return xyz, np.interp(where, self.along, self.heading), np.interp(where, self.along, self.pitch)

    def nearest(self, xy: ArrayLike) -> float:
        """Return the distance along the path of the point nearest to a (2,) position, m."""
        start, step = self.points[:-1, :2], np.diff(self.points[:, :2], axis=0)
        share = ((np.asarray(xy, np.float64) - start) * step).sum(1) / np.maximum((step**2).sum(1), 1e-12)
        share = np.clip(share, 0.0, 1.0)
        gap = np.hypot(*(start + share[:, None] * step - np.asarray(xy, np.float64)).T)
        row = int(gap.argmin())
        return float(self.along[row] + share[row] * (self.along[row + 1] - self.along[row]))

    def beside(self, left_m: float) -> Array:
        """Return the (K, 2) line offset `left_m` to the left of the path."""
        normal = np.column_stack([-np.sin(self.heading), np.cos(self.heading)])
        return self.points[:, :2] + left_m * normal


class PathBuilder:
    """Draws a way piece by piece: `Pen(x, y, heading).straight(50).turn(8, -pi / 2).way()`."""

    def __init__(self, x: float, y: float, heading: float = 0.0) -> None:
        self.place = np.array([x, y], np.float64)
        self.heading = heading
        self._points = [self.place]

    def straight(self, length_m: float) -> Self:
        """Append a straight line."""
        return self._add(np.linspace(0.0, max(length_m, 1e-3), max(2, round(length_m / _GRAIN_M)))[1:], None)

    def turn(self, radius_m: float, angle: float) -> Self:
        """Append an arc by an angle, rad, positive to the left."""
        phi = np.linspace(0.0, abs(angle), max(3, round(radius_m * abs(angle) / _GRAIN_M)))[1:]
        side = math.copysign(radius_m, angle)
        self._add(radius_m * np.sin(phi), side * (1.0 - np.cos(phi)))
        self.heading += angle
        return self

    def shift(self, left_m: float, length_m: float) -> Self:
        """Append a lane change of `left_m` to the left (negative: right) over `length_m`."""
        share = np.linspace(0.0, 1.0, max(5, round(length_m / _GRAIN_M)))[1:]
        return self._add(length_m * share, left_m * share**3 * (10.0 - 15.0 * share + 6.0 * share**2))

    def path(self, smooth_m: float = _SMOOTH_M) -> ReferencePath:
        """Return the path drawn so far."""
        return ReferencePath.through(np.array(self._points), smooth_m)

    def _add(self, ahead: Array, left: Array | None) -> Self:
        c, s = math.cos(self.heading), math.sin(self.heading)
        aside = np.zeros(len(ahead)) if left is None else left
        new = self.place + np.column_stack([c * ahead - s * aside, s * ahead + c * aside])
        self._points += list(new)
        self.place = new[-1]
        return self


@dataclass(frozen=True, slots=True, eq=False)
class SpeedProfile:
    """Speed over time, piecewise linear between knots and constant beyond them.

    Attributes:
        time_s: (K,) ascending, s.
        speed_mps: (K,) m/s.
    """

    time_s: Array
    speed_mps: Array

    @classmethod
    def steady(cls, speed_mps: float) -> Self:
        """Constant speed."""
        return cls(np.zeros(1), np.array([speed_mps], np.float64))

    @classmethod
    def change(cls, before_mps: float, after_mps: float, start_s: float, rate_mps2: float) -> Self:
        """Constant speed until `start_s`, then a change at `rate_mps2` > 0 to another."""
        lasts = max(abs(after_mps - before_mps) / rate_mps2, 1e-6)
        return cls(np.array([start_s, start_s + lasts]), np.array([before_mps, after_mps], np.float64))

    def at(self, time_s: ArrayLike) -> Array:
        """Return speeds, m/s."""
        return np.interp(np.asarray(time_s, np.float64), self.time_s, self.speed_mps)

    def distance(self, time_s: ArrayLike) -> Array:
        """Return the distance travelled since time 0, m; negative before."""
        return self._integral(time_s) - self._integral(0.0)

    def _integral(self, time_s: ArrayLike) -> Array:
        time = np.asarray(time_s, np.float64)
        knots, speeds = self.time_s, self.speed_mps
        grown = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(knots))])
        row = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 1)
        since = time - knots[row]
        # Before the first knot and after the last the speed is constant.
        return grown[row] + since * 0.5 * (speeds[row] + np.interp(time, knots, speeds))


def _resampled(line: Array) -> Array:
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    keep = np.concatenate([[True], step > 1e-6])
    line = line[keep]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    at = np.linspace(0.0, along[-1], max(2, round(along[-1] / _GRAIN_M) + 1))
    return np.column_stack([np.interp(at, along, line[:, k]) for k in range(3)])


def _averaged(line: Array, reach: int) -> Array:
    # The ends are extended straight, so that a path keeps its end points.
    first, last = line[0] - line[1], line[-1] - line[-2]
    before = line[0] + first * np.arange(reach, 0, -1)[:, None]
    after = line[-1] + last * np.arange(1, reach + 1)[:, None]
    padded = np.concatenate([before, line, after])
    width = 2 * reach + 1
    total = np.cumsum(np.concatenate([np.zeros((1, 3)), padded]), axis=0)
    return (total[width:] - total[:-width]) / width
