"""Right of way on highway-env's roads: who waits at a junction, and for whom no longer."""

from itertools import pairwise

import numpy as np
import pytest
from highway_env.road.road import Road

from sim.bodies.vehicle_types import types_of
from sim.traffic.highway.driver import Driver
from sim.traffic.highway.perception import Junction, decide
from sim.traffic.highway.roads import read_roads

ROADS = read_roads("intersection-v0")
NUMBER = {lane.name: number for number, lane in enumerate(ROADS.lanes)}


def at_the_line(number: int, lane: str, goal: str) -> Driver:
    """A car that is about to enter the junction."""
    start = NUMBER[lane]
    road = Road(network=ROADS.network, np_random=np.random.default_rng(0))
    driver = Driver(road, ROADS, start, ROADS.lanes[start].along[-1] - 5.0, types_of("car")[0], number, 1.0)
    assert driver.send_to(NUMBER[goal])
    return driver


def waits(junction: Junction, first: Driver, second: Driver, lane: str) -> list[bool]:
    """Place the first car along a lane, 30 m at most; return whether the second waits at each place."""
    found = []
    for before, now in pairwise(ROADS.lanes[NUMBER[lane]].line[:30]):
        first.put(now, float(np.arctan2(*(now - before)[::-1])), 5.0)
        found.append(bool(np.isfinite(junction.stops([first, second])[1])))
    return found


@pytest.mark.parametrize(
    ("turn", "onward", "crosses"), [("ir1-il0_0", "il0-o0_0", False), ("ir1-il2_0", "il2-o2_0", True)]
)
def test_who_turns_off_otherwise_than_it_was_to_holds_up_those_who_cross_the_way_it_takes(
    turn: str, onward: str, crosses: bool
) -> None:
    junction = Junction(ROADS)
    first, second = at_the_line(0, "o1-ir1_0", "il3-o3_0"), at_the_line(1, "o0-ir0_0", "il2-o2_0")
    assert np.isinf(junction.stops([first, second])).tolist() == [True, False]
    assert waits(junction, first, second, turn)[-1] == crosses
    assert not waits(junction, first, second, onward)[-1]


def test_who_is_placed_off_the_lanes_holds_up_nobody() -> None:
    junction = Junction(ROADS)
    first, second = at_the_line(0, "o1-ir1_0", "il3-o3_0"), at_the_line(1, "o0-ir0_0", "il2-o2_0")
    assert np.isinf(junction.stops([first, second])).tolist() == [True, False]
    first.put(np.array([60.0, 60.0]), 0.0, 0.0)
    assert np.isinf(junction.stops([first, second])).all()


@pytest.mark.parametrize(("speed", "committed"), [(6.0, False), (10.0, True)])
def test_who_can_stop_before_a_roundabout_only_by_more_than_5_mps2_goes_first(speed: float, committed: bool) -> None:
    """9 m before the circle 6 m/s need 2 m/s2 and 10 m/s need 5.6; the car in the circle comes at 6 m/s."""
    roads = read_roads("roundabout-v0")
    lanes = {lane.name: number for number, lane in enumerate(roads.lanes)}
    cars = []
    for number, (lane, along, mps) in enumerate((("ses-se_0", 6.0, speed), ("sx-se_0", 8.0, 6.0))):
        road = Road(network=roads.network, np_random=np.random.default_rng(0))
        cars.append(Driver(road, roads, lanes[lane], along, types_of("car")[0], number, 1.0))
        cars[-1].speed = mps
        assert cars[-1].send_to(lanes["nxs-nxr_0"])
    decide(cars, 0.1, Junction(roads))
    entering, circling = (car.planned_mps2 for car in cars)
    assert entering > (-3.0 if committed else -np.inf)
    assert (circling < -2.0) == committed
