"""Prediction of road users: along lanes where they are on one, else with their turn rate, which decays.

Motion models: R. Schubert, E. Richter, G. Wanielik, *Comparison and Evaluation of Advanced Motion Models for Vehicle
Tracking*, FUSION 2008 (constant turn rate and velocity, CTRV).
"""

from dataclasses import dataclass
from typing import ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.lanes import LANE_STEP_M
from dsrc.closed_loop.types import LaneMap, Tracks
from sim.boxes import CLASSES
from sim.geometry import Array
from sim.rows import Rows

_PEDESTRIAN = CLASSES.index("pedestrian")
_CHOICE_S = 1.6
"""Time after which lanes are compared with the turn rate, s."""
_STRAIGHT_M = 0.5
"""Distance that a bend of one radian counts for in that comparison, m."""
_BESIDE = 0.5
"""Share of the distance from a lane that counts in it."""


class PredictionSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the prediction.

    Attributes:
        horizon_s: length of predictions.
        step_s: interval of predicted poses.
        still_mps: speed below which a road user stands; a track that does, stays.
        turn_decay_s: time in which a turn rate decays to 1/e, off the lanes.
        turn_least_rad_s: turn rate below which a track goes straight on.
        lateral_mps2: highest lateral acceleration: faster ones turn less, and take no tight bend.
        brakes_mps2: hardest braking before a bend.
        brakes_s: how long a braking lasts.
        accelerates_s: how long an acceleration lasts.
        sideways_s: how long a motion across the lane lasts.
        sideways_mps: motion across the lane that is none.
        spread_mps: growth of the uncertainty of a moving track, across its path.
        spread_m: largest uncertainty.
    """

    horizon_s: float = 5.0
    step_s: float = 0.2
    still_mps: float = 0.3
    turn_decay_s: float = 3.0
    turn_least_rad_s: float = 0.02
    lateral_mps2: float = 5.5
    brakes_mps2: float = 3.0
    brakes_s: float = 2.5
    accelerates_s: float = 1.0
    sideways_s: float = 2.5
    sideways_mps: float = 0.3
    spread_mps: float = 0.04
    spread_m: float = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Prediction(Rows):
    """Predicted boxes of tracks: H hypotheses, one or more of each track, at T instants.

    Attributes:
        time_s: (T,) from the present on, s; the first is 0.
        xy: (H, T, 2) centres, world, m.
        yaw: (H, T) rad.
        size: (H, 2) length and width, m.
        spread_m: (H, T) standard deviation across the path, m.
        speed_mps: (H, T) speeds.
        still: (H, T) stands.
        row: (H,) row of the track.
        likely: (H,) the likeliest hypothesis of its track.
    """

    SHARED: ClassVar = ("time_s",)

    time_s: Array
    xy: Array
    yaw: Array
    size: Array
    spread_m: Array
    speed_mps: Array
    still: NDArray[np.bool_]
    row: NDArray[np.int64]
    likely: NDArray[np.bool_]


def predict(
    tracks: Tracks, acceleration: Array, lanes: LaneMap, settings: PredictionSettings | None = None
) -> Prediction:
    """Return where tracks will be.

    Args:
        acceleration: (N,) change of their speeds, m/s2.
        lanes: lanes ahead of them.
        settings: default: `PredictionSettings()`.
    """
    settings = settings or PredictionSettings()
    time = np.arange(0.0, settings.horizon_s + 1e-9, settings.step_s)
    n, count = len(tracks), len(time)
    boxes, speed = tracks.boxes, np.hypot(*tracks.velocity.T)
    xy = np.repeat(boxes.center[:, None, :2], count, axis=1)
    yaw = np.repeat(boxes.yaw[:, None], count, axis=1)
    speeds = np.zeros((n, count))
    spread = np.repeat(np.minimum(tracks.position_sd, settings.spread_m)[:, None], count, axis=1)
    row, likely = np.arange(n), np.ones(n, bool)
    moving = np.flatnonzero(speed > settings.still_mps)
    if len(moving) == 0:
        return Prediction(time, xy, yaw, boxes.size[:, :2], spread, speeds, np.ones((n, count), bool), row, likely)
    direction = np.arctan2(tracks.velocity[moving, 1], tracks.velocity[moving, 0])
    walks = boxes.label[moving] == _PEDESTRIAN
    speeds[moving] = _speeds(speed[moving], np.where(walks, 0.0, acceleration[moving]), time, settings)
    done = np.zeros((len(moving), count))
    done[:, 1:] = np.cumsum(0.5 * (speeds[moving, 1:] + speeds[moving, :-1]) * settings.step_s, axis=1)
    rate = np.where(walks, 0.0, tracks.yaw_rate[moving])
    turned = _turns(rate, speed[moving], time, settings)
    xy[moving] = _along_arcs(xy[moving], direction, turned, done)
    yaw[moving] = boxes.yaw[moving, None] + turned
    spread[moving] = np.minimum(spread[moving] + settings.spread_mps * time, settings.spread_m)
    still = speeds < settings.still_mps
    whole = Prediction(time, xy, yaw, boxes.size[:, :2], spread, speeds, still, row, likely)
    driving = np.flatnonzero(~walks)
    if len(driving) == 0:
        return whole
    pose = np.column_stack([boxes.center[moving[driving], :2], direction[driving]])
    found = lanes.ahead(pose, done[driving, -1])
    ways = [(place, line) for place, lines in zip(driving.tolist(), found, strict=True) for line in lines]
    if not ways:
        return whole
    return _on_lanes(whole, tracks, ways, moving, direction, done, settings)


def _speeds(speed: Array, acceleration: Array, time: Array, settings: PredictionSettings) -> Array:
    """Return (M, T) speeds: a change of speed lasts for a while."""
    lasts = np.where(acceleration < 0.0, settings.brakes_s, settings.accelerates_s)
    return np.maximum(speed[:, None] + acceleration[:, None] * np.minimum(time, lasts[:, None]), 0.0)


def _turns(rate: Array, speed: Array, time: Array, settings: PredictionSettings) -> Array:
    """Return (M, T) turned angles, rad."""
    bound = settings.lateral_mps2 / np.maximum(speed, 1.0)
    rate = np.where(np.abs(rate) < settings.turn_least_rad_s, 0.0, np.clip(rate, -bound, bound))
    decay = settings.turn_decay_s
    return rate[:, None] * decay * (1.0 - np.exp(-time / decay))


def _along_arcs(xy: Array, direction: Array, turned: Array, done: Array) -> Array:
    """Return (M, T, 2) positions after the distances `done` in the directions so far."""
    heading = direction[:, None] + 0.5 * (turned[:, 1:] + turned[:, :-1])
    step = np.diff(done, axis=1)
    out = xy.copy()
    out[:, 1:, 0] += np.cumsum(step * np.cos(heading), axis=1)
    out[:, 1:, 1] += np.cumsum(step * np.sin(heading), axis=1)
    return out


def _on_lanes(
    whole: Prediction,
    tracks: Tracks,
    ways: list[tuple[int, Array]],
    moving: NDArray[np.int64],
    direction: Array,
    done: Array,
    settings: PredictionSettings,
) -> Prediction:
    """Return the prediction with tracks on lanes moved along them.

    Args:
        whole: without lanes, one hypothesis for each track.
        ways: (place among the moving tracks, lane ahead) of each hypothesis.
        moving: (M,) rows of the moving tracks.
        direction: (M,) of motion, rad.
        done: (M, T) distances covered, m.
    """
    place = np.array([one for one, _ in ways])
    row = moving[place]
    lines, length = _stacked([line for _, line in ways])
    start, ahead = lines[:, 0], direction[place]
    speed = whole.speed_mps[row]
    normal = np.stack([-np.sin(start[:, 2]), np.cos(start[:, 2])], axis=1)
    tangent = np.stack([np.cos(start[:, 2]), np.sin(start[:, 2])], axis=1)
    offset = tracks.boxes.center[row, :2] - start[:, :2]
    left, first = (offset * normal).sum(1), (offset * tangent).sum(1)
    sideways = speed[:, 0] * np.sin(ahead - start[:, 2])
    sideways = np.sign(sideways) * np.maximum(np.abs(sideways) - settings.sideways_mps, 0.0)
    aside = left[:, None] + sideways[:, None] * np.minimum(whole.time_s, settings.sideways_s)
    at = np.maximum(first[:, None] + done[place], 0.0) / LANE_STEP_M
    low = np.minimum(at.astype(np.int64), length[:, None] - 2)
    share = at - low  # beyond its end a lane goes straight on
    points, first_of = lines.reshape(-1, 3), np.arange(len(ways)) * lines.shape[1]
    base, onward = (points.take(first_of[:, None] + low + step, axis=0) for step in (0, 1))
    heading = base[..., 2] + np.clip(share, 0.0, 1.0) * (onward[..., 2] - base[..., 2])
    xy = base[..., :2] + share[..., None] * (onward[..., :2] - base[..., :2])
    xy[..., 0] -= aside * np.sin(heading)
    xy[..., 1] += aside * np.cos(heading)
    xy[:, 0] = tracks.boxes.center[row, :2]
    yaw = heading.copy()
    yaw[:, 0] = tracks.boxes.yaw[row]
    fit = np.ones(len(ways), bool)
    several = np.flatnonzero(np.bincount(place, minlength=len(moving))[place] > 1)
    if len(several):
        fit[several] = _takes(lines[several], length[several], speed[several, 0], done[place[several], -1], settings)
    choice = min(round(_CHOICE_S / settings.step_s), len(whole.time_s) - 1)
    # The likeliest lane is nearest to where its turn rate leads; as long as all are, the straightest.
    end = np.minimum(done[place, -1] / LANE_STEP_M, length - 1).astype(np.int64)
    bent = np.abs(points[first_of + end, 2] - start[:, 2])
    off = np.hypot(*(xy[:, choice] - whole.xy[row, choice]).T) + _STRAIGHT_M * bent
    off += _BESIDE * np.abs(left) + 100.0 * ~fit
    likely = np.zeros(len(ways), bool)
    order = np.lexsort((off, row))
    likely[order[np.concatenate([[True], np.diff(row[order]) > 0])]] = True
    taken = fit | likely
    stays = np.ones(len(whole), bool)
    stays[row] = False
    return Prediction(
        time_s=whole.time_s,
        xy=np.concatenate([whole.xy[stays], xy[taken]]),
        yaw=np.concatenate([whole.yaw[stays], yaw[taken]]),
        size=np.concatenate([whole.size[stays], whole.size[row[taken]]]),
        spread_m=np.concatenate([whole.spread_m[stays], whole.spread_m[row[taken]]]),
        speed_mps=np.concatenate([whole.speed_mps[stays], speed[taken]]),
        still=np.concatenate([whole.still[stays], whole.still[row[taken]]]),
        row=np.concatenate([whole.row[stays], row[taken]]),
        likely=np.concatenate([whole.likely[stays], likely[taken]]),
    )


def _takes(
    lines: Array, length: NDArray[np.int64], speed: Array, reach: Array, settings: PredictionSettings
) -> NDArray[np.bool_]:
    """Return which lanes allow a speed: nobody takes a bend for which it would have to brake hard."""
    bend = np.abs(np.diff(lines[..., 2], axis=1)) / LANE_STEP_M
    allowed = settings.lateral_mps2 / np.maximum(bend, 1e-3)
    there = np.arange(bend.shape[1]) * LANE_STEP_M
    inside = there < np.minimum(reach, (length - 1) * LANE_STEP_M)[:, None]
    slowed = speed[:, None] ** 2 - 2.0 * settings.brakes_mps2 * there
    return ((slowed <= allowed + 4.0) | ~inside).all(axis=1)


def _stacked(lines: list[Array]) -> tuple[Array, NDArray[np.int64]]:
    """Return (M, K, 3) lines, filled up by their last points, and their (M,) numbers of points."""
    length = np.array([len(line) for line in lines])
    out = np.zeros((len(lines), length.max(), 3))
    for row, line in enumerate(lines):
        out[row, : len(line)] = line
        out[row, len(line) :] = line[-1]
    return out, length
