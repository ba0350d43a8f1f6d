"""Encounters on the junctions of a map: the same ones as on made roads, along the lanes that a scenario names."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim.encounters.draw import CARS, pick
from sim.encounters.lane_paths import Street, meeting
from sim.encounters.paths import Pace, Way
from sim.encounters.turning import LEFT, slowing
from sim.encounters.types import HIT_S, Actor, Layout, actor, standing
from sim.vehicle_types import TYPES

LTA_ROLES = ("ego", "conflict", "truck")
RUNNER_ROLES = ("ego", "conflict", "mate", "opposite")

_REACH_M = 130.0
_MATES = 6


def lta_truck(p: Mapping[str, float], rng: np.random.Generator, streets: Mapping[str, Street]) -> Layout:
    """As `sim.encounters.turning.lta_truck`; the lorry waits on its own way to the left."""
    ego, oncoming, truck = (streets[role] for role in LTA_ROLES)
    meet = meeting(ego.way, oncoming.way)
    pace = slowing(min(13.0, p["ego_mps"] + 4.0), p["ego_mps"], 14.0, HIT_S)
    kind, size = ("bus_city", (12.0, 2.55, 3.15)) if p["bus"] else ("truck_heavy", (p["truck_m"], 2.5, 3.6))
    stops = [street.way.at(street.stop_m)[0][:2] for street in (ego, truck)]
    # It has pulled forward, straight on, to so far from the middle between the two stop lines.
    straight = _straight_on(truck)
    front = straight.nearest(np.mean(stops, axis=0)) - p["truck_ahead_m"]
    actors = (
        actor(
            "ego",
            "ego",
            pick(CARS, rng),
            ego.way,
            pace,
            at_m=ego.way.nearest(meet),
            at_s=HIT_S,
            lights=((LEFT, 0.0, HIT_S + 2.0),),
        ),
        _met("conflict", pick(CARS, rng), oncoming.way, p["conflict_mps"], meet, p["jitter_s"]),
        _waiting("truck", "occluder helper", kind, straight, front, -p["offset_m"], size),
        _waiting("follower", "occluder helper", "van_box", straight, front - size[0] - 2.2),
    )
    return Layout(None, actors, focus=_focus(meet), reach_m=_REACH_M)


def red_light_runner(p: Mapping[str, float], rng: np.random.Generator, streets: Mapping[str, Street]) -> Layout:
    """As `sim.encounters.crossing.red_light_runner`; what stands at the corner is the map's."""
    ego, runner, mate, opposite = (streets[role] for role in RUNNER_ROLES)
    meet = meeting(ego.way, runner.way)
    red_s = HIT_S - (runner.way.nearest(meet) - runner.stop_m) / p["conflict_mps"] - p["after_red_s"]
    stops = Pace.change(7.0, 0.0, red_s - 0.3, 2.5)
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego.way, p["ego_mps"], at_m=ego.way.nearest(meet), at_s=HIT_S),
        _met("conflict", pick(CARS, rng), runner.way, p["conflict_mps"], meet, p["jitter_s"]),
        *_row(mate, rng),
        actor(
            "crossing_car", "helper", pick(CARS, rng), opposite.way, stops, at_m=opposite.stop_m - 3.5, at_s=red_s + 2.5
        ),
    )
    return Layout(None, actors, focus=_focus(meet), reach_m=_REACH_M)


def _straight_on(street: Street) -> Way:
    """Return the way to a stop line and on in its direction: a long body that has begun to turn would swing out."""
    at = np.arange(max(street.stop_m - 60.0, 0.0), street.stop_m, 2.0)
    place, heading, _ = street.way.at(street.stop_m)
    onward = place + 40.0 * np.array([np.cos(heading), np.sin(heading), 0.0])
    return Way.through(np.concatenate([street.way.at(at)[0], [place, onward]]), 0.0)


def _row(mate: Street, rng: np.random.Generator) -> list[Actor]:
    """Return the vehicles that wait beside the ego's lane: corners of a map are wider than those that are made."""
    front, row = mate.stop_m - 1.0, []
    for number in range(_MATES):
        kind = pick(("van_box", "truck_light", "truck_box"), rng)
        name = "lane_mate" if number == 0 else f"lane_mate_{number}"
        row.append(_waiting(name, "occluder", kind, mate.way, front))
        front -= TYPES[kind].size[0] + 1.8
    return row


def _met(name: str, kind: str, way: Way, speed: float, meet: NDArray[np.float64], jitter_s: float) -> Actor:
    return actor(name, "conflict", kind, way, speed, at_m=way.nearest(meet), at_s=HIT_S + jitter_s)


def _waiting(
    name: str,
    roles: str,
    kind: str,
    way: Way,
    front_m: float,
    left_m: float = 0.0,
    size: tuple[float, float, float] | None = None,
) -> Actor:
    """Return somebody who stands with the front bumper at a place of a way."""
    length = (TYPES[kind].size if size is None else size)[0]
    place, heading, _ = way.at(front_m - 0.5 * length)
    x, y = place[:2] + left_m * np.array([-np.sin(heading), np.cos(heading)])
    return standing(name, roles, kind, float(x), float(y), float(heading), size=size)


def _focus(meet: NDArray[np.float64]) -> tuple[float, float]:
    return (round(float(meet[0]), 1), round(float(meet[1]), 1))
