"""Lanes that cross a path or merge into it."""

import gc
import weakref

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.driving.lanes import NetworkLanes, RouteLanes, lanes_of
from dsrc.closed_loop.driving.path import path_of
from dsrc.closed_loop.types import ConflictLane
from sim.catalog.load import load_scenario
from sim.encounters import network_file, with_encounter
from sim.geometry import Array
from sim.roads.networks import read_network

HALF = 1.75
"""Distance of the lanes' centres from the middle of the encounters' roads, m."""


def straight(start: tuple[float, float], end: tuple[float, float]) -> Array:
    """Return a path of 0.5 m steps."""
    count = round(2.0 * float(np.hypot(*np.subtract(end, start)))) + 1
    heading = np.arctan2(end[1] - start[1], end[0] - start[0])
    return np.column_stack([np.linspace(start, end, count), np.full(count, heading)])


def conflicts(path: Array, name: str = "ima_building", **parameters: float) -> tuple[ConflictLane, ...]:
    scenario = load_scenario(name)
    assert scenario.conflict is not None
    spec = msgspec.structs.replace(scenario.conflict, parameters=parameters)
    lanes = lanes_of(with_encounter(msgspec.structs.replace(scenario, conflict=spec), 0), 0)
    assert lanes is not None
    return lanes.conflicts(path)


EASTWARDS = straight((-60.0, -HALF), (40.0, -HALF))


def comes_from(lane: ConflictLane) -> str:
    x, y = lane.line[0, :2]
    return ("east" if x > 0 else "west") if abs(x) > abs(y) else ("north" if y > 0 else "south")


def test_straight_over_a_crossing_the_lanes_of_the_other_road_cross_and_turning_ones_merge() -> None:
    found = conflicts(EASTWARDS)
    assert {comes_from(lane) for lane in found} == {"north", "south", "east"}
    across = [lane for lane in found if abs(np.ptp(np.unwrap(lane.line[:, 2]))) < 0.1]
    assert sorted(comes_from(lane) for lane in across) == ["north", "south"]
    for lane in across:
        x, y, heading = lane.line[lane.meets]
        side = 1.0 if comes_from(lane) == "north" else -1.0
        assert [x, heading] == pytest.approx([-side * HALF, -side * 0.5 * np.pi], abs=0.1)
        assert abs(y + HALF) < 1.7
        assert set(lane.speed_mps.tolist()) == {13.89}


def test_a_line_leads_from_150_m_before_the_path_in_steps_of_a_metre() -> None:
    for lane in conflicts(EASTWARDS):
        step = np.hypot(*np.diff(lane.line[:, :2], axis=0).T)
        assert (step > 0.0).all() and (step < 1.11).all()
        assert lane.meets <= 150 and len(lane.line) == len(lane.speed_mps) > lane.meets
        assert np.abs(np.diff(lane.line[:, 2])).max() < 0.5


def test_lanes_that_it_is_on_that_leave_it_or_lie_beside_it_do_not_meet_a_path() -> None:
    assert conflicts(straight((-60.0, -HALF), (-20.0, -HALF))) == ()


def test_in_the_lane_of_those_who_come_towards_it_they_do() -> None:
    (lane,) = conflicts(straight((-60.0, HALF), (-30.0, HALF)))[:1]
    assert np.cos(lane.line[lane.meets, 2]) == pytest.approx(-1.0)


@pytest.mark.parametrize(("priority", "gives_way"), [(0, False), (1, True), (2, False)])
def test_who_crosses_a_road_of_priority_gives_way(priority: int, gives_way: bool) -> None:
    across = [lane for lane in conflicts(EASTWARDS, priority=priority) if np.ptp(lane.line[:, 2]) < 0.1]
    assert len(across) == 2
    assert [lane.gives_way for lane in across] == [gives_way] * 2
    assert not any(lane.signal for lane in across)


def test_where_there_are_lights_no_sign_holds() -> None:
    found = conflicts(EASTWARDS, "red_light_runner")
    assert found and all(lane.signal and not lane.gives_way for lane in found)


def test_a_route_without_a_map_tells_no_lanes() -> None:
    path = path_of(EASTWARDS[:, :2], 0.0, 4.9)
    assert RouteLanes(path).conflicts(EASTWARDS) == ()


def test_a_map_that_nobody_holds_any_more_is_freed() -> None:
    """A campaign drives hundreds of maps in one process."""
    scenario = with_encounter(load_scenario("ima_building"), 0)
    lanes = NetworkLanes(read_network(network_file(scenario, 0)))
    assert lanes.conflicts(EASTWARDS) and lanes.ahead(EASTWARDS[:1], np.array([50.0]))
    gone = weakref.ref(lanes)
    del lanes
    gc.collect()
    assert gone() is None
