"""Encounters on map junctions, along the lanes that a scenario names."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim.bodies.vehicle_types import TYPES
from sim.encounters.draw import CARS, pick
from sim.encounters.lane_paths import LanePath, meeting
from sim.encounters.paths import ReferencePath, SpeedProfile
from sim.encounters.turning import LEFT, RIGHT, slowing
from sim.encounters.types import HIT_S, Layout, ScriptedActor, actor, standing

LTA_ROLES = ("ego", "conflict", "truck")
RUNNER_ROLES = ("ego", "conflict", "mate", "opposite")

_REACH_M = 130.0
_MATES = 6


def lta_truck(p: Mapping[str, float], rng: np.random.Generator, streets: Mapping[str, LanePath]) -> Layout:
    """Lay out `sim.encounters.turning.lta_truck` on a map; the lorry waits on its own path across the oncoming lane."""
    ego, oncoming, truck = (streets[role] for role in LTA_ROLES)
    meet = meeting(ego.path, oncoming.path)
    pace = slowing(min(13.0, p["ego_mps"] + 4.0), p["ego_mps"], 14.0, HIT_S)
    kind, size = ("bus_city", (12.0, 2.55, 3.15)) if p["bus"] else ("truck_heavy", (p["truck_m"], 2.5, 3.6))
    stops = [street.path.at(street.stop_m)[0][:2] for street in (ego, truck)]
    # It has pulled forward, straight on, up to this distance from the middle between the two stop lines.
    straight = _straight_on(truck)
    front = straight.nearest(np.mean(stops, axis=0)) - p["truck_ahead_m"]
    actors = (
        actor(
            "ego",
            "ego",
            pick(CARS, rng),
            ego.path,
            pace,
            at_m=ego.path.nearest(meet),
            at_s=HIT_S,
            lights=((LEFT if ego.kerb_side < 0 else RIGHT, 0.0, HIT_S + 2.0),),
        ),
        _met("conflict", pick(CARS, rng), oncoming.path, p["conflict_mps"], meet, p["jitter_s"]),
        _waiting("truck", "occluder helper", kind, straight, front, truck.kerb_side * p["offset_m"], size),
        _waiting("follower", "occluder helper", "van_box", straight, front - size[0] - 2.2),
    )
    return Layout(None, actors, focus=_focus(meet), reach_m=_REACH_M)


def red_light_runner(p: Mapping[str, float], rng: np.random.Generator, streets: Mapping[str, LanePath]) -> Layout:
    """Lay out `sim.encounters.crossing.red_light_runner` on a map, with the map's own buildings."""
    ego, runner, mate, opposite = (streets[role] for role in RUNNER_ROLES)
    meet = meeting(ego.path, runner.path)
    red_s = HIT_S - (runner.path.nearest(meet) - runner.stop_m) / p["conflict_mps"] - p["after_red_s"]
    stops = SpeedProfile.change(7.0, 0.0, red_s - 0.3, 2.5)
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego.path, p["ego_mps"], at_m=ego.path.nearest(meet), at_s=HIT_S),
        _met("conflict", pick(CARS, rng), runner.path, p["conflict_mps"], meet, p["jitter_s"]),
        *_row(mate, rng),
        actor(
            "crossing_car",
            "helper",
            pick(CARS, rng),
            opposite.path,
            stops,
            at_m=opposite.stop_m - 3.5,
            at_s=red_s + 2.5,
        ),
    )
    return Layout(None, actors, focus=_focus(meet), reach_m=_REACH_M)


def _straight_on(street: LanePath) -> ReferencePath:
    """Return the path to a stop line and straight on: a long body that has begun to turn would swing out."""
    at = np.arange(max(street.stop_m - 60.0, 0.0), street.stop_m, 2.0)
    place, heading, _ = street.path.at(street.stop_m)
    onward = place + 40.0 * np.array([np.cos(heading), np.sin(heading), 0.0])
    return ReferencePath.through(np.concatenate([street.path.at(at)[0], [place, onward]]), 0.0)


def _row(mate: LanePath, rng: np.random.Generator) -> list[ScriptedActor]:
    """Return the vehicles waiting beside the ego's lane: corners of maps are wider than made ones."""
    front, row = mate.stop_m - 1.0, []
    for number in range(_MATES):
        kind = pick(("van_box", "truck_light", "truck_box"), rng)
        name = "lane_mate" if number == 0 else f"lane_mate_{number}"
        row.append(_waiting(name, "occluder", kind, mate.path, front))
        front -= TYPES[kind].size[0] + 1.8
    return row


def _met(
    name: str, kind: str, path: ReferencePath, speed: float, meet: NDArray[np.float64], jitter_s: float
) -> ScriptedActor:
    return actor(name, "conflict", kind, path, speed, at_m=path.nearest(meet), at_s=HIT_S + jitter_s)


def _waiting(
    name: str,
    roles: str,
    kind: str,
    path: ReferencePath,
    front_m: float,
    left_m: float = 0.0,
    size: tuple[float, float, float] | None = None,
) -> ScriptedActor:
    """Return a standing vehicle with its front bumper at a distance along a path."""
    length = (TYPES[kind].size if size is None else size)[0]
    place, heading, _ = path.at(front_m - 0.5 * length)
    x, y = place[:2] + left_m * np.array([-np.sin(heading), np.cos(heading)])
    return standing(name, roles, kind, float(x), float(y), float(heading), size=size)


def _focus(meet: NDArray[np.float64]) -> tuple[float, float]:
    return (round(float(meet[0]), 1), round(float(meet[1]), 1))
