"""The ego's state: boxes on the ego itself are nobody else."""

import numpy as np
import pytest

from dsrc.closed_loop.ego import without_ego
from dsrc.closed_loop.types import EgoState, Percept
from sim.boxes import Boxes
from sim.traffic.base import Limits


def percept_at(*places: tuple[float, float]) -> Percept:
    rows = [[x, y, 0.8, 4.4, 1.8, 1.5, 0.4] for x, y in places]
    return Percept(2.0, Boxes.from_array(rows), np.full(len(rows), 0.5), np.full((len(rows), 2), np.nan))


def ego_at(x: float, y: float, yaw: float) -> EgoState:
    box = Boxes.from_array([[x, y, 0.8, 4.5, 1.8, 1.5, yaw]])
    return EgoState(2.0, box, 5.0, 0.0, np.array([[x, y], [x + 10.0, y]]), Limits(10.0, 2.0, 7.5), (), 0.0)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0, np.pi])
def test_a_box_on_the_ego_goes_and_a_neighbour_stays(yaw: float) -> None:
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    ego = np.array([100.0, -40.0])
    places = [ego + 1.5 * ahead, ego + 0.4 * left, ego + 2.6 * left, ego + 5.0 * ahead, ego - 5.0 * ahead]
    found = without_ego(percept_at(*map(tuple, places)), ego_at(*ego, yaw))
    assert np.allclose(found.boxes.center[:, :2], places[2:])
    assert len(found.score) == len(found.velocity) == 3


def test_without_a_box_on_the_ego_nothing_changes() -> None:
    percept = percept_at((10.0, 0.0))
    assert without_ego(percept, ego_at(0.0, 0.0, 0.0)) is percept
