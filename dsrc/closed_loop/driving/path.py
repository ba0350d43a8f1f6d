"""Path ahead of the ego: its route at equal steps, with heading and the speeds that bends allow."""

import math
from dataclasses import dataclass

import numpy as np

from sim.geometry import Array

STEP_M = 0.5
"""Distance between stations of a path, m."""

_SMOOTH_M = 4.0
_BEND_M = 12.0
"""Length over which the curvature of a drawn lane is measured: the corners of its polyline are no bends, m."""
_START_M = 6.0
"""Beginning of a path without a bound: the way from beside a lane onto it is no bend, m."""
_RETURN_M, _ASIDE_M = 15.0, 2.0
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
        length_m: longest part of the route that matters.
    """
    line, beside = _from_lane(_without_jumps(np.asarray(route, np.float64)), yaw)
    grown = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    along = np.arange(0.0, min(max(grown[-1], STEP_M), length_m) + 1e-9, STEP_M)
    xy = np.stack([np.interp(along, grown, line[:, axis]) for axis in (0, 1)], axis=1)
    xy = _smooth(xy, round(0.5 * _SMOOTH_M / STEP_M)) + np.clip(1.0 - along / _RETURN_M, 0.0, 1.0)[:, None] * beside
    drawn = _headings(xy)
    # The body does not turn at once to where the route begins.
    turned = math.remainder(yaw - drawn[0], 2.0 * math.pi)
    heading = drawn + (turned * np.exp(-along / _SMOOTH_M) if abs(turned) < 0.5 * math.pi else 0.0)
    place, reach = np.arange(len(xy)), max(1, round(0.5 * _BEND_M / STEP_M))
    far, near = np.minimum(place + reach, len(xy) - 1), np.maximum(place - reach, 0)
    curvature = np.abs(drawn[far] - drawn[near]) / (np.maximum(far - near, 1) * STEP_M)
    curvature[along < _START_M] = 0.0
    return Path(along, xy, heading, np.sqrt(lateral_mps2 / np.maximum(curvature, 1e-6)))


def _headings(xy: Array) -> Array:
    step = np.diff(xy, axis=0)
    middle = np.arctan2(step[:, 1], step[:, 0])
    if np.abs(middle[1:] - middle[:-1]).max(initial=0.0) > math.pi:
        middle = np.unwrap(middle)
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


def _from_lane(line: Array, yaw: float) -> tuple[Array, Array]:
    """Return a polyline that begins on its lane, and the (2,) offset from there of where it began.

    A route leads from the ego's centre straight to the lane at its front bumper. In a bend that is where the bumper is;
    in a lane change it is beside it, and the route has a kink.
    """
    none = np.zeros(2)
    if len(line) < 3:
        return line, none
    way, onward = line[1] - line[0], line[2] - line[1]
    reach, length = float(np.hypot(*way)), float(np.hypot(*onward))
    if length < 0.1 or reach > _JUMP_M or way @ onward <= 0.0:
        return line, none
    normal = np.array([-onward[1], onward[0]]) / length
    bumper = line[0] + reach * np.array([math.cos(yaw), math.sin(yaw)])
    left = float((bumper - line[1]) @ normal)
    if abs(left) > _ASIDE_M:
        return line, none
    return np.concatenate([[line[0] - left * normal], line[1:]]), left * normal


def _without_jumps(line: Array) -> Array:
    """Return a polyline whose sideways jumps between parallel lanes are spread over `_CHANGE_M` of the way."""
    step = np.diff(line, axis=0)
    length = np.hypot(*step.T)
    line, step, length = line[np.concatenate([[True], length > 1e-6])], step[length > 1e-6], length[length > 1e-6]
    if len(step) < 3:
        return line if len(line) > 1 else np.stack([line[0], line[0] + np.array([STEP_M, 0.0])])
    direction = np.arctan2(step[:, 1], step[:, 0])
    turn = np.abs(np.remainder(np.diff(direction) + np.pi, 2.0 * np.pi) - np.pi)
    if turn.max() <= _JUMP_RAD:
        return line
    both = np.abs(np.remainder(direction[2:] - direction[:-2] + np.pi, 2.0 * np.pi) - np.pi)
    jumps = (turn[:-1] > _JUMP_RAD) & (turn[1:] > _JUMP_RAD) & (both < _JUMP_RAD) & (length[1:-1] < _JUMP_M)
    if not jumps.any():
        return line
    row = int(np.argmax(jumps)) + 1
    offset = line[row + 1] - line[row]
    joined = np.concatenate([line[: row + 1], line[row + 2 :] - offset])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(joined, axis=0).T))])
    start = max(along[row] - _CHANGE_M, 0.0)
    at = np.union1d(along, np.linspace(start, start + _CHANGE_M, round(_CHANGE_M / 2.0)).clip(0.0, along[-1]))
    out = np.stack([np.interp(at, along, joined[:, axis]) for axis in (0, 1)], axis=1)
    return _without_jumps(out + np.clip((at - start) / _CHANGE_M, 0.0, 1.0)[:, None] * offset)
