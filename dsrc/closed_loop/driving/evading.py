"""Evading driver: plans as `PlanningDriver` does, and steers around somebody where full braking would still hit them.

In an emergency it drives a bicycle model ahead, for several offsets from its route and accelerations, within the
friction circle of its tyres, and takes the smallest offset that hits nobody; full braking along the route comes first.
It stays on lanes: of its own direction, or oncoming ones where it sees all that it would drive over; like the driver
that it plans as, it expects nobody whom it does not see. From then on it decides so at
every step, until the smallest offset is none and it is back on its route. Sampling of ends in lateral offset: M.
Werling et al., *Optimal Trajectory Generation for Dynamic Street Scenarios in a Frenet Frame*, ICRA 2010; when to
evade and when to brake: C. Schmidt et al., *Research on Trajectory Planning in Emergency Situations*, IV 2006.

Without a map of lanes it never steers.
"""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.bicycle import STEERING_RAD_S, bicycle_step, steering_for, wheels_of
from dsrc.closed_loop.driving.path import Path, path_of
from dsrc.closed_loop.driving.planner import PlannerSettings, PlanningDriver
from dsrc.closed_loop.driving.prediction import Prediction, predict
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Tracks
from dsrc.messages.seen_space import SeenSpace
from sim.boxes import Boxes
from sim.collisions import overlap
from sim.geometry import Array

_STEP_S = 0.1
_TURN_S = 0.3
"""Time in which the heading follows where it steers to, s."""
_AIM_S, _AIM_M = 0.5, 6.0
"""Way over which it steers to an offset, s and at least m."""
_BEND_M = 3.0
"""Way before and behind a place over which the bend of its route is measured, m."""
_BACK_M = 12.0
"""Route behind the ego that its offsets are measured from, m."""
_STATION_M, _ACROSS_M, _WIDEST_M = 4.0, 0.5, 5.0
_HALF_LANE_M = 1.85
"""Half of a lane with its share of the line, m."""
_BEND = 0.3
"""Share of the grip that is left for bends where it brakes fully."""
_ON_ROUTE_M, _ON_ROUTE_RAD = 0.12, 0.02


class EvadingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the evasion.

    Attributes:
        offsets_m: from the route, to the left, also mirrored.
        accelerations_mps2: while it steers, besides what the planner wants.
        slows_mps2: change of speed that it likes best beside somebody,
        passes_mps: down to this speed; below it gains as much.
        horizon_s: length of the trajectories.
        apart_m: from the body of the ego to others, before, behind and beside it.
    """

    offsets_m: tuple[float, ...] = (0.6, 1.2, 1.8, 2.4, 3.0, 3.6)
    accelerations_mps2: tuple[float, ...] = (-7.0, -6.0, -5.0, -2.5, 0.0)
    slows_mps2: float = -1.0
    passes_mps: float = 6.0
    horizon_s: float = 3.0
    apart_m: tuple[float, float] = (0.3, 0.2)


class EvadingDriver:
    """Driver that brakes, or steers around somebody where braking does not suffice; see the module.

    Args:
        settings: default: `EvadingSettings()`.
    """

    def __init__(self, settings: EvadingSettings | None = None, planning: PlannerSettings | None = None) -> None:
        self.settings = settings or EvadingSettings()
        self._planner = PlanningDriver(planning)
        self.reset()

    def reset(self, lanes: LaneMap | None = None) -> None:
        """Begin an episode, see `PlanningDriver.reset`."""
        self._planner.reset(lanes)
        self._lanes = lanes
        self._seen: SeenSpace | None = None
        self._last: EgoState | None = None
        self._steers, self._alarmed, self._offset_m = False, False, 0.0

    def see(self, seen: SeenSpace) -> None:
        """Take the newest seen space."""
        self._seen = seen

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return the acceleration for the next step, and the steering where the ego leaves its route."""
        plan = self._planner.decide(ego, tracks)
        last, self._last = self._last or ego, ego
        alarmed, self._alarmed = self._alarmed, plan.reason == "emergency"
        if self._lanes is None or not (self._steers or (alarmed and self._alarmed)):
            return plan
        path = _route(ego)
        where, aside = _beside(path, ego.box.center[:, :2])
        heading = math.remainder(float(ego.box.yaw[0] - path.heading[where[0]]), 2.0 * math.pi)
        offset, acceleration = self._choices(float(aside[0]), plan, ego)
        poses, steering = _driven(ego, wheels_of(last, ego), path, offset, acceleration, self.settings.horizon_s)
        if not self._steers and not self._hits(ego, tracks, poses[-1:], (0.0, 0.0))[0]:
            return plan
        free = (offset == 0.0) | self._on_lanes(ego, path, poses)
        free[free] = ~self._hits(ego, tracks, poses[free], self.settings.apart_m)
        best = int(free.argmax()) if free.any() else -1
        near = abs(aside[0]) < _ON_ROUTE_M and abs(heading) < _ON_ROUTE_RAD
        self._steers = bool(free.any() and offset[best]) or (self._steers and not near)
        self._offset_m = float(offset[best]) if self._steers else 0.0
        if not self._steers:
            return plan
        return Decision(float(acceleration[best]), "evade", plan.track, float(steering[best]))

    def _choices(self, aside_m: float, plan: Decision, ego: EgoState) -> tuple[Array, Array]:
        """Return (K,) offsets, m, and accelerations, m/s2, best first; the last one is full braking as it goes now."""
        s = self.settings
        sides = np.array([0.0, *s.offsets_m, *(-one for one in s.offsets_m)])
        # Home first, then as before: between equal ways it does not change its mind.
        sides = sides[np.argsort(np.where(sides == 0.0, -1.0, np.abs(sides - self._offset_m)), kind="stable")]
        liked = s.slows_mps2 if ego.speed_mps > s.passes_mps else -s.slows_mps2
        wanted = liked if plan.reason == "emergency" else plan.acceleration_mps2
        speeds = np.array([wanted, *s.accelerations_mps2])
        speeds = speeds[np.argsort(np.abs(speeds - wanted), kind="stable")]
        return (
            np.append(np.repeat(sides, len(speeds)), aside_m if self._steers else 0.0),
            np.append(np.tile(speeds, len(sides)), -ego.limits.deceleration_mps2),
        )

    def _hits(self, ego: EgoState, tracks: Tracks, poses: Array, apart_m: tuple[float, float]) -> NDArray[np.bool_]:
        """Return (K,) which (K, T, 3) trajectories touch somebody, or come so near."""
        assert self._lanes is not None
        settings = msgspec.structs.replace(
            self._planner.settings.prediction, horizon_s=self.settings.horizon_s, step_s=_STEP_S
        )
        near = np.hypot(*(tracks.boxes.center[:, :2] - ego.box.center[0, :2]).T) < 120.0
        accelerations = self._planner.known_accelerations(tracks[near])
        others = predict(tracks[near], accelerations, self._lanes, settings)
        others = others[others.likely]
        size = ego.box.size[0, :2] + 2.0 * np.array(apart_m)
        mine = _corners(poses, np.broadcast_to(size, (*poses.shape[:2], 2)))
        touched = np.zeros(len(poses), bool)
        for theirs, itself in zip(_outlines(others), _on_ego(ego, others), strict=True):
            if not itself:
                touched |= overlap(mine, theirs[None])[:, 1:].any(axis=1)
        return touched

    def _on_lanes(self, ego: EgoState, path: Path, poses: Array) -> NDArray[np.bool_]:
        """Return (K,) which trajectories stay on lanes that the ego may drive on."""
        assert self._lanes is not None
        along = np.arange(0.0, len(path), round(_STATION_M / (path.along[1] - path.along[0]))).astype(np.int64)
        across = np.arange(-_WIDEST_M, _WIDEST_M + 1e-6, _ACROSS_M)
        heading = path.heading[along]
        left = np.column_stack([-np.sin(heading), np.cos(heading)])
        places = path.xy[along][:, None] + across[:, None] * left[:, None]
        pose = np.concatenate([places, np.broadcast_to(heading[:, None, None], (*places.shape[:2], 1))], axis=2)
        pose = pose.reshape(-1, 3)
        oncoming = self._on_lane(pose + np.array([0.0, 0.0, math.pi]))
        if oncoming.any():
            oncoming &= self._seen is not None and self._seen.sees(pose[:, :2])
        lane = np.pad((self._on_lane(pose) | oncoming).reshape(places.shape[:2]), ((0, 0), (1, 1)))
        may = lane[:, 1:-1] & lane[:, :-2] & lane[:, 2:]  # not on its edge, beyond which a wall may stand
        where, aside = _beside(path, poses[..., :2].reshape(-1, 2))
        turned = np.abs(np.sin(poses[..., 2].ravel() - path.heading[where]))
        half = 0.5 * (ego.box.size[0, 1] + ego.box.size[0, 0] * turned)
        front = where + round(0.5 * ego.box.size[0, 0] / (path.along[1] - path.along[0]))
        fine = np.ones(len(where), bool)
        for row in (np.minimum(np.searchsorted(along, end), len(along) - 1) for end in (where, front)):
            for column, at in enumerate(across):
                covered = (at > aside - half) & (at < aside + half)
                fine &= ~covered | may[row, column]
        fine &= np.abs(aside) < _WIDEST_M - 1.0
        return np.asarray(fine.reshape(poses.shape[:2]).all(axis=1))

    def _on_lane(self, pose: Array) -> NDArray[np.bool_]:
        """Return (N,) whether a lane of that direction is at (N, 3) poses."""
        assert self._lanes is not None
        ways = self._lanes.ahead(pose, np.full(len(pose), 2.0))
        near = [min((math.hypot(*(way[0, :2] - at[:2])) for way in found), default=math.inf)
                for found, at in zip(ways, pose, strict=True)]  # fmt: skip
        return np.array(near) < _HALF_LANE_M


def _route(ego: EgoState) -> Path:
    """Return the route ahead of the ego, wherever it is beside it, with a straight piece behind."""
    line = ego.route[1:] if len(ego.route) > 2 else ego.route
    way = line[1] - line[0]
    begin = line[0] - way / np.hypot(*way) * _BACK_M
    return path_of(np.concatenate([[begin], line]), math.atan2(way[1], way[0]), 1.0)


def _beside(path: Path, xy: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the (N,) rows of a path nearest to (N, 2) places, and how far these are to the left of it, m."""
    apart = xy[:, None] - path.xy
    rows = np.einsum("nkc,nkc->nk", apart, apart).argmin(axis=1)
    offset, heading = apart[np.arange(len(rows)), rows], path.heading[rows]
    return rows, offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading)


def _driven(
    ego: EgoState, wheels_rad: Array, path: Path, offset_m: Array, acceleration_mps2: Array, horizon_s: float
) -> tuple[Array, Array]:
    """Return (K, T, 3) poses on the way to offsets from a path, and the (K,) steering that they begin with, rad."""
    length, grip = float(ego.box.size[0, 0]), ego.limits.deceleration_mps2
    pose = np.tile([*ego.box.center[0, :2], ego.box.yaw[0]], (len(offset_m), 1))
    speed, wheels = np.full(len(offset_m), ego.speed_mps), np.repeat(wheels_rad, len(offset_m))
    sideways = np.sqrt(np.maximum(grip**2 - acceleration_mps2**2, (_BEND * grip) ** 2))
    poses, first = [pose], np.zeros(len(offset_m))
    for step in range(round(horizon_s / _STEP_S)):
        rows, aside = _beside(path, pose[:, :2])
        bend = speed * _bend(path, rows)
        # Heading once the wheels, which take their time, are back to where the route needs them.
        turning = speed * np.sin(np.arctan(0.5 * np.tan(wheels))) / (0.5 * length)
        back_s = np.abs(wheels - steering_for(bend, speed, length)) / STEERING_RAD_S
        settled = pose[:, 2] + 0.5 * (turning - bend) * back_s
        target = path.heading[rows] + np.arctan2(offset_m - aside, np.maximum(_AIM_S * speed, _AIM_M))
        rate = bend + (np.remainder(target - settled + np.pi, 2.0 * np.pi) - np.pi) / _TURN_S
        most = sideways / np.maximum(speed, 0.5)
        steering = steering_for(np.clip(rate, -most, most), speed, length)
        first = steering if step == 0 else first
        pose, speed, wheels = bicycle_step(pose, speed, wheels, acceleration_mps2, steering, length, _STEP_S)
        speed = np.minimum(speed, max(ego.speed_mps, ego.limits.speed_mps))
        poses.append(pose)
    return np.stack(poses, axis=1), first


def _bend(path: Path, rows: NDArray[np.int64]) -> Array:
    """Return the (N,) bends of a path at rows, 1/m, positive to the left."""
    reach = round(_BEND_M / (path.along[1] - path.along[0]))
    far, near = np.minimum(rows + reach, len(path) - 1), np.maximum(rows - reach, 0)
    return np.asarray((path.heading[far] - path.heading[near]) / (path.along[far] - path.along[near]))


def _corners(pose: Array, size: Array) -> Array:
    """Return the (..., 4, 2) corners of footprints at (..., 3) poses."""
    place, flat = pose.reshape(-1, 3), np.ones((pose.size // 3, 1))
    boxes = np.concatenate([place[:, :2], flat, size.reshape(-1, 2), flat, place[:, 2:]], axis=1)
    return Boxes.from_array(boxes).bev_polygons().reshape(*pose.shape[:-1], 4, 2)


def _outlines(others: Prediction) -> Array:
    """Return the (H, T, 4, 2) corners of predicted bodies."""
    pose = np.concatenate([others.xy, others.yaw[..., None]], axis=-1)
    return _corners(pose, np.broadcast_to(others.size[:, None], (*others.yaw.shape, 2)))


def _on_ego(ego: EgoState, others: Prediction) -> NDArray[np.bool_]:
    """Return (H,) which bodies are the ego itself, or follow it and have to mind it."""
    yaw = float(ego.box.yaw[0])
    dx, dy = (others.xy[:, 0] - ego.box.center[0, :2]).T
    ahead, left = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    length, width = ego.box.size[0, :2]
    itself = (np.abs(ahead) < 0.5 * length) & (np.abs(left) < 0.5 * width)
    alike = np.cos(others.yaw[:, 0] - yaw) > 0.75
    behind = (ahead + 0.5 * others.size[:, 0] < 0.0) & (np.abs(left) < 0.5 * (width + others.size[:, 1]))
    return np.asarray(itself | (alike & behind))
