"""A box is an obstacle when the ego would sweep over it, wherever its centre lies."""

import numpy as np
import pytest

from dsrc.closed_loop.corridor import nearest_obstacle
from sim.boxes import Boxes

STRAIGHT = np.array([[0.0, 0.0], [60.0, 0.0]])


def box(x: float, y: float, length: float = 4.0, width: float = 2.0, yaw: float = 0.0) -> Boxes:
    return Boxes.from_array([[x, y, 0.8, length, width, 1.6, yaw]])


def test_the_gap_is_bumper_to_bumper() -> None:
    obstacle = nearest_obstacle(STRAIGHT, box(20.0, 0.0), ego_length=5.0, ego_width=1.8)
    assert obstacle.row == 0
    assert obstacle.gap == pytest.approx(20.0 - 2.0 - 2.5)


def test_a_car_in_the_next_lane_is_none() -> None:
    assert nearest_obstacle(STRAIGHT, box(20.0, 3.5), 5.0, 1.8).row == -1


def test_a_truck_that_juts_into_the_lane_is_one() -> None:
    assert nearest_obstacle(STRAIGHT, box(20.0, 4.0, length=12.0, width=2.5, yaw=np.pi / 2), 5.0, 1.8).row == 0


def test_what_is_behind_or_beyond_the_path_is_none() -> None:
    assert nearest_obstacle(STRAIGHT, box(-10.0, 0.0), 5.0, 1.8).row == -1
    assert nearest_obstacle(STRAIGHT, box(70.0, 0.0), 5.0, 1.8).row == -1


def test_the_nearest_of_several_counts() -> None:
    boxes = Boxes.from_array([[40.0, 0, 0.8, 4, 2, 1.6, 0], [25.0, 0, 0.8, 4, 2, 1.6, 0]])
    assert nearest_obstacle(STRAIGHT, boxes, 5.0, 1.8).row == 1


def test_the_corridor_follows_a_bend() -> None:
    bend = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 30.0]])
    assert nearest_obstacle(bend, box(20.0, 20.0, yaw=np.pi / 2), 5.0, 1.8).row == 0
    assert nearest_obstacle(bend, box(35.0, 0.0), 5.0, 1.8).row == -1
    assert nearest_obstacle(bend, box(20.0, 20.0), 5.0, 1.8).heading == pytest.approx(np.pi / 2)


def test_no_boxes_is_a_free_road() -> None:
    assert nearest_obstacle(STRAIGHT, Boxes.zeros(), 5.0, 1.8).gap == np.inf
