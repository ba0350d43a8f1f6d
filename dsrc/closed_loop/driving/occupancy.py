"""Occupancy of the ego's path: which stations predicted road users block, and when."""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.path import STEP_M, Path
from dsrc.closed_loop.driving.prediction import Prediction
from sim.geometry import Array
from sim.rows import Rows

_COARSE = 8
_SLOW_MPS = 0.5
_BENT = 10
_SLACK_M = 0.4


class ClearanceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Clearances to other road users.

    Attributes:
        touch_m: beside and before them in every case.
        beside_m: beside moving ones.
        beside_standing_m: beside standing ones.
        ahead_m: behind those who move along the path.
        crossing_s: between the passages of the ego and of those who cross its path.
        aligned_rad: angle to the path up to which a road user moves along it.
    """

    touch_m: float = 0.1
    beside_m: float = 0.35
    beside_standing_m: float = 0.2
    ahead_m: float = 1.5
    crossing_s: float = 0.8
    aligned_rad: float = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Occupancy(Rows):
    """Intervals of the ego's stations, m, in which it would touch a hypothesis: R hypotheses at T instants.

    An interval is open, and (inf, -inf) where nothing is blocked. The physical ones have the least clearance, the
    others all clearances in space and time.

    Attributes:
        near: (R, 2, T) physical intervals.
        wide: (R, 2, T) intervals with clearances.
        now: (R,) station before a body on the path at present, m; inf without one.
        along_mps: (R, T) speed along the path where it is blocked.
        aligned: (R, T) moves along the path.
        still: (R, T) stands, or as good as.
        row: (R,) row of the track; -1 for a stop line.
        likely: (R,) likeliest hypothesis of its track.
    """

    near: Array
    wide: Array
    now: Array
    along_mps: Array
    aligned: NDArray[np.bool_]
    still: NDArray[np.bool_]
    row: NDArray[np.int64]
    likely: NDArray[np.bool_]


def occupancy_of(path: Path, size: Array, prediction: Prediction, settings: ClearanceSettings) -> Occupancy:
    """Return what blocks a path, hypothesis by hypothesis; those that never do are left out.

    Args:
        size: (2,) length and width of the ego, m.
    """
    steps, reach = len(prediction.time_s), 0.5 * float(np.hypot(*size))
    hypothesis, instant, station = _close(path, reach, prediction)
    kept = _within(path, size, prediction, hypothesis, instant, station, settings)
    hypothesis, instant, station = hypothesis[kept], instant[kept], station[kept]
    still = prediction.still[hypothesis, instant]
    beside = np.where(still, settings.beside_standing_m, settings.beside_m)
    beside = np.maximum(beside, settings.touch_m) + prediction.spread_m[hypothesis, instant]
    depth = 0.5 * np.hypot(*prediction.size.T)[hypothesis]
    half = np.ceil((1.2 * (reach + depth) + 0.5 * _COARSE * STEP_M + 1.0) / STEP_M).astype(np.int64)
    window = np.arange(-int(half.max(initial=0)), int(half.max(initial=0)) + 1)
    at = station[:, None] + window
    inside = (at >= 0) & (at < len(path)) & (np.abs(window) <= half[:, None])
    at = np.clip(at, 0, len(path) - 1)
    hits = _touching(path, at, size, prediction, hypothesis, instant, settings.touch_m, beside)
    close, apart = (_interval(at, hit & inside) for hit in hits)
    found = np.isfinite(apart[0])
    rows = np.unique(hypothesis[found])
    place = np.searchsorted(rows, hypothesis[found])
    shape = (len(rows), 2, steps)
    blocked = [np.full(shape, np.inf) for _ in range(2)]
    when = instant[found]
    for out, (low, high) in zip(blocked, (close, apart), strict=True):
        out[:, 1] = -np.inf
        out[place, 0, when], out[place, 1, when] = low[found], high[found]
    along, aligned = np.zeros((len(rows), steps)), np.zeros((len(rows), steps), bool)
    first = np.clip(np.rint(np.clip(apart[0][found], 0.0, path.along[-1]) / STEP_M).astype(np.int64), 0, len(path) - 1)
    heading = _directions(prediction)[hypothesis[found], when]
    turned = np.cos(heading - path.heading[first])
    stays = prediction.speed_mps[rows].max(axis=1, initial=0.0) == 0.0
    if stays.any():
        for out in blocked:
            out[stays] = out[stays][:, :, :1]
    along[place, when] = prediction.speed_mps[hypothesis[found], when] * turned
    aligned[place, when] = (turned > np.cos(settings.aligned_rad)) & ~still[found]
    near_rows, wide_rows = blocked
    step_s = float(prediction.time_s[1] - prediction.time_s[0]) if steps > 1 else 1.0
    return Occupancy(
        near=_lasting(near_rows, aligned, 1),
        wide=_lasting(_apart(wide_rows, aligned, along, settings), aligned, round(settings.crossing_s / step_s)),
        now=near_rows[:, 0, 0],
        along_mps=along,
        aligned=aligned,
        still=prediction.speed_mps[rows] < _SLOW_MPS,
        row=prediction.row[rows],
        likely=prediction.likely[rows],
    )


def _close(
    path: Path, reach: float, prediction: Prediction
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return hypotheses and instants whose circles meet those of the ego on its path, and the nearest stations."""
    coarse = path.xy[::_COARSE]
    meets = reach + 0.5 * np.hypot(*prediction.size.T)[:, None] + 0.5 * _COARSE * STEP_M + 1.0
    # A box around the path rules most out before any distance is measured.
    low, high = coarse.min(0), coarse.max(0)
    near = np.maximum(low - prediction.xy, prediction.xy - high).max(-1) < meets
    near[prediction.speed_mps.max(axis=1, initial=0.0) == 0.0, 1:] = False  # who stands, stays
    hypothesis, instant = np.nonzero(near)
    point = prediction.xy[hypothesis, instant]
    dx = point[:, 0, None] - coarse[:, 0]
    dy = point[:, 1, None] - coarse[:, 1]
    square = dx * dx + dy * dy
    nearest = square.argmin(1)
    close = square[np.arange(len(nearest)), nearest] < meets[hypothesis, 0] ** 2
    return hypothesis[close], instant[close], nearest[close] * _COARSE


def _within(
    path: Path,
    size: Array,
    prediction: Prediction,
    hypothesis: NDArray[np.int64],
    instant: NDArray[np.int64],
    station: NDArray[np.int64],
    settings: ClearanceSettings,
) -> NDArray[np.bool_]:
    """Return which bodies reach the strip beside the path around the nearest station; who is a lane away does not."""
    last = len(path) - 1
    heading = path.heading[station]
    bent = np.abs(path.heading[np.minimum(station + _BENT, last)] - heading)
    bent += np.abs(heading - path.heading[np.maximum(station - _BENT, 0)])
    dx, dy = (prediction.xy[hypothesis, instant] - path.xy[station]).T
    turn = prediction.yaw[hypothesis, instant] - heading
    c, s = np.cos(heading), np.sin(heading)
    extent = 0.5 * (prediction.size[hypothesis, 0] * np.abs(np.sin(turn)) + prediction.size[hypothesis, 1])
    widest = max(settings.beside_m, settings.beside_standing_m, settings.touch_m) + 0.5 * float(size[1])
    room = widest + prediction.spread_m[hypothesis, instant] + extent + _SLACK_M
    # In a bend the path leaves the tangent at the nearest station.
    return np.abs(c * dy - s * dx) < room + 0.5 * (size[0] + prediction.size[hypothesis, 0]) * bent


def _touching(
    path: Path,
    at: NDArray[np.int64],
    size: Array,
    prediction: Prediction,
    hypothesis: NDArray[np.int64],
    instant: NDArray[np.int64],
    touch_m: float,
    beside_m: Array,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (M, W) masks of overlap of the ego at stations with predicted boxes, with both clearances beside it.

    The separating axis theorem with the ego's box grown by the clearance.
    """
    xy = path.xy[at]
    yaw = prediction.yaw[hypothesis, instant][:, None]
    length, width = (0.5 * prediction.size[hypothesis].T)[..., None]
    dx = prediction.xy[hypothesis, instant, 0][:, None] - xy[..., 0]
    dy = prediction.xy[hypothesis, instant, 1][:, None] - xy[..., 1]
    # Sines of stations and of bodies, not of all their pairs.
    c, s, co, so = np.cos(path.heading)[at], np.sin(path.heading)[at], np.cos(yaw), np.sin(yaw)
    turn_c, turn_s = np.abs(c * co + s * so), np.abs(s * co - c * so)
    front, side = 0.5 * size[0] + touch_m, 0.5 * size[1]
    meets = np.abs(dx * c + dy * s) < front + length * turn_c + width * turn_s
    across = np.abs(dy * c - dx * s) - (length * turn_s + width * turn_c)
    along_other = np.abs(dx * co + dy * so) - length - front * turn_c
    across_other = np.abs(dy * co - dx * so) - width - front * turn_s

    def overlap(half: Array | float) -> NDArray[np.bool_]:
        return meets & (across < half) & (along_other < half * turn_s) & (across_other < half * turn_c)

    return overlap(side + touch_m), overlap(side + beside_m[:, None])


def _interval(at: NDArray[np.int64], hit: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the open (M,) intervals of stations around the hits."""
    along = at * STEP_M
    low = np.where(hit, along, np.inf).min(1, initial=np.inf) - STEP_M
    high = np.where(hit, along, -np.inf).max(1, initial=-np.inf) + STEP_M
    return low, high


def _directions(prediction: Prediction) -> Array:
    """Return (H, T) directions of motion; the yaw of those who stand."""
    xy, step = prediction.xy, np.empty_like(prediction.xy)
    step[:, 1:-1] = 0.5 * (xy[:, 2:] - xy[:, :-2])
    step[:, 0], step[:, -1] = xy[:, 1] - xy[:, 0], xy[:, -1] - xy[:, -2]
    return np.where(np.hypot(step[..., 0], step[..., 1]) > 1e-3, np.arctan2(step[..., 1], step[..., 0]), prediction.yaw)


def _apart(rows: Array, aligned: NDArray[np.bool_], along: Array, settings: ClearanceSettings) -> Array:
    """Return intervals with clearances before and behind."""
    out = rows.copy()
    out[:, 0] -= np.where(aligned, settings.ahead_m, 0.5)
    out[:, 1] += np.where(aligned, settings.ahead_m + 0.5 * np.maximum(along, 0.0), 0.5)
    return out


def _lasting(rows: Array, aligned: NDArray[np.bool_], steps: int) -> Array:
    """Return intervals of those who cross the path, held some steps before and after."""
    crossing = rows.copy()
    crossing[:, 0][aligned], crossing[:, 1][aligned] = np.inf, -np.inf
    out = rows.copy()
    for shift in range(1, min(steps, rows.shape[2] - 1) + 1):
        for to, of in ((np.s_[shift:], np.s_[:-shift]), (np.s_[:-shift], np.s_[shift:])):
            out[:, 0, to] = np.minimum(out[:, 0, to], crossing[:, 0, of])
            out[:, 1, to] = np.maximum(out[:, 1, to], crossing[:, 1, of])
    return out
