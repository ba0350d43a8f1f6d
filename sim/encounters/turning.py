"""Turning encounters: across oncoming traffic, across a cycle lane, into a roundabout."""

import math
from collections.abc import Mapping

import numpy as np
import shapely

from sim.encounters.draw import CARS, EAST, JITTER, NORTH, SOUTH, WEST, block, corner_house, pick, straight_path
from sim.encounters.networks import LANE_M, Arm, Edge, LaneSpec, Node, PlainNetwork, junction
from sim.encounters.paths import PathBuilder, ReferencePath, SpeedProfile
from sim.encounters.types import HIT_S, EncounterType, Layout, Parameter, Structure, actor, standing
from sim.scenario import RoadsideUnit

_HALF = 0.5 * LANE_M
RIGHT, LEFT = 1, 2
_CORNER_M = 6.0
"""Radius of the kerbs where arms meet the ring of a roundabout."""


def slowing(
    cruise_mps: float, turn_mps: float, from_turn_m: float, turn_s: float, rate_mps2: float = 2.0
) -> SpeedProfile:
    """Return a speed profile down to turning speed, done `from_turn_m` before the point reached at `turn_s`."""
    done_s = turn_s - from_turn_m / turn_mps
    lasts = max(cruise_mps - turn_mps, 0.0) / rate_mps2
    return SpeedProfile.change(cruise_mps, turn_mps, done_s - lasts, rate_mps2)


def lta_truck(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """The ego turns left while an oncoming lorry, which waits to turn left too, hides the lane behind itself."""
    turn_mps, car_mps = p["ego_mps"], p["conflict_mps"]
    inner, outer = _HALF, LANE_M + _HALF
    radius = 9.0
    # The arc begins before the middle and ends in the left lane of the northern arm's exit.
    start = PathBuilder(-140.0, -inner, EAST).straight(140.0 - radius + inner)
    path = start.turn(radius, 0.5 * math.pi).straight(120.0).path()
    meet_at = float(np.interp(outer, path.points[:, 1], path.along))
    pace = slowing(min(13.0, turn_mps + 4.0), turn_mps, 14.0, HIT_S)
    x = float(path.at(meet_at)[0][0])
    car_path, car_at = straight_path(x, outer, WEST, car_mps)
    length = p["truck_m"]
    truck_x = p["truck_ahead_m"] + 0.5 * length
    truck = ("truck_heavy", (length, 2.5, 3.6)) if not p["bus"] else ("bus_city", (min(length, 14.0), 2.55, 3.15))
    actors = (
        actor("ego", "ego", pick(CARS, rng), path, pace, at_m=meet_at, at_s=HIT_S, lights=((LEFT, 0.0, HIT_S + 2.0),)),
        actor("conflict", "conflict", pick(CARS, rng), car_path, car_mps, at_m=car_at, at_s=HIT_S + p["jitter_s"]),
        standing(
            "truck", "occluder helper", truck[0], truck_x, inner + p["offset_m"], WEST, size=truck[1], lights=LEFT
        ),
        standing("follower", "helper", pick(CARS, rng), truck_x + 0.5 * length + 4.5, inner, WEST, lights=LEFT),
    )
    two = (LaneSpec(), LaneSpec())
    arms = {
        "w": Arm(WEST, 180.0, two, two, priority=2),
        "e": Arm(EAST, HIT_S * car_mps + 80.0, two, two, priority=2),
        "n": Arm(NORTH, 160.0, (LaneSpec(),), two),
        "s": Arm(SOUTH, 120.0),
    }
    unit = RoadsideUnit(xyz_m=(-13.5, 12.5, 5.0), yaw_deg=-20.0, lidar="opv2v-64")
    clear = block(-80.0, -LANE_M, 140.0, 2.0 * LANE_M + 9.0)
    kind = "traffic_light" if p["signals"] else "priority"
    return Layout(junction(arms, kind, 5.0), actors, (), (unit,), clear=clear)


def cyclist_right_hook(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """The ego turns right across a cycle lane; a hedge and a van at its end hide the cyclist who rides beside it."""
    turn_mps, rider_mps = p["ego_mps"], p["conflict_mps"]
    bay, verge, path_m = 2.2, 0.6, 1.6
    bike_y = -LANE_M - bay - verge - 0.5 * path_m
    radius = p["radius_m"]
    pen = PathBuilder(-120.0, -_HALF, EAST).straight(120.0 - _HALF - radius)
    path = pen.turn(radius, -0.5 * math.pi).straight(110.0).path(2.0)
    meet_at = float(np.interp(-bike_y, -path.points[:, 1], path.along))
    # It is the front of the car that meets the rider.
    x, _, _ = (float(v) for v in path.at(meet_at)[0])
    pace = slowing(min(turn_mps + 4.0, 11.0), turn_mps, radius + 4.0, HIT_S)
    rider_path, rider_at = straight_path(x, bike_y, EAST, rider_mps)
    van_x = -p["van_to_corner_m"]
    van = pick(("van_box", "truck_light"), rng)
    van_l, van_w = (5.95, 2.05) if van == "van_box" else (6.8, 2.2)
    size = (van_l, van_w, 2.6 if van == "van_box" else 2.9)
    van_y = -LANE_M - 0.15 - 0.5 * van_w
    actors = (
        actor(
            "ego",
            "ego",
            pick(CARS, rng),
            path,
            pace,
            at_m=meet_at - 1.6,
            at_s=HIT_S,
            lights=((RIGHT, 1.0, HIT_S + 2.0),),
        ),
        actor(
            "conflict",
            "conflict",
            pick(("bicycle_city", "bicycle_fast"), rng),
            rider_path,
            rider_mps,
            at_m=rider_at,
            at_s=HIT_S + p["jitter_s"],
        ),
        standing("van", "occluder helper", van, van_x - 0.5 * van_l, van_y, size=size, lights=4, parked=True),
    )
    hedge = block(van_x - 1.0, -LANE_M - bay - 0.17, -100.0, -LANE_M - bay - verge + 0.05)
    arms = {
        "w": Arm(WEST, 160.0, (LaneSpec(bay, "delivery"), LaneSpec()), priority=2),
        "e": Arm(EAST, 170.0, priority=2),
        "s": Arm(SOUTH, 140.0),
    }
    crossing = junction(arms, radius_m=5.0)
    left = bike_y + 0.5 * path_m
    nodes = (*crossing.nodes, Node("from", -160.0, left), Node("to", 170.0, left))
    roads = PlainNetwork(
        nodes, (*crossing.edges, Edge("cycle_path", "from", "to", (LaneSpec(path_m, "bicycle"),), 8.0))
    )
    unit = RoadsideUnit(xyz_m=(-9.0, bike_y - 3.0, 5.0), yaw_deg=170.0, lidar="opv2v-64")
    clear = block(-110.0, -LANE_M, 4.0, bike_y - 6.0)
    structures = (Structure("hedge", hedge, 1.95),)
    return Layout(roads, actors, structures, (unit,), clear=clear)


def roundabout_entry(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """The ego enters a roundabout; its planted island and a lorry that leaves it here hide a car in the ring."""
    ring_r = 0.5 * p["diameter_m"] - 0.5 * 5.0
    ego_mps, ring_mps = p["ego_mps"], p["conflict_mps"]
    # The ego comes from the south and joins the ring counter-clockwise, east of its own arm.
    entry = np.deg2rad(-90.0 + np.degrees(p["meet_m"] / ring_r))
    ego_path = _entering(ring_r)
    meet = ring_r * np.array([math.cos(entry), math.sin(entry)])
    meet_at = ego_path.nearest(meet) - 1.5
    start, end = np.deg2rad(60.0), np.deg2rad(60.0) + 3.5 * math.pi
    angle = np.linspace(start, end, max(8, round(ring_r * (end - start) / 0.25)))
    ring = ReferencePath.through(ring_r * np.column_stack([np.cos(angle), np.sin(angle)]))
    car_at = ring_r * ((entry - np.deg2rad(60.0)) % (2.0 * math.pi))
    # More turns in the ring, if needed for the time before the crash.
    while car_at - ring_mps * HIT_S < 1.0:
        car_at += 2.0 * math.pi * ring_r
    pace = slowing(min(ego_mps + 4.0, 13.0), ego_mps, 12.0, HIT_S)
    truck_path, leave_at = _leaving(ring_r)
    length = p["truck_m"]
    # It brakes for people at its exit; shortly before the crash the car's front has come past its tail.
    matters_s = HIT_S - 1.1
    front = ring_r * (entry - _exit_angle(ring_r)) - (1.1 + p["jitter_s"]) * ring_mps + 2.2
    slows = SpeedProfile.change(ring_mps, min(p["exit_mps"], ring_mps), matters_s - p["brakes_s"], 2.5)
    tail_at = leave_at + front - p["past_m"] + 0.5 * length
    actors = (
        actor("ego", "ego", pick(CARS, rng), ego_path, pace, at_m=meet_at, at_s=HIT_S),
        actor("conflict", "conflict", pick(CARS, rng), ring, ring_mps, at_m=car_at, at_s=HIT_S + p["jitter_s"]),
        actor(
            "truck",
            "occluder helper",
            "truck_box",
            truck_path,
            slows,
            at_m=tail_at,
            at_s=matters_s,
            size=(length, 2.45, 3.5),
        ),
    )
    island = shapely.Point(0.0, 0.0).buffer(ring_r - 3.4, quad_segs=16)
    house = corner_house(-6.5, -ring_r - 9.0, -40.0, -90.0, 9.0)
    # Bushes fill the corner between the arms, as far as the lorry and the ring let them.
    paved = shapely.Point(0.0, 0.0).buffer(ring_r + 2.6) | block(-3.6, -170.0, 3.6, 0.0) | block(-170.0, -3.6, 0.0, 3.6)
    paved = paved.buffer(_CORNER_M).buffer(-_CORNER_M + 0.5)
    corner = block(-ring_r - 12.0, -9.0, -3.9, -ring_r - 16.0) - paved
    lorry = shapely.LineString(truck_path.points[:, :2]).buffer(1.65)
    bushes = corner - lorry - house.outline.buffer(0.3)
    bushes = max(shapely.get_parts(bushes), key=lambda part: part.area).simplify(0.05)
    structures = (Structure("hedge", island, 2.6), house, Structure("hedge", bushes, 2.3))
    unit = RoadsideUnit(xyz_m=(9.0, -ring_r - 9.0, 5.0), yaw_deg=135.0, lidar="opv2v-64")
    clear = shapely.Point(0.0, 0.0).buffer(ring_r + 30.0) | block(-30.0, 0.0, 20.0, -130.0)
    return Layout(_ring_roads(ring_r), actors, structures, (unit,), clear=clear)


def _exit_angle(ring_r: float) -> float:
    return float(np.deg2rad(-90.0 - np.degrees(5.0 / ring_r)))


def _entering(ring_r: float) -> ReferencePath:
    """Return the path from the south into the ring, round it and out in the north."""
    entry, leave = -0.5 * math.pi + 13.0 / ring_r, 0.34 * math.pi
    angle = np.linspace(entry, leave, max(8, round(ring_r * (leave - entry) / 0.25)))
    ring = ring_r * np.column_stack([np.cos(angle), np.sin(angle)])
    ahead = np.array([-math.sin(entry), math.cos(entry)])
    south = np.column_stack([np.full(60, _HALF + 0.4), np.linspace(-130.0, -ring_r - 12.0, 60)])
    north = np.column_stack([np.full(40, _HALF + 0.4), np.linspace(ring_r + 16.0, 150.0, 40)])
    joined = [*south, *_blend(south[-1], np.array([0.0, 1.0]), ring[0], ahead), *ring]
    out = np.array([-math.sin(angle[-1]), math.cos(angle[-1])])
    return ReferencePath.through(np.array([*joined, *_blend(ring[-1], out, north[0], np.array([0.0, 1.0])), *north]))


def _leaving(ring_r: float) -> tuple[ReferencePath, float]:
    """Return the path round the west of the ring and out to the south, and the distance at which it leaves the ring."""
    end = _exit_angle(ring_r) + 2.0 * math.pi
    angle = np.linspace(0.25 * math.pi, end, max(8, round(ring_r * (end - 0.25 * math.pi) / 0.25)))
    ring = ring_r * np.column_stack([np.cos(angle), np.sin(angle)])
    out = np.array([-math.sin(end), math.cos(end)])
    south = np.column_stack([np.full(60, -_HALF - 0.4), np.linspace(-ring_r - 12.0, -150.0, 60)])
    path = ReferencePath.through(np.array([*ring, *_blend(ring[-1], out, south[0], np.array([0.0, -1.0])), *south]))
    return path, path.nearest(ring[-1])


def _blend(start: np.ndarray, path: np.ndarray, end: np.ndarray, onward: np.ndarray) -> np.ndarray:
    """Return the cubic Hermite curve between two points in the given directions."""
    reach = 1.0 * float(np.hypot(*(end - start)))
    t = np.linspace(0.0, 1.0, 40)[1:-1, None]
    h = [2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, -2 * t**3 + 3 * t**2, t**3 - t**2]
    return h[0] * start + h[1] * reach * path + h[2] * end + h[3] * reach * onward


def _ring_roads(ring_r: float) -> PlainNetwork:
    """Return a ring of one lane, 5 m wide, with four arms."""
    # Lanes lie right of the line from node to node, so the nodes of a counter-clockwise ring lie inside of it.
    inner = ring_r - 2.5
    nodes, edges = [], []
    bearings = {"e": 0.0, "n": 0.5 * math.pi, "w": math.pi, "s": 1.5 * math.pi}
    for name, angle in bearings.items():
        nodes.append(Node(f"r{name}", inner * math.cos(angle), inner * math.sin(angle), "priority", _CORNER_M))
        nodes.append(Node(name, 170.0 * math.cos(angle), 170.0 * math.sin(angle)))
        edges.append(Edge(f"{name}_in", name, f"r{name}", speed_mps=11.0))
        edges.append(Edge(f"{name}_out", f"r{name}", name, speed_mps=11.0))
    names = list(bearings)
    for k, name in enumerate(names):
        other = names[(k + 1) % 4]
        turns = bearings[name] + np.linspace(0.0, 0.5 * math.pi, 14)[1:-1]
        shape = tuple((inner * math.cos(a), inner * math.sin(a)) for a in turns)
        edges.append(Edge(f"ring_{name}", f"r{name}", f"r{other}", (LaneSpec(5.0),), 11.0, 3, shape))
    return PlainNetwork(tuple(nodes), tuple(edges))


ENCOUNTERS = {
    "lta_truck": EncounterType(
        "The ego turns left behind the back of an oncoming left-turner that hides the car in the lane beside it.",
        (
            Parameter("ego_mps", 4.0, 9.0, (5.5, 8.0), "speed of the ego in its turn"),
            Parameter("conflict_mps", 11.0, 18.0, (13.0, 18.0), "speed of the oncoming car"),
            Parameter("truck_m", 7.0, 16.5, (8.0, 16.5), "length of the waiting lorry"),
            Parameter("truck_ahead_m", 2.0, 12.0, (4.0, 7.0), "from the middle of the junction to the lorry's front"),
            Parameter("offset_m", 0.0, 1.0, (0.0, 1.0), "how far the lorry stands to its right in its lane"),
            Parameter("bus", 0.0, 1.0, (0.0, 1.0), "the lorry is a bus", True),
            Parameter("signals", 0.0, 1.0, (0.0, 1.0), "with traffic lights that let both turn (permissive)", True),
            JITTER,
        ),
        lta_truck,
    ),
    "cyclist_right_hook": EncounterType(
        "The ego turns right across a cycle lane behind a hedge and a delivery van.",
        (
            Parameter("ego_mps", 3.0, 8.0, (5.3, 6.5), "speed of the ego in its turn"),
            Parameter("conflict_mps", 3.0, 9.0, (6.8, 9.0), "speed of the cyclist"),
            Parameter("radius_m", 5.0, 12.0, (6.5, 7.4), "of the turn"),
            Parameter(
                "van_to_corner_m", 5.0, 30.0, (7.0, 8.3), "from the van's front to the middle of the side street"
            ),
            JITTER,
        ),
        cyclist_right_hook,
    ),
    "roundabout_entry": EncounterType(
        "The ego enters a roundabout behind a lorry that leaves it and hides the car behind.",
        (
            Parameter("diameter_m", 24.0, 50.0, (40.0, 50.0), "outer diameter"),
            Parameter("ego_mps", 4.0, 10.0, (9.0, 10.0), "speed of the ego at the entry"),
            Parameter("conflict_mps", 6.0, 12.0, (9.0, 9.8), "speed in the ring"),
            Parameter("meet_m", 1.0, 8.0, (2.6, 4.8), "from the axis of the ego's arm to where the ways cross"),
            Parameter(
                "past_m",
                -6.0,
                8.0,
                (-3.0, -1.7),
                "from the lorry's tail to the car's front 1.1 s before their ways cross",
            ),
            Parameter("exit_mps", 2.0, 8.0, (3.8, 4.6), "speed of the lorry when it has left the ring"),
            Parameter("brakes_s", 1.0, 5.0, (3.0, 3.6), "how long before that it brakes for people at its exit"),
            Parameter("truck_m", 6.0, 12.0, (9.0, 11.0), "length of the lorry"),
            JITTER,
        ),
        roundabout_entry,
    ),
}
