"""Scripted traffic: the actors of an encounter follow their script until the ego is driven or a crash happens."""

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.bodies.choice import choose_model
from sim.boxes import Boxes
from sim.collisions import overlapping_pairs
from sim.encounters import encounter_of, network_file
from sim.encounters.types import ScriptedActor
from sim.errors import TrafficError
from sim.geometry import wrap_angle
from sim.roads.networks import read_network
from sim.scenario import Scenario
from sim.traffic.base import SIGNALS, Actors, Limits, TrafficLight, check_command

FIRST_ID = 1000
"""Object id of the ego; the other actors follow in the order of the encounter."""

BRAKES_LIT_MPS2 = 0.3
"""Deceleration above which brake lights are on."""

_ALARMED_MPS2 = 6.0
_REACTION_S = 0.5
_LOOK_AHEAD_M = 60.0
_BESIDE_M = 0.2
_LANE_EVERY_M = 1.0


@dataclass(slots=True)
class _Mover:
    """State of one actor.

    Attributes:
        actor: its script.
        object_id: id of its box.
        model: body model.
        lanes: ids of the lanes every `_LANE_EVERY_M` along its path.
        at_m: distance along its path, m.
        speed: m/s.
        follows: still on its script.
        crashed: stopped by a crash.
        commanded: commanded speed, m/s.
        history: positions one and two steps ago.
    """

    actor: ScriptedActor
    object_id: int
    model: str
    lanes: tuple[str, ...]
    at_m: float
    speed: float
    follows: bool = True
    crashed: bool = False
    commanded: float | None = None
    history: list[NDArray[np.float64]] = field(default_factory=list)

    @property
    def on_path(self) -> bool:
        """Whether it has appeared and not yet left."""
        return 0.0 <= self.at_m < self.actor.path.length


class ScriptedTraffic:
    """Encounter of a scenario, moved along fixed paths: `with ScriptedTraffic(scenario, seed) as traffic: ...`.

    Every actor keeps its path. It also keeps the speeds of its script until the ego is driven by commands or a crash
    happens; from then on all but the conflict actor follow the vehicle ahead on their path, and a crash makes everybody
    brake. Crashed actors stop at once and stay.

    Args:
        scenario: scenario with an encounter.
        seed: root seed; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: the encounter or its roads are invalid.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.step_s = scenario.step_s
        self.crashes: list[tuple[float, str, str]] = []
        """Crashes so far: time in s and names of both actors."""
        self._instance = encounter_of(scenario, seed)
        self._lanes = _Lanes(scenario, seed)
        self._steps = 0
        self._disturbed = False
        self._open = True
        claimed = [ghost.actor for ghost in self._instance.ghosts]
        ids = _ids(self._instance.layout.actors)
        self._movers = [self._start(one, ids[one.name], seed) for one in self._instance.layout.actors]
        self._ghosts = [self._start(one, FIRST_ID + 900 + row, seed) for row, one in enumerate(claimed)]
        for back in (2, 1):
            for mover in (*self._movers, *self._ghosts):
                place, _, _ = mover.actor.path.at(float(mover.actor.place(-back * self.step_s)))
                mover.history.append(place[:2])
        self._actors = self._read(self._movers)

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        if not self._open:
            raise TrafficError("this scripted traffic is closed")
        return self._actors

    @property
    def time_s(self) -> float:
        """Time since the start of the encounter, s."""
        return round(self._steps * self.step_s, 6)

    def claims(self) -> dict[str, Actors]:
        """Return the ghosts that helpers report now, by the name of the helper."""
        claims: dict[str, Actors] = {}
        for ghost, mover in zip(self._instance.ghosts, self._ghosts, strict=True):
            if mover.on_path:
                claims[ghost.claimed_by] = self._read([mover])
        return claims

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors."""
        if not self._open:
            raise TrafficError("this scripted traffic is closed")
        before = self._actors
        self._steps += 1
        for mover in (*self._movers, *self._ghosts):
            place, _, _ = mover.actor.path.at(mover.at_m)
            mover.history = [mover.history[-1], place[:2]]
            self._move(mover, before)
        actors = self._read(self._movers)
        if self._crash(actors):
            actors = self._read(self._movers)
        self._actors = actors
        return actors

    def close(self) -> None:
        """End the encounter."""
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive an actor, see `DrivableTraffic.command`; given back, it keeps its script's speed at each place."""
        check_command(speed_mps)
        mover = self._mover(object_id)
        mover.commanded = speed_mps
        mover.follows = False
        self._disturbed = True

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the (K, 2) world polyline that an actor will follow, from its centre over the next `ahead_m` m."""
        mover = self._mover(object_id)
        path, end = mover.actor.path, min(mover.at_m + ahead_m, mover.actor.path.length)
        at = np.linspace(mover.at_m, end, max(2, math.ceil(end - mover.at_m)))
        return path.at(at)[0][:, :2]

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of an actor: its speed along its path, m/s."""
        return self._mover(object_id).speed

    def limits(self, object_id: int) -> Limits:
        """Return the limits of an actor where it is; the allowed speed is its script's."""
        mover = self._mover(object_id)
        strongest, _, emergency = mover.actor.kind.accel_mps2
        return Limits(self._scripted_speed(mover), strongest, emergency)

    def signals(self, object_id: int) -> tuple[TrafficLight, ...]:
        """Return no traffic lights: the script has none."""
        self._mover(object_id)
        return ()

    def _start(self, actor: ScriptedActor, object_id: int, seed: int) -> _Mover:
        return _Mover(
            actor=actor,
            object_id=object_id,
            model=choose_model(actor.kind.label, actor.name, seed),
            lanes=self._lanes.along(actor),
            at_m=float(actor.place(0.0)),
            speed=float(actor.pace.at(0.0)),
        )

    def _mover(self, object_id: int) -> _Mover:
        for mover in self._movers:
            if mover.object_id == object_id and mover.on_path:
                return mover
        raise KeyError(object_id)

    def _move(self, mover: _Mover, before: Actors) -> None:
        """Advance one actor by a step."""
        if mover.crashed:
            mover.speed = 0.0
            return
        limit = self._limit(mover, before) if self._disturbed else math.inf
        scripted = float(mover.actor.pace.at(self.time_s))
        if mover.follows and limit >= scripted:
            mover.at_m, mover.speed = float(mover.actor.place(self.time_s)), scripted
            return
        mover.follows = False
        wanted = mover.commanded if mover.commanded is not None else min(self._scripted_speed(mover), limit)
        strongest, _, emergency = mover.actor.kind.accel_mps2
        low, high = mover.speed - emergency * self.step_s, mover.speed + strongest * self.step_s
        speed = max(0.0, min(max(wanted, low), high))
        mover.at_m += 0.5 * (mover.speed + speed) * self.step_s
        mover.speed = speed

    def _scripted_speed(self, mover: _Mover) -> float:
        """Return the scripted speed at the position of an actor."""
        times = np.arange(-5.0, 40.0, 0.1)
        places = mover.actor.place(times)
        # A scripted stop is skipped: the last time at a position counts.
        row = int(np.searchsorted(places, mover.at_m, side="right"))
        return float(mover.actor.pace.at(times[min(row, len(times) - 1)]))

    def _limit(self, mover: _Mover, before: Actors) -> float:
        """Return the safe speed of an actor behind the body ahead on its path, m/s."""
        if mover.commanded is not None or ("conflict" in mover.actor.roles and not self.crashes):
            return math.inf
        if mover.object_id not in before.boxes.object_id:
            return math.inf
        limit = max(0.0, mover.speed - _ALARMED_MPS2 * self.step_s) if self.crashes else math.inf
        path, kind = mover.actor.path, mover.actor.kind
        length, width, _ = kind.size
        inside = (path.along >= mover.at_m) & (path.along <= mover.at_m + _LOOK_AHEAD_M)
        if inside.sum() < 2:
            return limit
        line = shapely.LineString(path.points[inside, :2])
        strip = line.buffer(0.5 * width + _BESIDE_M, cap_style="flat")
        for row in np.flatnonzero(before.boxes.object_id != mover.object_id):
            body = shapely.Polygon(before.boxes[row : row + 1].bev_polygons()[0])
            if not strip.intersects(body):
                continue
            corners = shapely.points(shapely.get_coordinates(strip & body))
            gap = float(np.min(shapely.line_locate_point(line, corners))) - 0.5 * length - 1.0
            if gap < -0.5 * length:
                continue  # it is beside or behind
            heading = path.at(mover.at_m + max(gap, 0.0))[1]
            lead = max(0.0, float(before.velocity[row] @ [np.cos(heading), np.sin(heading)]))
            brakes = kind.accel_mps2[1]
            # Krauss: safe speed behind a leader that brakes as hard.
            square = (brakes * _REACTION_S) ** 2 + lead**2 + 2.0 * brakes * max(gap, 0.0)
            limit = min(limit, -brakes * _REACTION_S + math.sqrt(square))
        return max(limit, 0.0)

    def _crash(self, actors: Actors) -> bool:
        """Stop actors with overlapping bodies; return whether there is a new crash."""
        found = False
        by_id = {mover.object_id: mover for mover in self._movers}
        for first, second in overlapping_pairs(actors.boxes):
            pair = [by_id[int(actors.boxes.object_id[row])] for row in (first, second)]
            if all(mover.crashed or mover.speed == 0.0 for mover in pair):
                continue
            self.crashes.append((self.time_s, pair[0].actor.name, pair[1].actor.name))
            self._disturbed = found = True
            for mover in pair:
                mover.crashed, mover.follows, mover.speed = True, False, 0.0
        return found

    def _read(self, movers: list[_Mover]) -> Actors:
        movers = [mover for mover in movers if mover.on_path]
        n = len(movers)
        boxes = np.zeros((n, 7))
        pitch, velocity, acceleration = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2))
        for row, mover in enumerate(movers):
            place, heading, slope = mover.actor.path.at(mover.at_m)
            size = mover.actor.kind.size
            boxes[row] = (*place[:2], place[2] + 0.5 * size[2], *size, wrap_angle(heading))
            pitch[row] = slope
            before, last = mover.history[-2:]
            velocity[row] = (place[:2] - last) / self.step_s
            acceleration[row] = (velocity[row] - (last - before) / self.step_s) / self.step_s
        return Actors(
            time_s=self.time_s,
            boxes=Boxes.from_array(
                boxes,
                label=np.array([mover.actor.kind.label_index for mover in movers], np.int64),
                object_id=np.array([mover.object_id for mover in movers], np.int64),
            ),
            pitch=pitch,
            velocity=velocity,
            acceleration=acceleration,
            model=tuple(mover.model for mover in movers),
            name=tuple(mover.actor.name for mover in movers),
            signals=np.array([self._lights(m, a) for m, a in zip(movers, acceleration, strict=True)], np.int32),
            lane=tuple(mover.lanes[min(round(mover.at_m / _LANE_EVERY_M), len(mover.lanes) - 1)] for mover in movers),
        )

    def _lights(self, mover: _Mover, acceleration: NDArray[np.float64]) -> int:
        """Return the lights: scripted indicators, brake lights when slowing or waiting, hazards after a crash."""
        actor = mover.actor
        if actor.kind.label in ("pedestrian", "bicycle"):
            return 0
        bits = 0
        for lit, start, end in actor.lights:
            if start <= self.time_s < end:
                bits |= lit
        heading = mover.actor.path.at(mover.at_m)[1]
        slows = float(acceleration @ [np.cos(heading), np.sin(heading)]) < -BRAKES_LIT_MPS2
        if not actor.parked and (slows or mover.speed < 0.05):
            bits |= SIGNALS["brake light"]
        return bits | SIGNALS["hazard lights"] if mover.crashed else bits


def _ids(actors: tuple[ScriptedActor, ...]) -> dict[str, int]:
    """Return the object ids of actors; the ego and the conflict actor have the same ids in all controls."""
    others = [one.name for one in actors if one.name not in ("ego", "conflict")]
    return {"ego": FIRST_ID, "conflict": FIRST_ID + 1} | {name: FIRST_ID + 2 + k for k, name in enumerate(others)}


class _Lanes:
    """Lookup of the lanes below paths."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        net = read_network(network_file(scenario, seed))
        lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
        lanes = [lane for lane in lanes if len(lane.getShape()) > 1]
        self._names = [lane.getID() for lane in lanes]
        self._half = np.array([0.5 * lane.getWidth() for lane in lanes])
        self._lines = [shapely.LineString(np.array(lane.getShape())[:, :2]) for lane in lanes]
        self._tree = shapely.STRtree(self._lines)

    def along(self, actor: ScriptedActor) -> tuple[str, ...]:
        """Return the lane at every `_LANE_EVERY_M` of an actor's path, "" off the lanes.

        Of several lanes the nearest one in the same direction counts.
        """
        at = np.arange(0.0, actor.path.length + _LANE_EVERY_M, _LANE_EVERY_M)
        places, headings, _ = actor.path.at(at)
        points = shapely.points(places[:, :2])
        found: list[tuple[float, str]] = [(math.inf, "")] * len(at)
        for place, line in self._tree.query(points, predicate="dwithin", distance=2.5).T:
            gap = self._lines[line].distance(points[place])
            if gap > self._half[line]:
                continue
            here = self._lines[line].project(points[place])
            a, b = (self._lines[line].interpolate(max(here + d, 0.0)) for d in (-0.5, 0.5))
            turned = math.cos(math.atan2(b.y - a.y, b.x - a.x) - headings[place])
            if actor.kind.label != "pedestrian":
                gap += 10.0 * (turned < 0.3)
            found[place] = min(found[place], (gap, self._names[line]))
        return tuple(name for _, name in found)
