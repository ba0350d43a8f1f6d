"""Longitudinal encounters: overtaking, chain braking, a stalled car behind a bend, a merge."""

import math
from collections.abc import Mapping

import numpy as np

from sim.bodies.vehicle_types import TYPES
from sim.encounters.draw import AFTER_S, CARS, EAST, JITTER, band, block, pick
from sim.encounters.networks import LANE_M, Edge, LaneSpec, Node, PlainNetwork
from sim.encounters.paths import PathBuilder, ReferencePath, SpeedProfile
from sim.encounters.types import (
    HIT_S,
    EncounterType,
    Layout,
    Overtaking,
    Parameter,
    ScriptedActor,
    Structure,
    actor,
    standing,
)
from sim.geometry import Array
from sim.scenario import RoadsideUnit

_HALF = 0.5 * LANE_M
_LEFT = 2


def dnpw_overtake(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """The ego pulls out to overtake a lorry in a right-hand bend; a car comes towards it, hidden by lorry and hedge."""
    truck_mps, car_mps, radius = p["truck_mps"], p["conflict_mps"], p["radius_m"]
    ego_mps = truck_mps + p["faster_mps"]
    # The centre line runs east before the bend, and turns right; all paths lie beside it.
    before = ego_mps * HIT_S + 40.0
    total = ego_mps * AFTER_S + car_mps * HIT_S + 80.0
    bend = min(1.2, total / radius)
    pen = PathBuilder(-before, 0.0, EAST).straight(before - 60.0).turn(radius, -bend)
    centre = pen.straight(max(total - bend * radius, 20.0)).path(20.0)
    lane = ReferencePath.through(centre.beside(-_HALF), 6.0)
    meet_at = lane.nearest(centre.at(before)[0][:2])
    # The gap to the oncoming car at the pull-out gives its time before the crash.
    out_s = max(HIT_S - p["gap_m"] / (ego_mps + car_mps), 1.0)
    out_at = meet_at - ego_mps * (HIT_S - out_s)
    ego_path = _changing(lane, out_at, ego_mps * 3.2, LANE_M, -1)
    oncoming = ReferencePath.through(centre.beside(_HALF)[::-1], 6.0)
    there = ego_path.at(ego_path.nearest(lane.at(meet_at)[0][:2]))[0][:2]
    kind = pick(("truck_box", "truck_heavy"), rng)
    length = TYPES[kind].size[0]
    # As it pulls out the ego is `headway_m` behind the lorry.
    truck_at = out_at + 2.4 + p["headway_m"] + 0.5 * length
    actors = (
        actor(
            "ego",
            "ego",
            pick(CARS, rng),
            ego_path,
            ego_mps,
            at_m=ego_path.nearest(there),
            at_s=HIT_S,
            lights=((_LEFT, out_s - 1.0, out_s + 3.2),),
            overtaking=Overtaking(lane, out_at, "truck"),
        ),
        actor(
            "conflict",
            "conflict",
            pick(CARS, rng),
            oncoming,
            car_mps,
            at_m=oncoming.nearest(there),
            at_s=HIT_S + p["jitter_s"],
        ),
        actor("truck", "occluder helper", kind, lane, truck_mps, at_m=truck_at, at_s=out_s),
        actor("front_car", "helper", pick(CARS, rng), lane, truck_mps, at_m=truck_at + p["front_m"], at_s=out_s),
    )
    hedge = band(_cut(lane, meet_at - 70.0, meet_at + 190.0), -_HALF - 1.2, -_HALF - 2.8)
    clear = band(_cut(lane, 5.0, lane.length - 5.0), -_HALF - 0.2, -45.0)
    focus = tuple(lane.at(meet_at + 20.0)[0][:2].tolist())
    return Layout(_two_path(centre, 27.0), actors, (Structure("hedge", hedge, 2.0),), (), focus, 120.0, clear)


def eebl_chain(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """The car two ahead brakes hard; the van between swerves at the last moment and shows it to the ego too late."""
    speed, brakes, headway = p["ego_mps"], p["brake_mps2"], p["headway_s"]
    y = -LANE_M - _HALF
    van = pick(("van_box", "truck_light"), rng)
    van_l, lead_l, ego_l = TYPES[van].size[0], 4.5, 4.5
    # Bumper to bumper; the van is `van_headway_s` behind the car that brakes.
    to_lead = speed * (headway + p["van_headway_s"]) + van_l
    brake_s = HIT_S - closing_s(to_lead, speed, brakes)
    swerve_s = brake_s + p["swerve_s"]
    west = -speed * HIT_S - 40.0
    east = speed * AFTER_S + to_lead + 100.0
    lane = PathBuilder(west, y, EAST).straight(east - west).path()
    ego_at = -west - 0.5 * ego_l
    van_at_start = ego_at - speed * HIT_S + 0.5 * ego_l + speed * headway + 0.5 * van_l
    lead_at_start = ego_at - speed * HIT_S + 0.5 * ego_l + to_lead + 0.5 * lead_l
    turn_at = van_at_start + speed * swerve_s
    van_path = (
        PathBuilder(west, y, EAST).straight(turn_at).shift(LANE_M, speed * p["lane_change_s"]).straight(east).path()
    )
    ahead = PathBuilder(west, y + LANE_M, EAST).straight(east - west).path()
    actors = (
        actor("ego", "ego", pick(CARS, rng), lane, speed, at_m=ego_at - speed * HIT_S),
        actor(
            "conflict",
            "conflict",
            pick(CARS, rng),
            lane,
            SpeedProfile.change(speed, 0.0, brake_s, brakes),
            at_m=lead_at_start,
        ),
        actor(
            "van",
            "occluder helper",
            van,
            van_path,
            speed,
            at_m=van_at_start,
            lights=((_LEFT, swerve_s, swerve_s + 3.0),),
        ),
        actor("far_car", "helper", pick(CARS, rng), ahead, speed, at_m=lead_at_start + speed * 0.7),
    )
    return Layout(_straight(west - 20.0, east + 40.0, speed), actors, reach_m=110.0)


def closing_s(gap_m: float, speed: float, brakes: float) -> float:
    """Return the time for a follower at constant speed to close the gap to a braking leader, s."""
    if 0.5 * speed**2 / brakes >= gap_m:
        return math.sqrt(2.0 * gap_m / brakes)
    return (gap_m + 0.5 * speed**2 / brakes) / speed


def stalled_after_curve(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A car is stalled behind a tight right-hand bend of a country road, occluded by a hedge on the inside."""
    radius = p["radius_m"]
    ego_mps = min(max(math.sqrt(p["lateral_mps2"] * radius), 14.0), 28.0)
    width = p["lane_m"]
    bend = min(0.85 * math.pi, (ego_mps * 4.0 + 70.0) / radius)
    before = ego_mps * HIT_S + 40.0
    pen = PathBuilder(0.0, 0.0, EAST).straight(before).turn(radius + 0.5 * width, -bend)
    centre = pen.straight(ego_mps * AFTER_S + 60.0).path(12.0)
    lane = ReferencePath.through(centre.beside(-0.5 * width), 4.0)
    # It stands in the second half of the bend, where the chord of sight lies across the hedge.
    stands_at = before + 0.72 * bend * radius
    kind = pick(CARS, rng)
    place, heading, _ = lane.at(stands_at)
    right = np.array([math.sin(heading), -math.cos(heading)])
    spot = place[:2] + p["aside_m"] * right
    hit_at = stands_at - 4.5
    actors = [
        actor("ego", "ego", pick(CARS, rng), lane, ego_mps, at_m=hit_at, at_s=HIT_S),
        standing("conflict", "conflict", kind, float(spot[0]), float(spot[1]), float(heading), lights=4),
    ]
    at = stands_at
    for row in range(round(p["jam"])):
        at += 7.5
        where, turned, _ = lane.at(at)
        name, roles = ("jam_car", "jam helper") if row == 0 else (f"jam_{row}", "jam")
        x, y = where[:2].tolist()
        actors.append(standing(name, roles, pick(CARS, rng), x, y, float(turned)))
    oncoming = ReferencePath.through(centre.beside(0.5 * width)[::-1], 4.0)
    opposite = oncoming.nearest(place[:2])
    actors.append(
        actor("oncoming", "helper", pick(CARS, rng), oncoming, 0.7 * ego_mps, at_m=opposite - 8.0, at_s=HIT_S - 3.6)
    )
    hedge = band(_cut(lane, before - 30.0, before + bend * radius + 30.0), -0.5 * width - 0.35, -0.5 * width - 2.0)
    clear = band(_cut(lane, 2.0, lane.length - 2.0), -0.5 * width - 0.2, -min(45.0, 0.7 * radius))
    outside = place[:2] - (1.5 * width + 3.0) * right
    unit = RoadsideUnit(
        xyz_m=(float(outside[0]), float(outside[1]), 5.0), yaw_deg=float(np.degrees(heading)) - 140.0, lidar="opv2v-64"
    )
    focus = tuple(lane.at(stands_at - 25.0)[0][:2].tolist())
    roads = _two_path(centre, 27.0, width)
    return Layout(roads, tuple(actors), (Structure("hedge", hedge, 2.6),), (unit,), focus, 100.0, clear)


def cut_in_merge(p: Mapping[str, float], rng: np.random.Generator) -> Layout:
    """A car comes off the ramp, crosses before a column of lorries in the right lane and on into the ego's."""
    car_mps, ego_mps = p["conflict_mps"], p["conflict_mps"] + p["faster_mps"]
    slow_y, fast_y = -1.5 * LANE_M, -_HALF
    west, east = -ego_mps * HIT_S - 60.0, ego_mps * AFTER_S + 80.0
    # Where it meets the ego at x = 0 the car is past the middle of its way across two lanes.
    drift = p["crossing_s"] * car_mps
    gore = -0.62 * drift - 40.0
    lane = PathBuilder(west, fast_y, EAST).straight(east - west).path()
    ramp = _ramp(gore)
    points = ramp - np.array([0.0, _HALF])
    after = PathBuilder(gore, points[-1, 1], EAST).straight(40.0).shift(2.0 * LANE_M, drift).straight(east).path(0.0)
    car_path = ReferencePath.through(np.concatenate([points[:-1], after.points[:, :2]]), 16.0)
    # The ego's front reaches the car's rear: the cars are then one length apart.
    met = float(np.interp(0.0, car_path.points[:, 0], car_path.along))
    actors = (
        actor("ego", "ego", pick(CARS, rng), lane, ego_mps, at_m=-west - 4.4, at_s=HIT_S),
        actor(
            "conflict",
            "conflict",
            pick(CARS, rng),
            car_path,
            car_mps,
            at_m=met,
            at_s=HIT_S,
            lights=((_LEFT, 0.0, HIT_S + 2.0),),
        ),
        *_column(p, west, slow_y, east - west, rng),
    )
    unit = RoadsideUnit(xyz_m=(gore + 15.0, -3.0 * LANE_M - 3.0, 6.0), yaw_deg=20.0, lidar="opv2v-64")
    clear = block(west, -2.0 * LANE_M, east, -60.0)
    return Layout(_merge(west - 30.0, east + 60.0, ramp), actors, (), (unit,), (-40.0, slow_y), 120.0, clear)


def _column(
    p: Mapping[str, float], west: float, y: float, length_m: float, rng: np.random.Generator
) -> list[ScriptedActor]:
    """Return the lorries in the right lane, the first of them connected."""
    path = PathBuilder(west, y + p["offset_m"], EAST).straight(length_m).path()
    # At the crash the first one's front is `gap_m` behind the rear of the car that has come before it.
    front, column = -west - 2.4 - p["gap_m"], []
    for row in range(round(p["lorries"])):
        kind = pick(("truck_box", "truck_heavy"), rng)
        length = max(TYPES[kind].size[0], p["truck_m"])
        name, roles = ("truck", "occluder helper") if row == 0 else (f"truck_{row}", "occluder")
        column.append(
            actor(
                name, roles, kind, path, p["truck_mps"], at_m=front - 0.5 * length, at_s=HIT_S, size=(length, 2.55, 3.8)
            )
        )
        front -= length + p["following_m"]
    return column


def _ramp(gore: float) -> Array:
    """Return the left edge of a ramp that comes up from the south and joins a motorway at x = `gore`."""
    far = (
        PathBuilder(gore, -2.0 * LANE_M, np.pi)
        .straight(25.0)
        .turn(500.0, 0.14)
        .straight(40.0)
        .turn(300.0, 0.25)
        .straight(90.0)
    )
    return far.path().points[::-4, :2]


def _changing(lane: ReferencePath, start_m: float, length_m: float, left_m: float, back: int) -> ReferencePath:
    """Return a path along a lane with a lane change of `left_m` to the left from `start_m` on."""
    share = np.clip((lane.along - start_m) / length_m, 0.0, 1.0)
    left = left_m * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    normal = np.column_stack([-np.sin(lane.heading), np.cos(lane.heading)])
    return ReferencePath.through(lane.points[:, :2] + left[:, None] * normal, 4.0)


def _cut(path: ReferencePath, start_m: float, end_m: float) -> Array:
    at = np.arange(max(start_m, 0.0), min(end_m, path.length), 2.0)
    return path.at(at)[0][:, :2]


def _two_path(centre: ReferencePath, speed: float, width: float = LANE_M) -> PlainNetwork:
    """Return a road of one lane each way along a centre line."""
    line = _cut(centre, 0.0, centre.length)
    nodes = (Node("a", *line[0].tolist()), Node("b", *line[-1].tolist()))
    shape = tuple((float(x), float(y)) for x, y in line[1:-1])
    lanes = (LaneSpec(width),)
    return PlainNetwork(
        nodes, (Edge("there", "a", "b", lanes, speed, 1, shape), Edge("back", "b", "a", lanes, speed, 1, shape[::-1]))
    )


def _straight(west: float, east: float, speed: float) -> PlainNetwork:
    """Return a road of two lanes each way along the x axis."""
    nodes = (Node("a", west, 0.0), Node("b", east, 0.0))
    two, limit = (LaneSpec(), LaneSpec()), max(speed, 13.89)
    return PlainNetwork(nodes, (Edge("there", "a", "b", two, limit), Edge("back", "b", "a", two, limit)))


def _merge(west: float, east: float, ramp: Array) -> PlainNetwork:
    """Return one carriageway of a two-lane motorway with a merging lane and its ramp."""
    two, three = (LaneSpec(), LaneSpec()), (LaneSpec(), LaneSpec(), LaneSpec())
    gore, end = float(ramp[-1, 0]), 160.0
    nodes = (
        Node("a", west, 0.0),
        Node("g", gore, 0.0),
        Node("m", end, 0.0),
        Node("b", east, 0.0),
        Node("r", *ramp[0].tolist()),
    )
    shape = tuple((float(x), float(y)) for x, y in ramp[1:])
    edges = (
        Edge("before", "a", "g", two, 33.0, 3),
        Edge("ramp", "r", "g", (LaneSpec(),), 25.0, 1, shape),
        Edge("merge", "g", "m", three, 33.0, 3),
        Edge("after", "m", "b", two, 33.0, 3),
    )
    return PlainNetwork(nodes, edges)


ENCOUNTERS = {
    "dnpw_overtake": EncounterType(
        "The ego overtakes a lorry in a right-hand bend while a car comes towards it.",
        (
            Parameter("truck_mps", 8.0, 14.0, (8.0, 14.0), "speed of the lorry"),
            Parameter("faster_mps", 2.0, 8.0, (3.0, 5.5), "how much faster the ego is"),
            Parameter("conflict_mps", 14.0, 25.0, (18.0, 25.0), "speed of the oncoming car"),
            Parameter("gap_m", 80.0, 250.0, (80.0, 95.0), "to the oncoming car when the ego pulls out"),
            Parameter("radius_m", 150.0, 800.0, (200.0, 350.0), "of the bend"),
            Parameter("headway_m", 5.0, 25.0, (10.0, 15.0), "from the ego to the lorry when it pulls out"),
            Parameter("front_m", 25.0, 80.0, (35.0, 55.0), "from the lorry to the connected car before it"),
            JITTER,
        ),
        dnpw_overtake,
    ),
    "eebl_chain": EncounterType(
        "The car two ahead brakes hard and the van between swerves at the last moment.",
        (
            Parameter("ego_mps", 14.0, 33.0, (19.0, 33.0), "speed of all"),
            Parameter("brake_mps2", 5.0, 9.0, (6.0, 9.0), "braking of the car ahead"),
            Parameter("headway_s", 0.8, 2.0, (0.8, 1.1), "from the ego to the van"),
            Parameter("van_headway_s", 0.8, 2.0, (1.5, 2.0), "from the van to the car that brakes"),
            Parameter("swerve_s", 0.2, 2.0, (1.4, 1.8), "how long after the braking the van swerves"),
            Parameter("lane_change_s", 1.8, 4.0, (2.2, 2.4), "how long that takes"),
        ),
        eebl_chain,
        waits=False,
    ),
    "stalled_after_curve": EncounterType(
        "A car is stalled behind a tight bend with a hedge on the inside.",
        (
            Parameter("radius_m", 60.0, 200.0, (90.0, 200.0), "of the bend"),
            Parameter("lateral_mps2", 2.0, 5.0, (4.3, 4.9), "of the ego in the bend: its speed, within 14 to 28 m/s"),
            Parameter("lane_m", 2.75, 3.75, (2.75, 3.0), "width of a lane"),
            Parameter("aside_m", -0.5, 0.6, (0.2, 0.5), "how far the car stands to its right"),
            Parameter("jam", 1.0, 4.0, (1.0, 4.0), "cars before it", True),
        ),
        stalled_after_curve,
        waits=False,
    ),
    "cut_in_merge": EncounterType(
        "A car comes off the ramp, before a lorry, and on into the ego's lane.",
        (
            Parameter("conflict_mps", 20.0, 33.0, (20.0, 26.0), "speed of the merging car"),
            Parameter("faster_mps", 3.0, 12.0, (5.0, 12.0), "how much faster the ego is"),
            Parameter("truck_mps", 18.0, 25.0, (20.0, 24.0), "speed of the lorry"),
            Parameter("truck_m", 8.6, 16.5, (10.0, 16.5), "length of the lorry"),
            Parameter("lorries", 1.0, 4.0, (3.0, 4.0), "lorries in the column", True),
            Parameter("following_m", 8.0, 40.0, (9.0, 14.0), "between them"),
            Parameter("gap_m", 3.0, 20.0, (4.0, 9.0), "from the lorry's front to the car's rear at the crash"),
            Parameter("offset_m", -0.4, 0.4, (0.0, 0.4), "how far the lorry keeps to its left"),
            Parameter("crossing_s", 3.0, 8.0, (4.0, 5.5), "how long the car takes across two lanes"),
        ),
        cut_in_merge,
    ),
}
