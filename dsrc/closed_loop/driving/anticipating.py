"""Anticipating driver: plans as `PlanningDriver` does, and expects a road user wherever one could be hidden.

At the edge of the seen space of every lane that crosses its path or merges into it, it assumes a phantom that comes at
the lane's speed limit, and others behind it without end; on its own lane one that stands. It only drives so fast that
it can stop before all of them, or be through before the first arrives, whoever appears; so it slows down before a
blind corner, creeps until it sees enough, and goes. Phantom agents: Y. Tian et al., *Autonomous Driving at Unsignalized
Intersections with Occlusions*; reachable sets: M. Koschi, M. Althoff, *Set-Based Prediction of Traffic Participants
Considering Occlusions and Traffic Rules*, IEEE T-IV 2021; both and a joint planner: arXiv 2402.01507.

What was seen a moment ago counts: nobody is expected where they cannot have come since then. Who is hidden behind a
tracked vehicle on its own lane comes after it and is no phantom. Nobody is trusted to obey signs or lights.
Pedestrians, who are on no lane, are not anticipated.
"""

import math
from collections import deque

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.occupancy import Occupancy, occupancy_of
from dsrc.closed_loop.driving.path import STEP_M, Path, path_of
from dsrc.closed_loop.driving.planner import PlannerSettings, PlanningDriver
from dsrc.closed_loop.driving.prediction import Prediction
from dsrc.closed_loop.driving.profiles import Profiles, profiles_of
from dsrc.closed_loop.types import ConflictLane, Decision, EgoState, LaneMap, Tracks
from dsrc.messages.seen_space import SeenSpace
from sim.boxes import Boxes
from sim.geometry import Array
from sim.rows import stacked

_FIRST = np.array([-6.5, -5.5, -4.5, -3.75, -3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 2.6])
_KEPT_S = (0.3, 0.8, 1.4, 2.0, 3.0)
"""Times for which a plan keeps its first acceleration before it brakes."""
_CREEP_MPS2, _CREEP_S = 1.0, 0.5
_SLACK_M = 0.02
"""Way that the ego may still roll where it should stand, m: it needs some to stop."""
_VIEWS = 4
"""Number of newest seen spaces that count."""
_MARGIN_M, _AMONG_M = 0.5, 1.0
"""How far into a zone it rather stops than goes on, and how far in it is among those who block it, m."""


class AnticipatingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the anticipation.

    Attributes:
        brakes_mps2: braking with which it stops before a phantom.
        goes_mps2: acceleration with which it is through before one.
        appears_s: time from where somebody can be seen until it is tracked.
        hides_m: length of hidden lane from which on it hides somebody.
        size_m: length and width of a phantom, m.
        surely_m: distance on its own lane up to which somebody stands wherever it does not see.
        enters_s: time that a phantom needs to cross the path, or until it follows the ego.
        creeps_mps: speed up to which it goes on where it sees too little: who comes sees its nose, and it who comes.
    """

    brakes_mps2: float = 4.0
    goes_mps2: float = 2.0
    appears_s: float = 0.4
    hides_m: float = 3.0
    size_m: tuple[float, float] = (4.6, 1.9)
    surely_m: float = 80.0
    enters_s: float = 1.0
    creeps_mps: float = 2.0


class AnticipatingDriver:
    """Driver that expects road users where it cannot see; see the module. Without a seen space it sees everything.

    Args:
        settings: default: `AnticipatingSettings()`.
    """

    def __init__(self, settings: AnticipatingSettings | None = None, planning: PlannerSettings | None = None) -> None:
        self.settings = settings or AnticipatingSettings()
        self._planner = PlanningDriver(planning)
        self.reset()

    def reset(self, lanes: LaneMap | None = None) -> None:
        """Begin an episode, see `PlanningDriver.reset`."""
        self._planner.reset(lanes)
        self._lanes = lanes
        self._seen: deque[SeenSpace] = deque(maxlen=_VIEWS)

    def see(self, seen: SeenSpace) -> None:
        """Take the newest seen space."""
        self._seen.append(seen)

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return the acceleration for the next step."""
        creeps = min((self.settings.creeps_mps - ego.speed_mps) / _CREEP_S, _CREEP_MPS2)
        most = self._most(ego, tracks)
        return self._planner.decide(ego, tracks, max(most, creeps) if creeps > 0.0 else most)

    def _most(self, ego: EgoState, tracks: Tracks) -> float:
        """Return the strongest acceleration after which it can still stop before all phantoms or be through, m/s2.

        Infinite without any, and where it can neither: it is among them already, and leaves.
        """
        if not self._seen:
            return math.inf
        s, planning = self.settings, self._planner.settings
        time_s = np.arange(0.0, planning.prediction.horizon_s + 1e-9, planning.prediction.step_s)
        path = path_of(ego.route, float(ego.box.yaw[0]), planning.lateral_mps2)
        zones = self._zones(ego, path, tracks, time_s)
        if not len(zones):
            return math.inf
        first = _FIRST[_FIRST >= -ego.limits.deceleration_mps2]
        top = max(ego.speed_mps, ego.limits.speed_mps)
        after = np.minimum(first, -s.brakes_mps2)
        plans = [profiles_of(ego.speed_mps, top, first, after, kept_s, time_s) for kept_s in _KEPT_S]
        plans.append(profiles_of(ego.speed_mps, top, first, np.full(len(first), s.goes_mps2), _KEPT_S[0], time_s))
        firm = first >= -s.brakes_mps2 - 1.0
        for margin_m, allowed in ((0.0, firm), (_MARGIN_M, first <= -s.brakes_mps2), (0.0, ~firm)):
            entered = _enters(stacked(*plans), zones + np.array([margin_m, 0.0, 0.0]), time_s)
            safe = ~entered.reshape(len(plans), len(first)).all(axis=0) & allowed
            if safe.any():
                return float(first[safe].max())
        return math.inf

    def _zones(self, ego: EgoState, path: Path, tracks: Tracks, time_s: Array) -> Array:
        """Return (Z, 3) stretches of the path from, to, m, that phantoms block from a time on, s."""
        zones = []
        # Who stands where nobody was seen a moment ago would have had to come there.
        hidden = ~np.any([seen.sees(path.xy) for seen in self._seen], axis=0)
        behind = _first_hidden(hidden, path.xy, path.heading, tracks.boxes, round(self.settings.hides_m / STEP_M))
        hidden_m = path.along[behind] if behind is not None else math.inf
        if hidden_m < self.settings.surely_m:
            zones.append((max(hidden_m - 0.5 * float(ego.box.size[0, 0]), _SLACK_M), math.inf, 0.0))
        phantoms = self._phantoms(ego, path, tracks, time_s)
        if phantoms is not None:
            blocked = occupancy_of(path, ego.box.size[0, :2], phantoms, self._planner.settings.clearance)
            zones += _blocked(blocked, time_s, self.settings.enters_s)
        return np.array(zones).reshape(-1, 3)

    def _phantoms(self, ego: EgoState, path: Path, tracks: Tracks, time_s: Array) -> Prediction | None:
        """Return where the phantoms of the conflicting lanes will be."""
        s, found = self.settings, []
        lanes = self._lanes.conflicts(np.column_stack([path.xy, path.heading])) if self._lanes is not None else ()
        for lane in lanes:
            along, clock_s = _course(lane)
            begins_s = math.inf
            # Every view tells where nobody was at its time, hence who cannot have come nearer since than so far.
            for seen in self._seen:
                upstream = lane.line[lane.meets :: -1]
                hidden = ~seen.sees(upstream[:, :2])
                row = _first_hidden(hidden, upstream[:, :2], upstream[:, 2], tracks.boxes, round(s.hides_m))
                if row is None:
                    break
                edge = upstream[max(row - 1, 0) :][:1, :2]
                age_s = min(max(ego.time_s - float(seen.seen_s(edge)[0]), 0.0), time_s[-1])
                begins_s = min(begins_s, clock_s[lane.meets - row] + age_s)
            else:
                front = np.interp(begins_s + time_s + s.appears_s, clock_s, along)
                found.append(_coming(lane, along, front, s.size_m[0]))
        if not found:
            return None
        xy, yaw, speed = (np.stack(part) for part in zip(*found, strict=True))
        n, shape = len(found), yaw.shape
        size, none = np.tile(np.array(s.size_m), (n, 1)), np.zeros(shape)
        return Prediction(time_s, xy, yaw, size, none, speed, np.zeros(shape, bool), np.arange(n), np.ones(n, bool))


def _first_hidden(hidden: NDArray[np.bool_], xy: Array, heading: Array, others: Boxes, least: int) -> int | None:
    """Return the first row of (K, 2) places that begins a hidden stretch of `least` rows.

    None without one, or where a tracked road user of that heading, or a standing one, comes first.
    """
    whole = np.convolve(hidden, np.ones(least), "valid") >= least - 0.5
    if not whole.any():
        return None
    first = int(whole.argmax())
    known = _on(others, xy[: first + 1], heading[: first + 1])
    return None if known.any() else first


def _on(boxes: Boxes, xy: Array, heading: Array, margin_m: float = 1.0) -> NDArray[np.bool_]:
    """Return (K,) whether (K, 2) places are on a box, or near its ends, that points along (K,) headings or against."""
    dx, dy = (xy[:, None, axis] - boxes.center[:, axis] for axis in (0, 1))
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    ahead, left = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
    alike = np.abs(np.cos(heading[:, None] - boxes.yaw)) > 0.7
    within = (ahead < 0.5 * boxes.size[:, 0] + margin_m) & (left < 0.5 * boxes.size[:, 1] + 0.3)
    return np.asarray((within & alike).any(axis=1))


def _course(lane: ConflictLane) -> tuple[Array, Array]:
    """Return (K,) way along a lane, m, and the time at its limits, s."""
    step = np.hypot(*np.diff(lane.line[:, :2], axis=0).T)
    clock = np.cumsum(step / np.maximum(lane.speed_mps[:-1], 0.1))
    return np.concatenate([[0.0], np.cumsum(step)]), np.concatenate([[0.0], clock])


def _coming(lane: ConflictLane, along: Array, front: Array, length_m: float) -> tuple[Array, Array, Array]:
    """Return (T, 2) centres, (T,) headings and speeds of who has its front at (T,) ways along a lane, m."""
    centre = front - 0.5 * length_m
    x, y, heading = (np.interp(centre, along, lane.line[:, axis]) for axis in range(3))
    return np.column_stack([x, y]), heading, np.interp(front, along, lane.speed_mps)


def _blocked(occupancy: Occupancy, time_s: Array, enters_s: float) -> list[tuple[float, float, float]]:
    """Return the stretch from, to, m, and the time, s, of the entry of each onto the path."""
    found = []
    for low, high in occupancy.near:
        there = np.flatnonzero(np.isfinite(low))
        if len(there):
            enters = there[time_s[there] <= time_s[there[0]] + enters_s]
            first, last = float(low[enters].min()), float(high[enters].max())
            first = first if first < -_AMONG_M else max(first, _SLACK_M)
            found.append((first, last, float(time_s[there[0]])))
    return [zone for zone in found if zone[1] > max(zone[0], 0.0)]


def _enters(plans: Profiles, zones: Array, time_s: Array) -> NDArray[np.bool_]:
    """Return (P,) which plans are in a zone while it is blocked."""
    along = plans.along_m[:, None]
    inside = (along > zones[:, :1]) & (along < zones[:, 1:2]) & (time_s >= zones[:, 2:] - 1e-6)
    return np.asarray(inside[..., 1:].any(axis=(1, 2)))
