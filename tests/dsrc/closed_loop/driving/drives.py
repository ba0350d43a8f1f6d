"""Drives with the truth as tracks, for the tests of drivers."""

import time
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dsrc.closed_loop.driving.lanes import lanes_of
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.ego import choose_ego, ego_state
from dsrc.closed_loop.types import Decision, Driver, EgoState, Tracks
from sensors.recording.encounter_check import find_encounter, with_proven_encounter
from sim.catalog.load import load_scenario
from sim.collisions import collide
from sim.encounters import with_encounter
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.open import open_traffic

RANGE_M = 70.0


@dataclass
class Drive:
    """What happened: collisions are names of actors that the ego touched, progress and decisions of every step."""

    hit: list[str] = field(default_factory=list)
    hit_s: float = float("nan")
    progress_m: float = 0.0
    left: bool = False
    states: list[EgoState] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    @property
    def speed(self) -> np.ndarray:
        return np.array([state.speed_mps for state in self.states])


def true_tracks(actors: Actors, before: Actors | None, ego_id: int) -> Tracks:
    """Return the road users around the ego as tracks without error."""
    ego = actors.boxes.center[actors.row(ego_id), :2]
    near = np.hypot(*(actors.boxes.center[:, :2] - ego).T) < RANGE_M
    rows = np.flatnonzero(near & (actors.boxes.object_id != ego_id))
    boxes, n = actors.boxes[rows], len(rows)
    rate = np.zeros(n)
    if before is not None:
        was = dict(zip(before.boxes.object_id.tolist(), before.boxes.yaw.tolist(), strict=True))
        since = actors.time_s - before.time_s
        turned = [yaw - was.get(int(i), yaw) for i, yaw in zip(boxes.object_id, boxes.yaw, strict=True)]
        rate = wrap_angle(np.array(turned)) / since if n else rate
    return Tracks(actors.time_s, boxes, actors.velocity[rows], rate, np.zeros(n), np.ones(n), np.zeros(n))


def proven(name: str, seed: int) -> Scenario:
    """Return a scenario with its proven encounter; a control takes the draw of the encounter, proven once for all."""
    scenario = load_scenario(name)
    if scenario.conflict is None or not scenario.conflict.control:
        return with_proven_encounter(scenario, seed)
    draw = find_encounter(load_scenario(name.rpartition(":")[0]), seed).scenario.conflict.draw
    conflict = msgspec.structs.replace(scenario.conflict, draw=draw)
    return with_encounter(msgspec.structs.replace(scenario, conflict=conflict), seed)


def drive(
    name: str,
    seed: int,
    seconds: float = 14.0,
    driver: Driver | None = None,
    commanded: bool = True,
) -> Drive:
    """Drive a scenario with the truth until a collision; without commands the backend's own driver does."""
    scenario = proven(name, seed)
    out = Drive()
    with open_traffic(scenario, seed) as traffic:
        ego_id = choose_ego(traffic, scenario)
        driver = driver or PlanningDriver()
        driver.reset(lanes_of(scenario, seed))
        before, state = None, None
        for _ in range(round(seconds / traffic.step_s)):
            now = traffic.actors
            if ego_id not in now.boxes.object_id:
                out.left = True
                break
            state = ego_state(traffic, ego_id, state)
            row = now.row(ego_id)
            others = np.flatnonzero(np.arange(len(now)) != row)
            touched = others[collide(now.boxes[row : row + 1], now.boxes[others])]
            if len(touched):
                out.hit, out.hit_s = [now.name[k] for k in touched], now.time_s
                break
            out.states.append(state)
            out.progress_m = state.progress_m
            if commanded:
                tracks = true_tracks(now, before, ego_id)
                began = time.perf_counter()
                decision = driver.decide(state, tracks)
                out.seconds.append(time.perf_counter() - began)
                out.counts.append(len(tracks))
                out.decisions.append(decision)
                limits = state.limits
                wanted = min(max(decision.acceleration_mps2, -limits.deceleration_mps2), limits.acceleration_mps2)
                traffic.command(ego_id, max(0.0, state.speed_mps + wanted * traffic.step_s))
            before = now
            traffic.step()
    return out
