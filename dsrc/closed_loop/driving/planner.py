"""Planner: the acceleration with the most progress among those that are safe against the predicted road users.

Several profiles of speed along the route are tested against the stations that predicted road users block over time, as
in path-time planning (K. Kant, S. Zucker, *Toward Efficient Trajectory Planning: The Path-Velocity Decomposition*, IJRR
1986). An acceleration is comfortable if a comfortable way on from it is free with all clearances; only when there is
none, clearances shrink and brakes grow, step by step. Behind leaders and before stop lines the improved intelligent
driver model bounds the acceleration.
"""

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.idm import IdmSettings, following_acceleration, free_acceleration
from dsrc.closed_loop.driving.lanes import RouteLanes
from dsrc.closed_loop.driving.occupancy import ClearanceSettings, Occupancy, occupancy_of
from dsrc.closed_loop.driving.path import STEP_M, Path, path_of
from dsrc.closed_loop.driving.prediction import PredictionSettings, predict
from dsrc.closed_loop.driving.profiles import Profiles, profiles_of
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Tracks
from sim.geometry import Array
from sim.traffic.base import TrafficLight

_FIRST = np.array([-6.5, -5.5, -4.5, -3.5, -3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
_THEN = np.array([-5.0, -3.5, -2.5, -1.5, 0.0, 1.5])
_CREEPING_MPS, _STILL_MPS = 1.5, 0.1
_BEYOND_M, _COARSE_M, _AWAY_M = 5.0, 4.0, 15.0


class PlannerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the planner.

    Attributes:
        prediction: of others.
        clearance: to others.
        following: of leaders and stop lines.
        comfortable_mps2: braking that is comfortable, also as the later part of a plan.
        firm_mps2: braking that is firm; following never brakes harder.
        end_mps2: braking with which the ego stays behind those ahead of it at the end of a plan.
        change_s: duration of the first acceleration of a plan.
        lateral_mps2: highest lateral acceleration in bends (nuPlan's bound of comfort is 4.89).
        bend_mps2: braking before bends.
        late_s: time after which an unlikely hypothesis must still be avoidable.
        late_mps2: braking with which it is.
        yellow_mps2: braking above which the ego passes a yellow light.
        line_m: gap between bumper and stop line.
        sure_s: time to an impact up to which a first alarm is believed at once; else it brakes firmly for one step.
        leader_s: time within which who comes onto the path along it is a leader.
        smooth_s: smoothing of the accelerations of tracks.
    """

    prediction: PredictionSettings = PredictionSettings()
    clearance: ClearanceSettings = ClearanceSettings()
    following: IdmSettings = IdmSettings()
    comfortable_mps2: float = 2.5
    firm_mps2: float = 4.0
    end_mps2: float = 4.5
    change_s: float = 1.0
    lateral_mps2: float = 4.9
    bend_mps2: float = 2.0
    late_s: float = 0.6
    late_mps2: float = 6.5
    yellow_mps2: float = 3.0
    line_m: float = 0.8
    sure_s: float = 1.5
    leader_s: float = 3.0
    smooth_s: float = 0.4


@dataclass(frozen=True, slots=True)
class _Bound:
    """Upper bound of the acceleration, with what decided it."""

    acceleration_mps2: float
    reason: str
    track: int = -1


class PlanningDriver:
    """Driver that predicts its tracks and plans its speed along its route; see the module.

    Args:
        settings: default: `PlannerSettings()`.
    """

    def __init__(self, settings: PlannerSettings | None = None) -> None:
        self.settings = settings or PlannerSettings()
        self.reset()

    def reset(self, lanes: LaneMap | None = None) -> None:
        """Begin an episode.

        Args:
            lanes: lanes ahead of others; None for the bends of the ego's own route.
        """
        self._lanes = lanes
        self._speeds: dict[int, tuple[float, float]] = {}
        self._last_s = -math.inf
        self._stopping = self._alarmed = False

    def decide(self, ego: EgoState, tracks: Tracks, most_mps2: float = math.inf) -> Decision:
        """Return the acceleration for the next step.

        Args:
            most_mps2: bound of it, for what may be hidden.
        """
        s = self.settings
        horizon_s, length_m = s.prediction.horizon_s, float(ego.box.size[0, 0])
        reach_m = length_m + _BEYOND_M + ego.speed_mps * horizon_s + 0.5 * s.following.acceleration_mps2 * horizon_s**2
        path = path_of(ego.route, float(ego.box.yaw[0]), s.lateral_mps2, reach_m)
        tracks = tracks[_relevant(ego, path, tracks, horizon_s)]
        prediction = predict(tracks, self._accelerations(tracks), self._lanes or RouteLanes(path), s.prediction)
        occupancy = occupancy_of(path, ego.box.size[0, :2], prediction, s.clearance)
        line_m = self._stop_line(ego)
        bound = self._bound(ego, path, occupancy, line_m, tracks, prediction.time_s)
        if most_mps2 < bound.acceleration_mps2:
            bound = _Bound(most_mps2, "hidden")
        occupancy = _with_line(occupancy, line_m, len(prediction.time_s))
        return self._choose(ego, bound, occupancy, prediction.time_s, tracks)

    def known_accelerations(self, tracks: Tracks) -> Array:
        """Return the (N,) smoothed changes of speed of tracks at the last decision, m/s2; 0 if it did not mind them."""
        known = [self._speeds.get(number, (0.0, 0.0))[1] for number in tracks.boxes.object_id.tolist()]
        return np.clip(np.array(known, np.float64), -8.0, 3.0)

    def _accelerations(self, tracks: Tracks) -> Array:
        """Return the (N,) smoothed changes of speed of tracks, m/s2."""
        speed = np.hypot(*tracks.velocity.T)
        since = tracks.time_s - self._last_s
        out, now = np.zeros(len(tracks)), {}
        share = 1.0 - math.exp(-since / self.settings.smooth_s) if 1e-6 < since < 1.0 else 0.0
        for row, number in enumerate(tracks.boxes.object_id.tolist()):
            was = self._speeds.get(number)
            if was is not None and share:
                out[row] = was[1] + share * ((speed[row] - was[0]) / since - was[1])
            now[number] = (float(speed[row]), float(out[row]))
        self._speeds, self._last_s = now, tracks.time_s
        return np.clip(out, -8.0, 3.0)

    def _stop_line(self, ego: EgoState) -> float:
        """Return the distance from the front bumper to the line to stop at, m; inf without one."""
        s = self.settings
        self._stopping, was = False, self._stopping
        for light in ego.lights:
            if self._stops_at(light, ego, s.yellow_mps2 + 1.5 * was):
                self._stopping = True
                return light.distance_m
        return math.inf

    def _stops_at(self, light: TrafficLight, ego: EgoState, yellow_mps2: float) -> bool:
        if light.state in ("green", "off") or light.distance_m < 0.0:
            return False
        needed = 0.5 * ego.speed_mps**2 / max(light.distance_m, 0.01)
        return needed <= (yellow_mps2 if light.state == "yellow" else ego.limits.deceleration_mps2)

    def _bound(
        self, ego: EgoState, path: Path, occupancy: Occupancy, line_m: float, tracks: Tracks, time_s: Array
    ) -> _Bound:
        """Return the strongest acceleration by limit, bends, leaders and stop lines."""
        s, speed = self.settings, ego.speed_mps
        strongest = min(s.following.acceleration_mps2, ego.limits.acceleration_mps2)
        model = msgspec.structs.replace(s.following, acceleration_mps2=max(strongest, 0.1))
        wanted = ego.limits.speed_mps
        bounds = [_Bound(max(free_acceleration(speed, wanted, model), -s.comfortable_mps2), "free")]
        allowed = float(np.sqrt(path.bend_mps**2 + 2.0 * s.bend_mps2 * path.along).min())
        bounds.append(_Bound(max((allowed - speed) / 0.5, -s.firm_mps2), "free"))
        if math.isfinite(line_m):
            held = msgspec.structs.replace(model, standing_m=s.line_m)
            stop = following_acceleration(speed, wanted, max(line_m, 0.0), 0.0, held)
            bounds.append(_Bound(max(stop, -ego.limits.deceleration_mps2), "signal"))
        for gap_m, lead_mps, row in _leaders(occupancy, time_s, s):
            follow = following_acceleration(speed, wanted, gap_m, lead_mps, model)
            number = int(tracks.boxes.object_id[row])
            bounds.append(_Bound(max(follow, -s.firm_mps2), "follow", number))
        return min(bounds, key=lambda bound: bound.acceleration_mps2)

    def _choose(self, ego: EgoState, bound: _Bound, occupancy: Occupancy, time_s: Array, tracks: Tracks) -> Decision:
        """Return the decision among the profiles below the bound."""
        s, hardest = self.settings, ego.limits.deceleration_mps2
        cap = min(bound.acceleration_mps2, ego.limits.acceleration_mps2)
        first = np.unique(np.minimum(np.append(_FIRST, [-hardest, cap]), cap))
        one = np.repeat(first, len(_THEN) + 1)
        then = np.column_stack([np.broadcast_to(_THEN, (len(first), len(_THEN))), first]).ravel()
        top = max(ego.speed_mps, ego.limits.speed_mps)
        plans = profiles_of(ego.speed_mps, top, one, np.maximum(then, -hardest), s.change_s, time_s)
        plain = Decision(float(cap), bound.reason, bound.track)
        if len(occupancy) == 0:
            self._alarmed = False
            return plain
        # Whom the ego stands beside, closer than it would pass, it may leave.
        leaves = (occupancy.near[:, 0, 0] < 0.0) & (occupancy.near[:, 1, 0] < 0.5 * ego.box.size[0, 0])
        certain = occupancy[occupancy.likely & ~leaves]
        near = _hits(plans, certain.near)
        near |= _ends_unsafe(plans, certain, s.end_mps2 + 2.0)
        wide = _hits(plans, np.where(_inside_now(certain)[:, None, None], certain.near, certain.wide))
        wide |= near | _ends_unsafe(plans, certain, s.end_mps2)
        late = self._late(ego, first, occupancy, time_s, top)
        hit_near, hit_wide = near.any(1), wide.any(1)
        ready = np.repeat(late, len(_THEN) + 1)
        gentle = plans.then_mps2 >= plans.first_mps2 - 1e-9
        limit = s.comfortable_mps2 + 1e-9
        comfortable = (plans.first_mps2 >= -limit) & (plans.then_mps2 >= -limit)
        firm = (plans.first_mps2 >= -s.firm_mps2 - 1e-9) & gentle
        tiers = (
            ~hit_wide & comfortable & ready,
            ~hit_wide & firm & ready,
            ~hit_near & comfortable & gentle & ready,
            ~hit_wide & gentle,
            ~hit_near & gentle,
        )
        for rank, tier in enumerate(tiers):  # noqa: B007
            if tier.any():
                chosen = float(plans.first_mps2[tier].max())
                break
        else:
            rank, chosen = len(tiers), self._least_bad(plans, certain)
        if chosen >= cap - 1e-6:
            self._alarmed = False
            return plain
        alarmed, self._alarmed = self._alarmed, rank >= 3
        if ego.speed_mps < _STILL_MPS:
            chosen = max(chosen, -s.comfortable_mps2)
        elif self._alarmed and not alarmed and self._first_impact_s(plans, certain, time_s) > s.sure_s:
            chosen = max(chosen, -s.firm_mps2)
        blocking = self._blocking(plans, certain, near, wide, cap)
        number = int(tracks.boxes.object_id[blocking]) if blocking >= 0 else -1
        if chosen < -s.firm_mps2 - 0.5 or (rank >= 3 and chosen < -s.comfortable_mps2 - 1e-6):
            return Decision(chosen, "emergency", number)
        creeps = ego.speed_mps < _CREEPING_MPS and 0.0 < chosen < 1.0
        return Decision(chosen, "creep" if creeps else "signal" if blocking < 0 else "yield", number)

    def _late(self, ego: EgoState, first: Array, occupancy: Occupancy, time_s: Array, top: float) -> NDArray[np.bool_]:
        """Return which first accelerations leave time to brake for unlikely hypotheses; all, where none does."""
        s = self.settings
        doubtful = occupancy[~occupancy.likely]
        if len(doubtful) == 0:
            return np.ones(len(first), bool)
        plans = profiles_of(ego.speed_mps, top, first, np.full(len(first), -s.late_mps2), s.late_s, time_s)
        fine = np.asarray(~_hits(plans, doubtful.near).any(1))
        return fine if fine.any() else np.ones(len(first), bool)

    def _first_impact_s(self, plans: Profiles, occupancy: Occupancy, time_s: Array) -> float:
        """Return the first impact of any plan, s; inf without one."""
        hit = np.asarray(_inside(plans, occupancy.near).any(axis=(0, 1)))
        hit[0] = False
        return float(time_s[hit.argmax()]) if hit.any() else math.inf

    def _least_bad(self, plans: Profiles, occupancy: Occupancy) -> float:
        """Return the first acceleration of the profile with the latest and then the slowest impact."""
        hit = np.asarray(_inside(plans, occupancy.near).any(axis=1))
        hit[:, 0] = False
        when = np.where(hit.any(1), hit.argmax(1), hit.shape[1])
        speed = plans.speed_mps[np.arange(len(plans)), np.minimum(when, hit.shape[1] - 1)]
        return float(plans.first_mps2[np.lexsort((plans.first_mps2, speed, -when))[0]])

    def _blocking(
        self, plans: Profiles, occupancy: Occupancy, near: NDArray[np.bool_], wide: NDArray[np.bool_], cap: float
    ) -> int:
        """Return the row of the track that the fastest plans would meet first; -1 for a stop line."""
        fast = plans.first_mps2 >= cap - 1e-6
        for hits in (near, wide):
            rows = hits[fast].sum(0)
            if rows.any():
                return int(occupancy.row[int(rows.argmax())])
        return -1


def _relevant(ego: EgoState, path: Path, tracks: Tracks, horizon_s: float) -> NDArray[np.bool_]:
    """Return the (N,) mask of tracks that matter: not the ego itself, nor who follows it and has to mind it.

    Nor who cannot reach its path within the horizon, or drives away from it.
    """
    boxes, velocity = tracks.boxes, tracks.velocity
    dx, dy = (boxes.center[:, axis] - ego.box.center[0, axis] for axis in (0, 1))
    yaw = float(ego.box.yaw[0])
    c, s = math.cos(yaw), math.sin(yaw)
    ahead, left = c * dx + s * dy, c * dy - s * dx
    length, width = ego.box.size[0, :2]
    itself = (np.abs(ahead) < 0.5 * length) & (np.abs(left) < 0.5 * width)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    forward = c * velocity[:, 0] + s * velocity[:, 1]
    alike = np.where(speed > 0.5, forward > 0.75 * speed, np.abs(np.cos(boxes.yaw - yaw)) > 0.75)
    beside = np.abs(left) < 0.5 * (width + boxes.size[:, 1]) + 0.5
    follows = (ahead + 0.5 * boxes.size[:, 0] < 0.0) & alike & beside
    # From every body to points of the path: who is too far, or drives away from all of it.
    points = path.xy[:: round(_COARSE_M / STEP_M)]
    px, py = (points[:, axis] - boxes.center[:, axis, None] for axis in (0, 1))
    gap = np.hypot(px, py)
    nearest = gap.min(axis=1)
    far = nearest > (speed + 2.0) * horizon_s + 0.5 * (length + boxes.size[:, 0]) + _BEYOND_M
    keep = ~itself & ~follows & ~far
    maybe = np.flatnonzero(keep & (nearest > _AWAY_M) & (speed > 1.0))
    towards = velocity[maybe, :1] * px[maybe] + velocity[maybe, 1:] * py[maybe]
    keep[maybe] = (towards / np.maximum(gap[maybe], 1e-6)).max(axis=1) >= -0.2 * speed[maybe]
    return keep


def _leaders(occupancy: Occupancy, time_s: Array, settings: PlannerSettings) -> list[tuple[float, float, int]]:
    """Return gap, m, speed along the path, m/s, and row of those who are on the path ahead or come onto it along it."""
    found = []
    for k in np.flatnonzero(occupancy.likely):
        low = occupancy.near[k, 0]
        here = np.isfinite(low) & (time_s <= settings.leader_s) & (low > -2.0 * STEP_M)
        if not here.any():
            continue
        at = int(here.argmax())
        lead = float(occupancy.along_mps[k, at])
        if at == 0 and np.isfinite(occupancy.now[k]):
            if lead > -0.5 and (occupancy.aligned[k, 0] or occupancy.still[k, 0]):
                found.append((float(occupancy.now[k]), max(lead, 0.0), int(occupancy.row[k])))
        elif occupancy.aligned[k, at]:
            gap = float(low[at]) - lead * float(time_s[at])
            if gap > 0.0:
                found.append((gap, lead, int(occupancy.row[k])))
    return found


def _with_line(occupancy: Occupancy, line_m: float, steps: int) -> Occupancy:
    """Return the occupancy with a stop line that the front must not pass."""
    if not math.isfinite(line_m):
        return occupancy
    wall = np.broadcast_to(np.array([[max(line_m, 0.05)], [1e6]]), (1, 2, steps))
    none = np.zeros((1, steps))
    return Occupancy(
        near=np.concatenate([occupancy.near, wall]),
        wide=np.concatenate([occupancy.wide, wall]),
        now=np.append(occupancy.now, max(line_m, 0.0)),
        along_mps=np.concatenate([occupancy.along_mps, none]),
        aligned=np.concatenate([occupancy.aligned, none > 0.0]),
        still=np.concatenate([occupancy.still, none == 0.0]),
        row=np.append(occupancy.row, -1),
        likely=np.append(occupancy.likely, True),
    )


def _inside(plans: Profiles, rows: Array) -> NDArray[np.bool_]:
    """Return the (P, R, T) mask of plans inside intervals."""
    along = plans.along_m[:, None]
    return (along > rows[:, 0]) & (along < rows[:, 1])


def _hits(plans: Profiles, rows: Array) -> NDArray[np.bool_]:
    """Return the (P, R) mask of plans that enter intervals after the present, which no plan can change."""
    return np.asarray(_inside(plans, rows)[..., 1:].any(axis=-1))


def _inside_now(occupancy: Occupancy) -> NDArray[np.bool_]:
    """Return the (R,) mask of those whose clearances the ego is within already."""
    return (occupancy.wide[:, 0, 0] < 0.0) & (occupancy.wide[:, 1, 0] > 0.0)


def _ends_unsafe(plans: Profiles, occupancy: Occupancy, brakes_mps2: float) -> NDArray[np.bool_]:
    """Return the (P, R) mask of plans that end too fast behind somebody who stands or drives along the path."""
    low, lead = occupancy.near[:, 0, -1], np.maximum(occupancy.along_mps[:, -1], 0.0)
    waits = np.isfinite(low) & (occupancy.aligned[:, -1] | occupancy.still[:, -1])
    gap = low - plans.along_m[:, -1:]
    faster = np.maximum(plans.speed_mps[:, -1:] ** 2 - lead**2, 0.0) / (2.0 * brakes_mps2)
    return waits & (gap > -STEP_M) & (gap < faster)
