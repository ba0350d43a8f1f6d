"""Pedestrian encounters: people step out from behind vehicles at the kerb."""

from collections.abc import Mapping

import numpy as np

from sim.bodies.vehicle_types import TYPES
from sim.encounters.draw import AFTER_S, CARS, EAST, JITTER, NORTH, WEST, block, pick, straight_path
from sim.encounters.networks import LANE_M, Edge, LaneSpec, Node, PlainNetwork
from sim.encounters.paths import PathBuilder, SpeedProfile
from sim.encounters.types import HIT_S, EncounterType, Layout, Parameter, ScriptedActor, actor, standing
from sim.scenario import RoadsideUnit

_HALF = 0.5 * LANE_M


def ped_dartout(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A child runs out between parked vans."""
    ego_mps, child_mps, gap = p["ego_mps"], p["conflict_mps"], p["parking_gap_m"]
    bay = 2.3
    van_y = -LANE_M - 0.1 - 1.0
    # The child leaves the shade of the vans `step_out_s` before the ego's front is where it crosses.
    shade = -LANE_M - 0.1
    hit_y = shade + child_mps * p["step_out_s"]
    ego_path, at = straight_path(-2.2, -_HALF, EAST, ego_mps)
    actors = [
        actor("ego", "ego", pick(CARS, rng), ego_path, ego_mps, at_m=at, at_s=HIT_S),
        _crossing("person_child", -7.6, hit_y, child_mps, HIT_S + p["jitter_s"], (0.45, 0.45, p["height_m"])),
        *_parked(gap, van_y, rng),
        _oncoming(rng),
    ]
    unit = RoadsideUnit(xyz_m=(0.6, LANE_M + 3.2, 5.0), yaw_deg=-90.0, lidar="opv2v-64")
    clear = block(-110.0, -LANE_M, 40.0, -14.0)
    lanes = (LaneSpec(bay, "delivery"), LaneSpec())
    return Layout(_street(ego_mps, lanes), tuple(actors), (), (unit,), reach_m=120.0, clear=clear)


def ped_bus_stop(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A passenger crosses the road in front of the bus."""
    ego_mps, walk_mps = p["ego_mps"], p["conflict_mps"]
    bay = 3.0
    bus_y = -LANE_M - 0.15 - 1.275
    shade = -LANE_M - 0.15
    hit_y = shade + walk_mps * p["step_out_s"]
    ego_path, at = straight_path(-2.2, -_HALF, EAST, ego_mps)
    length = TYPES["bus_city"].size[0]
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego_path, ego_mps, at_m=at, at_s=HIT_S),
        _crossing(pick(("person_tall", "person_middle"), rng), -7.0, hit_y, walk_mps, HIT_S + p["jitter_s"]),
        standing("bus", "occluder helper", "bus_city", -p["before_bus_m"] - 0.5 * length, bus_y, lights=4),
        _oncoming(rng),
    )
    unit = RoadsideUnit(xyz_m=(2.5, LANE_M + 3.2, 5.0), yaw_deg=-100.0, lidar="opv2v-64")
    clear = block(-110.0, -LANE_M, 40.0, -14.0)
    lanes = (LaneSpec(bay, "bus"), LaneSpec())
    return Layout(_street(ego_mps, lanes), actors, (), (unit,), reach_m=120.0, clear=clear)


def _crossing(
    kind: str, start_y: float, hit_y: float, speed: float, at_s: float, size: tuple[float, float, float] | None = None
) -> ScriptedActor:
    """Return a pedestrian who waits at (0, `start_y`), runs north and reaches `hit_y` at `at_s`."""
    start_s = at_s - (hit_y - start_y) / speed - 0.25
    pace = SpeedProfile.change(0.0, speed, max(start_s, 0.1), speed / 0.5)
    path = PathBuilder(0.0, start_y - 0.5, NORTH).straight(45.0).path(0.0)
    return actor("conflict", "conflict", kind, path, pace, at_m=0.5, size=size)


def _oncoming(rng: np.random.Generator) -> ScriptedActor:
    """Return a connected oncoming car, still ahead of the ego at the crash."""
    path = PathBuilder(200.0, _HALF, WEST).straight(380.0).path()
    return actor("oncoming", "helper", pick(CARS, rng), path, 7.0, at_m=180.0, at_s=HIT_S)


def _parked(gap: float, y: float, rng: np.random.Generator) -> list[ScriptedActor]:
    """Return parked vehicles on both sides of the gap at x = 0, the nearest one ahead a connected van."""
    actors = []
    for side, count in ((-1.0, 7), (1.0, 3)):
        edge = side * 0.5 * gap
        for row in range(count):
            kind = (
                ("van_box" if side < 0 else "van_people")
                if row == 0
                else pick(("van_people", "van_box", "van_small"), rng)
            )
            length = TYPES[kind].size[0]
            name = f"parked_{'w' if side < 0 else 'e'}{row}"
            roles = "occluder helper" if row == 0 and side > 0 else "occluder"
            actors.append(standing(name, roles, kind, edge + side * 0.5 * length, y, parked=True))
            edge += side * (length + float(rng.uniform(0.7, 1.1)))
    return actors


def _street(ego_mps: float, lanes: tuple[LaneSpec, ...]) -> PlainNetwork:
    """Return a street along the x axis, with a bay on the right of the ego's lane."""
    west, east = -ego_mps * HIT_S - 60.0, ego_mps * AFTER_S + 60.0
    nodes = (Node("a", west, 0.0), Node("b", max(east, 240.0), 0.0))
    return PlainNetwork(nodes, (Edge("there", "a", "b", lanes), Edge("back", "b", "a")))


_SPEED = Parameter("ego_mps", 6.0, 14.0, (8.0, 14.0), "speed of the ego")

ENCOUNTERS = {
    "ped_dartout": EncounterType(
        "A child runs out between parked vans.",
        (
            _SPEED,
            Parameter("conflict_mps", 1.0, 2.5, (1.5, 2.5), "speed of the child"),
            Parameter("height_m", 1.1, 1.8, (1.1, 1.5), "of the child"),
            Parameter("parking_gap_m", 1.0, 6.0, (1.0, 3.0), "between the vans where the child runs"),
            Parameter("step_out_s", 0.4, 2.5, (0.5, 0.9), "from the line of the vans to the crash"),
            JITTER,
        ),
        ped_dartout,
    ),
    "ped_bus_stop": EncounterType(
        "A pedestrian crosses the road in front of a bus at its stop.",
        (
            _SPEED,
            Parameter("conflict_mps", 1.0, 3.0, (1.4, 3.0), "speed of the pedestrian"),
            Parameter("before_bus_m", 0.5, 4.0, (0.8, 2.0), "from the bus to where the pedestrian crosses"),
            Parameter("step_out_s", 0.4, 2.5, (0.5, 0.9), "from the line of the bus to the crash"),
            JITTER,
        ),
        ped_bus_stop,
    ),
}
