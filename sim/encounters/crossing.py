"""Crossing encounters: a road user from the side, occluded by a house, a queue or a stopped neighbour."""

from collections.abc import Mapping

import numpy as np

from sim.bodies.vehicle_types import TYPES
from sim.encounters.draw import (
    AFTER_S,
    CARS,
    EAST,
    JITTER,
    NORTH,
    SOUTH,
    VANS,
    WEST,
    block,
    corner_house,
    pick,
    straight_path,
)
from sim.encounters.networks import LANE_M, Arm, LaneSpec, junction
from sim.encounters.paths import PathBuilder, SpeedProfile
from sim.encounters.types import HIT_S, EncounterType, Layout, Parameter, ScriptedActor, actor, standing
from sim.scenario import RoadsideUnit

_HALF = 0.5 * LANE_M

_BEARINGS = {"w": WEST, "e": EAST, "n": NORTH, "s": SOUTH}


def ima_building(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A car comes from behind the house at the corner of a crossing without signals."""
    ego_mps, car_mps, side = p["ego_mps"], p["conflict_mps"], 1.0 if p["from_left"] else -1.0
    x = -side * _HALF
    ego_path, ego_at = straight_path(x, -_HALF, EAST, ego_mps)
    car_path, car_at = straight_path(x, -_HALF, -side * NORTH, car_mps)
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego_path, ego_mps, at_m=ego_at, at_s=HIT_S),
        actor("conflict", "conflict", pick(CARS, rng), car_path, car_mps, at_m=car_at, at_s=HIT_S + p["jitter_s"]),
        standing("crossing_car", "helper", pick(CARS, rng), -x, -side * 14.0, side * NORTH),
    )
    edge = LANE_M + p["setback_m"]
    # No line of sight passes behind the house, from the start on.
    along_ego, along_car = (HIT_S + 0.5) * ego_mps + 10.0, (HIT_S + 0.5) * car_mps + 10.0
    house = corner_house(-edge, side * edge, -along_ego, side * along_car, float(rng.uniform(8.0, 14.0)))
    clear = block(-LANE_M, side * LANE_M, -edge - along_ego - 15.0, side * (edge + along_car + 15.0))
    ranks = [(1, 1), (2, 1), (1, 2)][int(p["priority"])]
    far = {"w": HIT_S * ego_mps, "e": AFTER_S * ego_mps, "n": AFTER_S * car_mps, "s": AFTER_S * car_mps}
    arms = {name: Arm(at, far[name] + 60.0, priority=ranks[name in "ns"]) for name, at in _BEARINGS.items()}
    roads = junction(arms, "right_before_left" if ranks == (1, 1) else "priority")
    unit = RoadsideUnit(xyz_m=(9.0, side * 9.0, 5.0), yaw_deg=180.0 - side * 45.0, lidar="opv2v-64")
    return Layout(roads, actors, (house,), (unit,), clear=clear)


def ima_queue(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A car or bicycle comes out of a side street through a standing queue in the lane beside the ego's."""
    ego_mps, speed = p["ego_mps"], p["conflict_mps"]
    cycling = speed < 6.5
    meet = (_HALF, -_HALF)
    ego_path, ego_at = straight_path(*meet, EAST, ego_mps)
    path, at = straight_path(*meet, NORTH, speed)
    kind = pick(("bicycle_city", "bicycle_fast") if cycling else CARS, rng)
    actors = [
        actor("ego", "ego", pick(CARS, rng), ego_path, ego_mps, at_m=ego_at, at_s=HIT_S),
        actor("conflict", "conflict", kind, path, speed, at_m=at, at_s=HIT_S + p["jitter_s"]),
        *_queue(round(p["queue"]), p["gap_m"], -_HALF - LANE_M, rng),
    ]
    # Farther down the side street houses occlude it, with the queue and without.
    along_ego, along_other = HIT_S * ego_mps + 20.0, HIT_S * speed + 20.0
    edge = 2.0 * LANE_M + 5.0
    house = corner_house(-11.0, -edge, -along_ego, -along_other, float(rng.uniform(8.0, 14.0)), occluder=False)
    clear = block(-LANE_M, -2.0 * LANE_M, -11.0 - along_ego, -edge - along_other)
    two = (LaneSpec(), LaneSpec())
    arms = {
        "w": Arm(WEST, HIT_S * ego_mps + 60.0, two, two, priority=2),
        "e": Arm(EAST, AFTER_S * ego_mps + 60.0, two, two, priority=2),
        "n": Arm(NORTH, AFTER_S * speed + 60.0, speed_mps=8.4),
        "s": Arm(SOUTH, HIT_S * speed + 60.0, speed_mps=8.4),
    }
    unit = RoadsideUnit(xyz_m=(12.5, -11.5, 5.0), yaw_deg=150.0, lidar="opv2v-64")
    return Layout(junction(arms, radius_m=4.0), tuple(actors), (house,), (unit,), clear=clear)


def _queue(count: int, gap_m: float, y: float, rng: np.random.Generator) -> list[ScriptedActor]:
    """Return vehicles that stand before the junction at the origin, the first of them connected."""
    queue, front = [], -8.0
    for row in range(count):
        kind = pick(("van_box", "van_people", "truck_light"), rng) if row else pick(VANS, rng)
        length = TYPES[kind].size[0]
        roles = "occluder helper" if row == 0 else "occluder"
        queue.append(standing("queue_head" if row == 0 else f"queue_{row}", roles, kind, front - 0.5 * length, y))
        front -= length + gap_m
    return queue


def red_light_runner(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A car runs a red light from behind a corner house and a lorry that waits in the lane beside the ego's."""
    ego_mps, car_mps = p["ego_mps"], p["conflict_mps"]
    meet = (_HALF, -_HALF)
    ego_path, ego_at = straight_path(*meet, EAST, ego_mps)
    car_path, car_at = straight_path(*meet, NORTH, car_mps)
    mate = pick(("van_box", "truck_light", "truck_box"), rng)
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego_path, ego_mps, at_m=ego_at, at_s=HIT_S),
        actor("conflict", "conflict", pick(CARS, rng), car_path, car_mps, at_m=car_at, at_s=HIT_S + p["jitter_s"]),
        standing("lane_mate", "occluder", mate, -8.5 - 0.5 * TYPES[mate].size[0], -_HALF - LANE_M, lights=1),
        _stopping_car(HIT_S - 12.0 / car_mps - p["after_red_s"], rng),
    )
    edge = 2.0 * LANE_M + p["setback_m"]
    along_ego, along_car = (HIT_S + 0.5) * ego_mps + 10.0, (HIT_S + 0.5) * car_mps + 10.0
    corner = LANE_M + p["setback_m"]
    house = corner_house(-corner, -edge, -along_ego, -along_car, float(rng.uniform(9.0, 15.0)))
    clear = block(-LANE_M, -2.0 * LANE_M, -corner - along_ego - 15.0, -edge - along_car - 15.0)
    two = (LaneSpec(), LaneSpec())
    arms = {
        "w": Arm(WEST, HIT_S * ego_mps + 60.0, two, two),
        "e": Arm(EAST, AFTER_S * ego_mps + 60.0, two, two),
        "n": Arm(NORTH, AFTER_S * car_mps + 60.0),
        "s": Arm(SOUTH, HIT_S * car_mps + 60.0),
    }
    unit = RoadsideUnit(xyz_m=(10.5, -12.0, 5.0), yaw_deg=150.0, lidar="opv2v-64")
    return Layout(junction(arms, "traffic_light", 4.0), actors, (house,), (unit,), clear=clear)


def _stopping_car(red_s: float, rng: np.random.Generator) -> ScriptedActor:
    """Return a connected car on the opposite arm that brakes for a red light, standing 2.5 s after it."""
    path = PathBuilder(-_HALF, 90.0, SOUTH).straight(110.0).path()
    pace = SpeedProfile.change(7.0, 0.0, red_s - 0.3, 2.5)
    return actor("crossing_car", "helper", pick(CARS, rng), path, pace, at_m=90.0 - 14.0, at_s=red_s + 2.5)


ENCOUNTERS = {
    "ima_building": EncounterType(
        "A car crosses from behind the house at a corner without signals.",
        (
            Parameter("ego_mps", 8.0, 17.0, (11.0, 17.0), "speed of the ego"),
            Parameter("conflict_mps", 8.0, 17.0, (8.0, 17.0), "speed of the crossing car"),
            Parameter("setback_m", 2.0, 8.0, (2.0, 4.0), "from the carriageway to the house"),
            Parameter("from_left", 0.0, 1.0, (0.0, 1.0), "the car comes from the left, not the right", True),
            Parameter("priority", 0.0, 2.0, (0.0, 2.0), "right before left, ego's road first, other road first", True),
            JITTER,
        ),
        ima_building,
    ),
    "ima_queue": EncounterType(
        "A car or bicycle crosses through the gap before a standing queue in the next lane.",
        (
            Parameter("ego_mps", 6.0, 17.0, (12.0, 17.0), "speed of the ego"),
            Parameter("conflict_mps", 3.0, 14.0, (3.5, 10.0), "speed of the crossing road user, a bicycle below 6.5"),
            Parameter("queue", 2.0, 6.0, (3.0, 6.0), "vehicles in the queue", True),
            Parameter("gap_m", 2.0, 4.0, (2.0, 2.6), "between vehicles of the queue"),
            JITTER,
        ),
        ima_queue,
    ),
    "red_light_runner": EncounterType(
        "A car runs a red light from behind a house and a stopped lorry.",
        (
            Parameter("ego_mps", 8.0, 17.0, (11.0, 17.0), "speed of the ego, which has green"),
            Parameter("conflict_mps", 12.0, 20.0, (12.0, 20.0), "speed of the runner"),
            Parameter("after_red_s", 0.5, 3.0, (0.5, 3.0), "how long its light has been red when it passes"),
            Parameter("setback_m", 2.0, 8.0, (2.0, 4.0), "from the carriageway to the house"),
            JITTER,
        ),
        red_light_runner,
    ),
}
