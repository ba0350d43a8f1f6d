"""Times to collision of oriented boxes."""

import math

import numpy as np
import pytest

from dsrc.closed_loop.metrics import time_to_collision
from sim.boxes import Boxes

EGO = Boxes.from_array([[0.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])


def test_a_car_that_closes_in_hits_when_the_bumpers_meet() -> None:
    other = Boxes.from_array([[24.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
    ttc = time_to_collision(EGO, np.array([10.0, 0.0]), other, np.zeros((1, 2)))
    assert ttc == pytest.approx(2.0, abs=0.11)


def test_a_crossing_car_hits_although_its_lane_is_another() -> None:
    other = Boxes.from_array([[20.0, -20.0, 0.8, 4.0, 2.0, 1.6, np.pi / 2]])
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.array([[0.0, 10.0]])) < 2.1
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.array([[0.0, 2.0]])) == math.inf


def test_cars_that_part_never_meet() -> None:
    other = Boxes.from_array([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
    assert time_to_collision(EGO, np.zeros(2), other, np.array([[5.0, 0.0]])) == math.inf
    assert time_to_collision(EGO, np.zeros(2), Boxes.zeros(), np.zeros((0, 2))) == math.inf


def test_the_traffic_on_a_bridge_is_not_in_the_way_and_a_car_up_the_hill_is() -> None:
    for height, slows in ((6.8, False), (0.8, True)):
        crossing = Boxes.from_array([[20.0, -20.0, height, 4.0, 2.0, 1.6, np.pi / 2]])
        ttc = time_to_collision(EGO, np.array([10.0, 0.0]), crossing, np.array([[0.0, 10.0]]))
        assert math.isfinite(ttc) == slows
    uphill = Boxes.from_array([[40.0, 0.0, 3.2, 4.0, 2.0, 1.6, 0.0]])
    assert time_to_collision(EGO, np.array([10.0, 0.0]), uphill, np.zeros((1, 2))) == pytest.approx(3.6, abs=0.11)
