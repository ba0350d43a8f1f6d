"""The path ahead of the ego."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.path import STEP_M, path_of


def test_stations_are_equal_steps_from_the_ego_on() -> None:
    path = path_of(np.array([[1.0, 2.0], [31.0, 2.0]]), 0.0, 5.0)
    assert path.xy[0] == pytest.approx([1.0, 2.0])
    assert np.diff(path.xy[:, 0]) == pytest.approx(STEP_M)
    assert path.heading == pytest.approx(0.0)
    assert path.bend_mps.min() > 100.0


def test_a_bend_bounds_the_speed_by_its_radius() -> None:
    angle = np.linspace(0.0, 1.5, 100)
    path = path_of(20.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]), 0.0, 5.0)
    assert np.median(path.bend_mps) == pytest.approx(10.0, rel=0.03)


def test_a_jump_to_the_next_lane_becomes_a_lane_change() -> None:
    route = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 3.2], [120.0, 3.2]])
    path = path_of(route, 0.0, 5.0)
    assert np.abs(path.heading).max() < 0.25
    assert path.xy[-1] == pytest.approx([120.0, 3.2], abs=0.6)
    assert path.bend_mps.min() > 10.0


def test_a_corner_of_a_street_stays_a_corner() -> None:
    path = path_of(np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0]]), 0.0, 5.0)
    assert path.heading[-1] == pytest.approx(0.5 * np.pi, abs=0.01)


def test_the_body_turns_into_its_route() -> None:
    path = path_of(np.array([[0.0, 0.0], [50.0, 0.0]]), 0.3, 5.0)
    assert path.heading[0] == pytest.approx(0.3)
    assert path.heading[-1] == pytest.approx(0.0, abs=1e-3)
    assert path.bend_mps.min() > 100.0


@pytest.mark.parametrize("route", [np.zeros((1, 2)), np.zeros((2, 2)), np.array([[0.0, 0.0], [0.1, 0.0]])])
def test_the_shortest_routes_have_a_path(route: np.ndarray) -> None:
    path = path_of(route, 0.0, 5.0)
    assert len(path) >= 2
    assert np.isfinite(path.heading).all()


def test_beside_its_lane_the_ego_returns_to_it_without_a_bend() -> None:
    path = path_of(np.array([[0.0, 0.9], [2.4, 0.0], [40.0, 0.0], [80.0, 0.0]]), 0.0, 5.0)
    assert path.xy[0] == pytest.approx([0.0, 0.9])
    assert path.xy[-1, 1] == pytest.approx(0.0)
    assert np.abs(path.heading).max() < 0.1
    assert path.bend_mps.min() > 25.0
