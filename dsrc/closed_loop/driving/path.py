"""Path ahead of the ego: its route at equal steps, with heading and the speeds that bends allow."""

import math
from dataclasses import dataclass

import numpy as np

from sim.geometry import Array

STEP_M = 0.5
"""Distance between stations of a path, m."""

_SMOOTH_M = 4.0
_BEND_M = 6.0
"""Length over which the curvature of a drawn lane is measured: its corners are no bends, m."""
_JUMP_RAD, _JUMP_M, _CHANGE_M = math.radians(50.0), 6.0, 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Path of the ego's centre, from where it is.

    Attributes:
        along: (K,) distance from the start, m, multiples of `STEP_M`.
        xy: (K, 2) world, m.
        heading: (K,) rad, unwrapped.
        bend_mps: (K,) highest speed for the lateral acceleration allowed.
    """

    along: Array
    xy: Array
    heading: Array
    bend_mps: Array

    def __len__(self) -> int:
        return len(self.along)


def path_of(route: Array, yaw: float, lateral_mps2: float, length_m: float = math.inf) -> Path:
    """Return the path along a route.

    Jumps from lane to lane, where a route changes lanes, become lane changes.

    Args:
        route: (K, 2) polyline, m, from the ego's centre.
        yaw: heading of the ego, rad.
        lateral_mps2: highest lateral acceleration.
        length_m: longest part of the route that matters.
    """
    line = _without_jumps(np.asarray(route, np.float64))
    grown = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    along = np.arange(0.0, min(max(grown[-1], STEP_M), length_m) + 1e-9, STEP_M)
    xy = np.stack([np.interp(along, grown, line[:, axis]) for axis in (0, 1)], axis=1)
    xy = _smooth(xy, round(0.5 * _SMOOTH_M / STEP_M))
    drawn = _headings(xy)
    # The body does not turn at once to where the route begins.
    turned = math.remainder(yaw - drawn[0], 2.0 * math.pi)
    heading = drawn + (turned * np.exp(-along / _SMOOTH_M) if abs(turned) < 0.5 * math.pi else 0.0)
    place, reach = np.arange(len(xy)), max(1, round(0.5 * _BEND_M / STEP_M))
    far, near = np.minimum(place + reach, len(xy) - 1), np.maximum(place - reach, 0)
    curvature = np.abs(drawn[far] - drawn[near]) / (np.maximum(far - near, 1) * STEP_M)
    return Path(along, xy, heading, np.sqrt(lateral_mps2 / np.maximum(curvature, 1e-6)))


def _headings(xy: Array) -> Array:
    step = np.diff(xy, axis=0)
    middle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    return np.concatenate([middle[:1], 0.5 * (middle[1:] + middle[:-1]), middle[-1:]])


def _smooth(xy: Array, reach: int) -> Array:
    """Return a line averaged over `reach` points on both sides; the ends stay."""
    if len(xy) < 3:
        return xy
    before = xy[0] + (xy[0] - xy[1]) * np.arange(reach, 0, -1)[:, None]
    after = xy[-1] + (xy[-1] - xy[-2]) * np.arange(1, reach + 1)[:, None]
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), before, xy, after]), axis=0)
    width = 2 * reach + 1
    return (total[width:] - total[:-width]) / width


def _without_jumps(line: Array) -> Array:
    """Return a polyline whose sideways jumps between parallel lanes are spread over the way before them."""
    step = np.diff(line, axis=0)
    length = np.hypot(*step.T)
    line, step, length = line[np.concatenate([[True], length > 1e-6])], step[length > 1e-6], length[length > 1e-6]
    if len(step) < 3:
        return line if len(line) > 1 else np.stack([line[0], line[0] + np.array([STEP_M, 0.0])])
    direction = np.arctan2(step[:, 1], step[:, 0])
    turn = np.abs(np.remainder(np.diff(direction) + np.pi, 2.0 * np.pi) - np.pi)
    both = np.abs(np.remainder(direction[2:] - direction[:-2] + np.pi, 2.0 * np.pi) - np.pi)
    jumps = (turn[:-1] > _JUMP_RAD) & (turn[1:] > _JUMP_RAD) & (both < _JUMP_RAD) & (length[1:-1] < _JUMP_M)
    for row in np.flatnonzero(jumps) + 1:
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        start = max(along[row] - _CHANGE_M, 0.0)
        # Points before the jump move by a growing share of it, the nearest by all of it.
        extra = np.arange(start, along[row], 2.0)
        at = np.concatenate([along[: row + 1][along[: row + 1] < start], extra, [along[row]]])
        before = np.stack([np.interp(at, along[: row + 1], line[: row + 1, axis]) for axis in (0, 1)], axis=1)
        share = np.clip((at - start) / max(along[row] - start, 1e-6), 0.0, 1.0)
        before += share[:, None] * (line[row + 1] - line[row])
        return _without_jumps(np.concatenate([before, line[row + 2 :]]))
    return line
