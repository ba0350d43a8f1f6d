"""Scripted traffic: the actors of an encounter follow their script until the ego is driven or a crash happens."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim.bodies.fleet import Fleet
from sim.boxes import Boxes
from sim.collisions import overlapping_pairs
from sim.encounters import KINDS, encounter_of
from sim.encounters.types import HIT_S, ScriptedActor
from sim.errors import TrafficError
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import SIGNALS, Actors, DrivableTraffic, Limits, check_command, check_place
from sim.traffic.scripted.clock import ScriptClock
from sim.traffic.scripted.following import safe_speed
from sim.traffic.scripted.lanes import LANE_EVERY_M, LaneLookup
from sim.traffic.scripted.mover import Mover
from sim.traffic.scripted.overtaking import gives_up, way_back

FIRST_ID = 1000
"""Object id of the ego; the other actors follow in the order of the encounter."""

BRAKES_LIT_MPS2 = 0.3
"""Deceleration above which brake lights are on."""

GOAL_M = 25.0
"""From the place of the crash to the goal of the ego, m."""

_ALARMED_MPS2 = 6.0
_AFTER_HIT_S = 0.5
_STANDS_MPS, _BEHIND_M = 1.0, 10.0
"""Where the conflict actor blocks the lane, the goal is to stand at most so far behind it."""


class ScriptedTraffic(DrivableTraffic):
    """Encounter of a scenario, moved along fixed paths: `with ScriptedTraffic(scenario, seed) as traffic: ...`.

    Every actor keeps its path and the speeds of its script, on a common clock (`ScriptClock`) that waits for a driven
    ego where the encounter type has it so. Once the ego is driven by commands or a crash has happened, an actor brakes
    for what is no longer on its script ahead on its path, and follows that from then on. The conflict actor is blind:
    it brakes for nothing before a crash. A crash makes everybody brake; crashed actors stop at once and stay.

    Args:
        seed: root seed; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: the encounter or its roads are invalid.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.step_s = scenario.step_s
        self.crashes: list[tuple[float, str, str]] = []
        """Crashes so far: time in s and names of both actors."""
        self._instance = encounter_of(scenario, seed)
        self._lanes = LaneLookup(scenario, seed)
        self._fleet = Fleet.of(scenario, seed)
        self._steps = 0
        self._disturbed = False
        self._driven = False
        self._open = True
        self._placed: dict[int, tuple[float, float, float, float]] = {}
        claimed = [ghost.actor for ghost in self._instance.ghosts]
        actors = self._instance.layout.actors
        ids = actor_ids(actors)
        self._movers = [self._start(one, ids[one.name]) for one in actors]
        self._ghosts = [self._start(one, FIRST_ID + 900 + row) for row, one in enumerate(claimed)]
        self._ego = self._movers[0]
        self._conflict = next((mover for mover in self._movers if "conflict" in mover.actor.roles), None)
        self._meets = KINDS[self._instance.kind].waits
        triggered = any(one.start is not None for one in (*actors, *claimed) if {"conflict"} & one.roles)
        waits = self._meets and not triggered
        self._clock = ScriptClock(actors[0], (*actors[1:], *claimed) if waits else (), self.step_s)
        self._waits = waits
        self._hit = self._ego.actor.path.at(float(actors[0].place(HIT_S)))[0][:2]
        for back in (2, 1):
            for mover in (*self._movers, *self._ghosts):
                at_m = float(mover.actor.place(-back * self.step_s))
                place, heading, _ = mover.actor.path.at(at_m)
                before = min(at_m, 0.0)  # it came straight to where its path begins
                mover.history.append(place[:2] + before * np.array([np.cos(heading), np.sin(heading)]))
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

    def goal_m(self, object_id: int) -> float | None:
        """Return the distance left to the goal, see `DrivableTraffic.goal_m`.

        It lies `GOAL_M` beyond the place of the crash. Behind a conflict actor that blocks the lane it is the last
        10 m, reached at less than 1 m/s, or `GOAL_M` beyond it for an ego that has steered around it.
        """
        ego = self._mover(object_id)
        if ego is not self._ego:
            return None
        path = ego.actor.path
        if self._meets or self._conflict is None:
            return min(path.nearest(self._hit) + GOAL_M, path.length - 1.0) - ego.at_m
        blocked = path.nearest(self._conflict.actor.path.at(float(self._conflict.actor.place(60.0)))[0][:2])
        if ego.at_m > blocked:
            return min(blocked + GOAL_M, path.length - 1.0) - ego.at_m
        lengths = 0.5 * (ego.actor.kind.size[0] + self._conflict.actor.kind.size[0])
        left = blocked - lengths - _BEHIND_M - ego.at_m
        return left if ego.speed < _STANDS_MPS else max(left, _BEHIND_M)

    def encounter_gap_s(self, object_id: int) -> float | None:
        """Return the difference of arrival at the commit of the clock, see `DrivableTraffic.encounter_gap_s`."""
        if self._mover(object_id) is not self._ego or self._conflict is None or not self._waits:
            return None
        return self._clock.gap_s

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
        # Actors that are not where their script has them, nor with the others.
        strays = {mover.object_id for mover in self._movers if not mover.is_on_script(self._own_s(mover))}
        if self._waits:
            self._clock.advance(self.time_s, self._ego.at_m, self._ego.speed, driven=self._driven)
        self._steps += 1
        for mover in (*self._movers, *self._ghosts):
            place, _, _ = mover.pose()
            mover.history = [mover.history[-1], place[:2]]
            self._move(mover, before, strays)
        self._give_up_overtaking()
        actors = self._read(self._movers)
        if self._crash(actors):
            actors = self._read(self._movers)
        self._actors = actors
        return actors

    def close(self) -> None:
        """End the encounter."""
        self._open = False

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive an actor, see `DrivableTraffic.command`; given back, it keeps its script's speed at each place."""
        check_command(speed_mps)
        mover = self._mover(object_id)
        mover.commanded, mover.placed = speed_mps, None
        mover.follows = False
        self._disturbed = True
        self._driven |= mover is self._ego

    def place(self, object_id: int, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Put an actor somewhere, see `DrivableTraffic.place`; others follow it as far as it is in their way."""
        check_place(xy, yaw, speed_mps)
        mover = self._mover(object_id)
        self._placed[object_id] = (float(xy[0]), float(xy[1]), float(yaw), float(speed_mps))
        self._disturbed = True
        self._driven |= mover is self._ego

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the (K, 2) world polyline that an actor will follow, from its centre over the next `ahead_m` m."""
        mover = self._mover(object_id)
        path, end = mover.actor.path, min(mover.at_m + ahead_m, mover.actor.path.length)
        at = np.linspace(mover.at_m, end, max(2, math.ceil(end - mover.at_m)))
        line = path.at(at)[0][:, :2]
        return line if mover.placed is None else np.concatenate([[mover.placed[:2]], line[1:]])

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of an actor: its speed along its path, m/s."""
        return self._mover(object_id).speed

    def limits(self, object_id: int) -> Limits:
        """Return the limits of an actor where it is; the allowed speed is its script's."""
        mover = self._mover(object_id)
        strongest, _, emergency = mover.actor.kind.accel_mps2
        return Limits(mover.scripted_speed(), strongest, emergency)

    def _start(self, actor: ScriptedActor, object_id: int) -> Mover:
        return Mover(
            actor=actor,
            object_id=object_id,
            model=self._fleet.model(actor.kind, actor.name),
            lanes=self._lanes.along(actor),
            at_m=float(actor.place(0.0)),
            speed=float(actor.pace.at(0.0)),
        )

    def _mover(self, object_id: int) -> Mover:
        for mover in self._movers:
            if mover.object_id == object_id and mover.on_path:
                return mover
        raise KeyError(object_id)

    @property
    def _script_s(self) -> float:
        """Time of the script, s."""
        return self.time_s + self._clock.offset_s

    def _own_s(self, mover: Mover) -> float:
        """Return the time of an actor's own script, s."""
        return mover.own_s(self._script_s, self._ego)

    def _move(self, mover: Mover, before: Actors, strays: set[int]) -> None:
        if mover.crashed:
            mover.speed = 0.0
            return
        if mover.object_id in self._placed:
            mover.put(*self._placed.pop(mover.object_id))
            return
        if mover.placed is not None:
            mover.speed = 0.0
            return
        limit = self._limit(mover, before, strays) if self._disturbed else math.inf
        own_s = self._own_s(mover)
        if mover.follows and limit >= self._clock.rate * float(mover.actor.pace.at(own_s)):
            mover.follow_script(own_s, self._clock.rate)
            return
        mover.drive(mover.commanded if mover.commanded is not None else min(mover.scripted_speed(), limit), self.step_s)

    def _limit(self, mover: Mover, before: Actors, strays: set[int]) -> float:
        """Return the safe speed of an actor behind the body ahead on its path, m/s."""
        if mover.commanded is not None or (mover is self._conflict and not self.crashes):
            return math.inf
        if mover.object_id not in before.boxes.object_id:
            return math.inf
        alarmed = max(0.0, mover.speed - _ALARMED_MPS2 * self.step_s) if self.crashes else math.inf
        minded = before.boxes.object_id != mover.object_id
        # Until the time of the crash, two actors on their scripts do not touch.
        if mover.object_id not in strays and self._script_s < HIT_S + _AFTER_HIT_S:
            minded &= np.isin(before.boxes.object_id, list(strays))
        return min(alarmed, safe_speed(mover, before, minded))

    def _give_up_overtaking(self) -> None:
        """Bring a driven ego back into its lane where it no longer overtakes."""
        ego, plan = self._ego, self._ego.actor.overtaking
        if plan is None or not self._driven or ego.crashed:
            return
        ahead = next((mover for mover in self._movers if mover.actor.name == plan.of), None)
        if not gives_up(ego, plan, ahead):
            return
        path, at_m = way_back(ego, plan.lane)
        actor = replace(ego.actor, path=path, overtaking=None)
        ego.turn_onto(actor, at_m, self._lanes.along(actor))

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
                mover.stop()
        return found

    def _read(self, movers: list[Mover]) -> Actors:
        movers = [mover for mover in movers if mover.on_path]
        n = len(movers)
        boxes = np.zeros((n, 7))
        pitch, velocity, acceleration = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2))
        for row, mover in enumerate(movers):
            place, heading, slope = mover.pose()
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
            lane=tuple(self._lane(mover) for mover in movers),
        )

    def _lane(self, mover: Mover) -> str:
        if mover.placed is not None:
            return self._lanes.at(*mover.placed)
        return mover.lanes[min(round(mover.at_m / LANE_EVERY_M), len(mover.lanes) - 1)]

    def _lights(self, mover: Mover, acceleration: NDArray[np.float64]) -> int:
        """Return the lights: scripted indicators, brake lights when slowing or waiting, hazards after a crash."""
        actor = mover.actor
        if actor.kind.label in ("pedestrian", "bicycle"):
            return 0
        bits = 0
        for lit, start, end in actor.lights:
            if start <= self._script_s < end:
                bits |= lit
        _, heading, _ = mover.pose()
        slows = float(acceleration @ [np.cos(heading), np.sin(heading)]) < -BRAKES_LIT_MPS2
        if not actor.parked and (slows or mover.speed < 0.05):
            bits |= SIGNALS["brake light"]
        return bits | SIGNALS["hazard lights"] if mover.crashed else bits


def actor_ids(actors: tuple[ScriptedActor, ...]) -> dict[str, int]:
    """Return the object ids of actors; the ego and the conflict actor have the same ids in all controls."""
    others = [one.name for one in actors if one.name not in ("ego", "conflict")]
    return {"ego": FIRST_ID, "conflict": FIRST_ID + 1} | {name: FIRST_ID + 2 + k for k, name in enumerate(others)}
