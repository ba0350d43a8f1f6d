"""Background traffic around an encounter: vehicles that follow its actors, and vehicles in lanes off the conflict."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.collisions import overlap
from sim.encounters.draw import CARS, VANS, pick
from sim.encounters.paths import ReferencePath, SpeedProfile
from sim.encounters.types import Layout, Role, ScriptedActor, actor
from sim.roads.network import Lane as RoadLane
from sim.roads.network import Network
from sim.scenario import MOTOR_CLASSES, TrafficLevel

_KINDS = (*CARS, *CARS, *VANS, "truck_light")
_STANDING_GAP_M = 2.5
_HORIZON_S, _EVERY_S = 14.0, 0.1
_ROOM_M = (1.0, 0.4)
"""Room along and across a body that nobody else enters, m."""
_AROUND_M = 40.0
"""From the relevant area of the encounter or one of its actors up to which vehicles start, m."""
_ELSEWHERE_M = 1e6
_OFF_CONFLICT_M = 1.9
"""From the middle of a lane to the ways of ego and conflict actor, m."""
_ON_LANE_M = 2.0
_LEAST_LANE_M = 40.0
_STOP_LINE_M = 1.5
_BRAKES_MPS2 = 2.0
_ALARMED_MPS2 = 6.0


@dataclass(frozen=True, slots=True)
class _Density:
    """Followers of one actor, vehicles of one lane at most, and the range of headways, s."""

    followers: int
    in_lane: int
    headway_s: tuple[float, float]


_DENSITIES = {"light": _Density(1, 3, (3.0, 5.5)), "dense": _Density(3, 8, (1.6, 2.6))}


def with_background(layout: Layout, level: TrafficLevel, net: Network, rng: np.random.Generator) -> Layout:
    """Return a layout with background traffic.

    Vehicles follow those that drive, each with a headway; those behind the conflict actor have the role `jam` and
    disappear with it. Others drive in lanes that do not touch the ways of the ego and the conflict actor, and stop
    where such a lane ends at a junction. A vehicle that would touch another, or does not fit on the road, is left out.

    Args:
        rng: generator of vehicles and headways.
    """
    if level == "none":
        return layout
    density = _DENSITIES[level]
    lanes = [lane for edge in net.getEdges() for lane in edge.getLanes() if lane.allows("passenger")]
    lines = [shapely.LineString(np.array(lane.getShape())[:, :2]) for lane in lanes]
    road = shapely.STRtree(lines)
    taken = _Taken(layout.actors)
    added: list[ScriptedActor] = []
    for leader in layout.actors:
        driving = leader.kind.label in MOTOR_CLASSES and _fastest(leader) > 0.0
        if not driving or leader.overtaking is not None:
            continue
        role: Role = "jam" if "conflict" in leader.roles else "other"
        for follower in _column(leader, role, density.followers, density, rng):
            place = follower.path.at(follower.start_m)[0][:2]
            if len(road.query(shapely.Point(place), predicate="dwithin", distance=_ON_LANE_M)):
                _add(follower, layout, taken, added)
    conflict = [one for one in layout.actors if one.roles & {"ego", "conflict"}]
    ways = shapely.MultiLineString([one.path.points[:, :2] for one in conflict])
    for lane, line in zip(lanes, lines, strict=True):
        if line.length >= _LEAST_LANE_M and not shapely.dwithin(line, ways, _OFF_CONFLICT_M):
            for vehicle in _in_lane(lane, density, rng):
                _add(vehicle, layout, taken, added)
    return replace(layout, actors=(*layout.actors, *added))


def _add(vehicle: ScriptedActor, layout: Layout, taken: "_Taken", added: list[ScriptedActor]) -> None:
    """Add a vehicle if it is near the encounter and touches nobody."""
    named = replace(vehicle, name=f"traffic_{len(added)}")
    starts = np.array([one.path.at(one.start_m)[0][:2] for one in (named, *layout.actors)])
    away = np.abs(starts[0] - layout.focus).max() - layout.reach_m
    if min(away, np.hypot(*(starts[1:] - starts[0]).T).min()) <= _AROUND_M and taken.is_free(named):
        taken.add(named)
        added.append(named)


def _column(
    leader: ScriptedActor, role: Role, count: int, density: _Density, rng: np.random.Generator
) -> Iterator[ScriptedActor]:
    """Yield vehicles behind a leader on its path: each is where the one ahead was a headway ago, a length behind."""
    for _ in range(count):
        kind = pick(_KINDS, rng)
        # Even behind a leader that stops dead a follower comes to a stand.
        headway = max(float(rng.uniform(*density.headway_s)), _fastest(leader) / (2.0 * _ALARMED_MPS2) + 0.3)
        pace = SpeedProfile(leader.pace.time_s + headway, leader.pace.speed_mps)
        follower = actor("", role, kind, leader.path, pace, at_m=float(leader.place(-headway)))
        gap = 0.5 * (leader.kind.size[0] + follower.kind.size[0]) + _STANDING_GAP_M
        leader = _on_longer_path(replace(follower, start_m=follower.start_m - gap))
        yield leader


def _in_lane(lane: RoadLane, density: _Density, rng: np.random.Generator) -> Iterator[ScriptedActor]:
    """Yield vehicles in a lane from its end back; at a junction they stop, a lane that leads straight on has none."""
    path = ReferencePath.through(np.array(lane.getShape3D(), np.float64))
    speed = float(lane.getSpeed() * rng.uniform(0.75, 0.95))
    onward = {link.getToLane().getEdge().getID() for link in lane.getOutgoing()}
    kind, ahead = pick(_KINDS, rng), float(rng.uniform(0.0, 30.0))
    if len(onward) == 1:
        return
    if onward:
        first = actor("", "other", kind, path, speed, at_m=0.0)
        stop_m = path.length - _STOP_LINE_M - 0.5 * first.kind.size[0]
        way = stop_m - ahead - 0.5 * speed**2 / _BRAKES_MPS2
        if way < 1.0:
            return
        # It comes to its stand on the way from `ahead` metres before its braking begins.
        brakes = SpeedProfile.change(speed, 0.0, ahead / speed, _BRAKES_MPS2)
        first = replace(first, start_m=way, pace=brakes)
    else:
        first = actor("", "other", kind, path, speed, at_m=path.length - 5.0 - ahead)
    yield first
    for follower in _column(first, "other", density.in_lane - 1, density, rng):
        if follower.path is not path:
            return  # the lane is full
        yield follower


def _on_longer_path(follower: ScriptedActor) -> ScriptedActor:
    """Return an actor that starts on its path, which is prolonged backwards where it begins too late."""
    if follower.start_m >= 1.0:
        return follower
    longer = 2.0 - follower.start_m
    points = follower.path.points
    back = points[0] - points[1]
    back = points[0] + back / np.hypot(*back[:2]) * np.linspace(longer, 0.25, round(longer / 0.25))[:, None]
    path = ReferencePath.through(np.concatenate([back, points]), 0.0)
    return replace(follower, path=path, start_m=follower.start_m + longer)


def _fastest(one: ScriptedActor) -> float:
    return float(one.pace.speed_mps.max())


class _Taken:
    """Room that scripted actors take over time."""

    def __init__(self, actors: Sequence[ScriptedActor]) -> None:
        self._times = np.arange(0.0, _HORIZON_S, _EVERY_S)
        self._outlines: list[NDArray[np.float64]] = []
        for one in actors:
            self.add(one)

    def add(self, one: ScriptedActor) -> None:
        """Take the room of an actor."""
        self._outlines.append(self._outline(one, (0.0, 0.0), _ELSEWHERE_M))

    def is_free(self, one: ScriptedActor) -> bool:
        """Return whether the room around an actor is free at all times."""
        return not overlap(self._outline(one, _ROOM_M, -_ELSEWHERE_M)[None], np.stack(self._outlines)).any()

    def _outline(self, one: ScriptedActor, room_m: tuple[float, float], away_m: float) -> NDArray[np.float64]:
        """Return the (T, 4, 2) footprints of an actor with room around it, moved away while it is not on its path."""
        at = one.place(self._times)
        place, heading, _ = one.path.at(at)
        size = np.array(one.kind.size) + 2.0 * np.array([*room_m, 0.0])
        rows = np.column_stack([place, np.broadcast_to(size, (len(at), 3)), heading])
        outline = Boxes.from_array(rows).bev_polygons()
        outline[(at < 0.0) | (at >= one.path.length)] += away_m
        return outline
