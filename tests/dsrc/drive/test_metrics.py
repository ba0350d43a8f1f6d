"""Collisions and times to collision of oriented boxes."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from dsrc.drive.metrics import overlap, time_to_collision
from sim.boxes import Boxes

EGO = Boxes.from_array([[0.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
number = st.floats(-6.0, 6.0)


@settings(deadline=None, max_examples=200)
@given(number, number, st.floats(-3.2, 3.2), st.floats(0.5, 9.0), st.floats(0.5, 3.0))
def test_overlap_agrees_with_shapely(x: float, y: float, yaw: float, length: float, width: float) -> None:
    other = Boxes.from_array([[x, y, 0.8, length, width, 1.6, yaw]])
    a, b = (shapely.Polygon(boxes.bev_polygons()[0]) for boxes in (EGO, other))
    if abs(shapely.intersection(a, b).area) > 1e-6 or a.distance(b) > 1e-6:
        assert overlap(EGO.bev_polygons(), other.bev_polygons())[0] == (a.intersection(b).area > 1e-6)


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
