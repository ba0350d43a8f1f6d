"""Bends are round, ends stay where they are, and nobody is asked to turn faster than a car can."""

import re

import numpy as np
import pytest
import shapely

from sim.roads.kerbside import ROOM_M, with_room_to_park
from sim.roads.rounding import TURN_RADPS, line_of, rounded, rounded_network

CORNER = np.array([[0.0, 0.0, 1.0], [40.0, 0.0, 2.0], [40.0, 40.0, 3.0]])


def test_a_corner_becomes_a_bend_that_stays_near_it() -> None:
    line = rounded(CORNER)
    assert np.array_equal(line[[0, -1]], CORNER[[0, -1]])
    way = np.diff(line[:, :2], axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(way[:, 1], way[:, 0]))))
    assert turn.max() < np.radians(30.0) and turn.sum() == pytest.approx(np.pi / 2)
    assert shapely.LineString(line).hausdorff_distance(shapely.LineString(CORNER)) < 2.6
    assert (np.diff(line[:, 2]) >= 0.0).all()


def test_a_straight_line_stays_straight() -> None:
    line = rounded(np.array([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]]))
    assert np.abs(line[:, 1]).max() == 0.0


def lane(name: str, shape: str, speed: float, length: float, more: str = "") -> str:
    return f'<lane id="{name}" index="0" {more}speed="{speed}" length="{length}" shape="{shape}"/>'


def test_a_turn_in_a_junction_is_driven_no_faster_than_a_car_can_turn() -> None:
    angle = np.linspace(0.0, np.pi / 2, 21)
    arc = " ".join(f"{40 + 4 * np.sin(a):.3f},{4 - 4 * np.cos(a):.3f}" for a in angle)
    text = "".join(
        [
            lane("in_0", "0,0 40,0", 13.9, 40.0),
            lane(":j_0_0", arc, 13.9, 6.3),
            lane("out_0", "44,4 44,60", 13.9, 56.0),
            '<connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="l"/>',
        ]
    )
    speed = {name: float(v) for name, v in re.findall(r'id="([^"]+)"[^>]* speed="([^"]+)"', rounded_network(text))}
    assert speed[":j_0_0"] == pytest.approx(TURN_RADPS * 4.0, rel=0.15)
    assert speed["in_0"] == speed["out_0"] == 13.9


STREET = lane("s_0", "0,-2.6 100,-2.6", 13.9, 100.0, 'allow="pedestrian" width="2.00" ') + lane(
    "s_1", "0,0 100,0", 13.9, 100.0, 'disallow="pedestrian" '
)


def test_a_footway_makes_room_for_parked_cars_but_not_at_its_ends_nor_towards_a_house() -> None:
    shape = re.search(r'id="s_0".*? shape="([^"]+)"', with_room_to_park(STREET, []))
    assert shape is not None
    line = line_of(shape[1])
    assert line[[0, -1]].tolist() == [[0.0, -2.6], [100.0, -2.6]]
    assert line[:, 1].min() == pytest.approx(-2.6 - ROOM_M)
    assert with_room_to_park(STREET, [shapely.box(40.0, -9.0, 60.0, -4.5)]) == STREET
    cycle = STREET.replace('disallow="pedestrian"', 'allow="bicycle"')
    assert with_room_to_park(cycle, []) == cycle
