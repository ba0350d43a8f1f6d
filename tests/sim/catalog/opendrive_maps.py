"""OpenDRIVE maps of many kinds, written by scenariogeneration."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

xodr: Any = pytest.importorskip("scenariogeneration.xodr")


def saved(folder: Path, name: str, *roads: Any, junctions: tuple[Any, ...] = ()) -> Path:
    """Write a map of roads, each with its own place, and return its path."""
    drive = xodr.OpenDrive(name)
    for road in roads:
        drive.add_road(road)
    for junction in junctions:
        drive.add_junction_creator(junction)
    drive.adjust_roads_and_lanes()
    path = folder / f"{name}.xodr"
    drive.write_xml(str(path))
    return path


def road(geometry: Any, number: int = 1, left: int = 1, right: int = 1, width_m: float = 3.5) -> Any:
    return xodr.create_road(geometry, number, left_lanes=left, right_lanes=right, lane_width=width_m)


def straight(folder: Path) -> Path:
    return saved(folder, "straight", road(xodr.Line(500)))


def curve(folder: Path) -> Path:
    return saved(folder, "curve", road([xodr.Line(120), xodr.Spiral(1e-9, 0.01, 60), xodr.Arc(0.01, length=150)]))


def crest(folder: Path) -> Path:
    """A hill of 8 m, half a sine wave by two cubics."""
    hill = road(xodr.Line(400))
    hill.add_elevation(0, 0, 0, 3 * 8 / 200**2, -2 * 8 / 200**3)
    hill.add_elevation(200, 8, 0, -3 * 8 / 200**2, 2 * 8 / 200**3)
    return saved(folder, "crest", hill)


def multi_lane(folder: Path) -> Path:
    return saved(folder, "multi_lane", road(xodr.Line(500), left=3, right=3))


def one_way(folder: Path) -> Path:
    return saved(folder, "one_way", road(xodr.Line(500), left=0, right=2))


def motorway(folder: Path) -> Path:
    fast = road(xodr.Line(1500), left=3, right=3, width_m=3.75)
    fast.add_type(xodr.RoadType.motorway, 0, speed=130, speed_unit="km/h")
    return saved(folder, "motorway", fast)


def two_plus_one(folder: Path) -> Path:
    lanes = [xodr.LaneDef(150, 250, 1, 2, 1), xodr.LaneDef(350, 420, 2, 1, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it links the widening lane twice, and says so
        return saved(folder, "two_plus_one", xodr.create_road(xodr.Line(600), 1, 1, lanes, lane_width=3.5))


def left_hand(folder: Path) -> Path:
    """Two lanes along the road, one against it: with the rule LHT the two lie on its left."""
    one = road(xodr.Line(500), left=2, right=1)
    one.rule = xodr.TrafficRule.LHT
    return saved(folder, "left_hand", one)


def junction(folder: Path, arms: int = 4, name: str = "crossing") -> Path:
    roads = [road(xodr.Line(150), number) for number in range(arms)]
    middle = xodr.CommonJunctionCreator(100, "middle")
    for number, one in enumerate(roads):
        middle.add_incoming_road_circular_geometry(one, 20, 0.5 * math.pi * number, "predecessor")
    for number in range(arms):
        for other in range(number):
            middle.add_connection(other, number)
    return saved(folder, name, *roads, junctions=(middle,))


def tee(folder: Path) -> Path:
    return junction(folder, 3, "tee")


def left_hand_crossing(folder: Path) -> Path:
    return _left_handed(junction(folder, name="left_hand_crossing"))


def left_hand_roundabout(folder: Path) -> Path:
    """It is driven clockwise."""
    return _left_handed(roundabout(folder, name="left_hand_roundabout"))


def _left_handed(path: Path) -> Path:
    text = path.read_text()
    assert 'rule="RHT"' in text
    path.write_text(text.replace('rule="RHT"', 'rule="LHT"'))
    return path


def merge(folder: Path) -> Path:
    """A motorway of two lanes, one way, whose right lane a ramp joins."""
    before, after = road(xodr.Line(500), 0, 0, 2), road(xodr.Line(500), 1, 0, 2)
    joining = road(xodr.Line(150), 2, 0, 1)
    mouth = xodr.CommonJunctionCreator(100, "mouth")
    mouth.add_incoming_road_cartesian_geometry(before, 0, 0, 0, "successor")
    mouth.add_incoming_road_cartesian_geometry(after, 80, 0, math.pi, "predecessor")
    mouth.add_incoming_road_cartesian_geometry(joining, 0, -12, 0.1, "successor")
    mouth.add_connection(0, 1)
    mouth.add_connection(2, 1, -1, -2)
    return saved(folder, "merge", before, after, joining, junctions=(mouth,))


def town(folder: Path, side: int = 3, block_m: float = 80.0, mouth_m: float = 12.0) -> Path:
    """A closed town: blocks of streets between junctions, with no way in or out."""
    places = [(column, row) for column in range(side) for row in range(side)]
    junctions = {
        place: xodr.CommonJunctionCreator(1000 + k, f"{place}", startnum=10_000 + 1000 * k)
        for k, place in enumerate(places)
    }
    streets: list[Any] = []
    meeting: dict[tuple[int, int], list[int]] = {place: [] for place in places}
    for column, row in places:
        for other, heading in (((column + 1, row), 0.0), ((column, row + 1), 0.5 * math.pi)):
            if other in junctions:
                street = road(xodr.Line(block_m - 2.0 * mouth_m), len(streets))
                streets.append(street)
                for place, angle, end in (
                    ((column, row), heading, "predecessor"),
                    (other, heading + math.pi, "successor"),
                ):
                    junctions[place].add_incoming_road_circular_geometry(street, mouth_m, angle, end)
                    meeting[place].append(street.id)
    for place, names in meeting.items():
        for k, name in enumerate(names):
            for other in names[:k]:
                junctions[place].add_connection(other, name)
    return saved(folder, "town", *streets, junctions=tuple(junctions.values()))


def ramp(folder: Path) -> Path:
    """A motorway of two lanes, one way, with an exit from its right lane."""
    before, after = road(xodr.Line(400), 0, 0, 2), road(xodr.Line(400), 1, 0, 2)
    leaving = road([xodr.Spiral(1e-9, -0.01, 60), xodr.Arc(-0.01, length=80)], 2, 0, 1)
    fork = xodr.CommonJunctionCreator(100, "fork")
    fork.add_incoming_road_cartesian_geometry(before, 0, 0, 0, "successor")
    fork.add_incoming_road_cartesian_geometry(after, 60, 0, math.pi, "predecessor")
    fork.add_incoming_road_cartesian_geometry(leaving, 60, -8, math.pi - 0.1, "predecessor")
    fork.add_connection(0, 1)
    fork.add_connection(0, 2, -2, -1)
    return saved(folder, "ramp", before, after, leaving, junctions=(fork,))


def roundabout(folder: Path, name: str = "roundabout", radius_m: float = 25.0, half_rad: float = 0.35) -> Path:
    """Four arms on a ring that is driven counter-clockwise; its junctions take up `2 * half_rad` of it each."""
    ring = [road(xodr.Arc(1 / radius_m, angle=0.5 * math.pi - 2 * half_rad), number, 0, 1) for number in range(4)]
    arms = [road(xodr.Line(150), 10 + number) for number in range(4)]
    x, y = radius_m * math.sin(half_rad), radius_m * (1.0 - math.cos(half_rad))
    junctions = []
    for number in range(4):
        before, arm = (number - 1) % 4, 10 + number
        one = xodr.CommonJunctionCreator(100 + number, f"junction {number}", startnum=1000 + 100 * number)
        one.add_incoming_road_cartesian_geometry(ring[before], -x, y, -half_rad, "successor")
        one.add_incoming_road_cartesian_geometry(ring[number], x, y, math.pi + half_rad, "predecessor")
        one.add_incoming_road_cartesian_geometry(arms[number], 0, -15, 0.5 * math.pi, "predecessor")
        one.add_connection(before, number)
        one.add_connection(before, arm, -1, -1)
        one.add_connection(arm, number, 1, -1)
        junctions.append(one)
    return saved(folder, name, *ring, *arms, junctions=tuple(junctions))


def ring(folder: Path) -> Path:
    return saved(folder, "ring", _linked_to_itself(road(xodr.Arc(0.02, angle=2 * math.pi))))


def _linked_to_itself(one: Any) -> Any:
    one.add_successor(xodr.ElementType.road, 1, xodr.ContactPoint.start)
    one.add_predecessor(xodr.ElementType.road, 1, xodr.ContactPoint.end)
    one.planview.set_start_point(0, 0, 0)
    return one


def parallel(folder: Path) -> Path:
    """Two roads that never meet."""
    one, other = road(xodr.Line(400), 1), road(xodr.Line(400), 2)
    one.planview.set_start_point(0, 0, 0)
    other.planview.set_start_point(0, 40, 0)
    return saved(folder, "parallel", one, other)


def with_things(folder: Path) -> Path:
    """A straight road along x with a house, a tree, a pole, a lamp and a guard rail."""
    one = road(xodr.Line(400))
    house = xodr.Object(200, 25, xodr.ObjectType.building, id="1", length=16, width=10, height=9)
    tree = xodr.Object(150, -9, xodr.ObjectType.tree, id="2", radius=1, height=6)
    pole = xodr.Object(170, -9, xodr.ObjectType.pole, id="3", radius=0.1, height=6)
    lamp = xodr.Object(190, -9, xodr.ObjectType.streetLamp, id="4", radius=0.1, height=6)
    rail = xodr.Object(100, 6, xodr.ObjectType.barrier, id="5", name="guardRail", height=0.8)
    rail.repeat(100, 0, sStart=100, tStart=6, tEnd=6, heightStart=0.8, heightEnd=0.8, zOffsetStart=0, zOffsetEnd=0)
    for thing in (house, tree, pole, lamp, rail):
        one.add_object(thing)
    return saved(folder, "things", one)


KINDS: dict[str, Callable[[Path], Path]] = {
    kind.__name__: kind
    for kind in (
        straight, curve, crest, multi_lane, one_way, motorway, two_plus_one, left_hand, junction, tee, ramp, roundabout,
        ring, parallel, with_things, left_hand_crossing, left_hand_roundabout, merge, town,
    )
}  # fmt: skip
"""Maps by kind."""
