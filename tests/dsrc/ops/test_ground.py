"""The surface of the ground: slopes and dips stay, what stands on it does not lift it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.ops.ground import fit_ground


def sweep(rng: np.random.Generator, slope: float = 0.0) -> NDArray:
    """Points of a road with a slope along x."""
    xy = rng.uniform(-60, 60, (60000, 2))
    return np.column_stack([xy, slope * xy[:, 0] - 1.8 + rng.normal(0, 0.02, len(xy))])


@pytest.mark.parametrize("slope", [0.0, 0.05, -0.1])
def test_a_slope_is_ground(slope: float) -> None:
    rng = np.random.default_rng(0)
    ground = fit_ground(sweep(rng, slope=slope))
    places = rng.uniform(-50, 50, (500, 2))
    # The lowest twentieth of a cell of 2 m lies at most a metre down the slope.
    assert np.abs(ground.at(places) - (slope * places[:, 0] - 1.8)).max() < 0.06 + abs(slope)
    assert ground.knows(places).all()


def test_cars_and_a_roof_do_not_lift_the_ground() -> None:
    rng = np.random.default_rng(1)
    road = sweep(rng)
    on_car = (np.abs(road[:, 0] - 10) < 2.2) & (np.abs(road[:, 1] - 5) < 0.9)
    roof = np.column_stack([rng.uniform(7.8, 12.2, 800), rng.uniform(4.1, 5.9, 800), rng.uniform(-0.9, -0.3, 800)])
    ground = fit_ground(np.concatenate([road[~on_car], roof]))
    assert np.abs(ground.at(np.array([[10.0, 5.0], [8.0, 5.0]])) + 1.8).max() < 0.15


def test_a_dip_is_followed() -> None:
    rng = np.random.default_rng(2)
    points = sweep(rng)
    points[:, 2] -= 1.0 * np.exp(-((points[:, 0] - 20) ** 2) / 200)
    at = fit_ground(points).at(np.array([[20.0, 0.0], [-30.0, 0.0]]))
    assert at == pytest.approx([-2.8, -1.8], abs=0.12)


def test_holes_take_the_nearest_height_and_are_not_known() -> None:
    rng = np.random.default_rng(3)
    points = sweep(rng, slope=0.02)
    points = points[points[:, 0] < 0]
    ground = fit_ground(points)
    far = np.array([[40.0, 0.0]])
    assert not ground.knows(far)
    assert ground.at(far) == pytest.approx(-1.8, abs=0.2)


def test_the_order_of_the_points_does_not_matter() -> None:
    points = sweep(np.random.default_rng(4))
    assert np.array_equal(fit_ground(points).heights, fit_ground(points[::-1]).heights)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((10, 3), np.nan), np.full((3, 3), 1e6)])
def test_no_ground_is_flat(points: NDArray) -> None:
    ground = fit_ground(points)
    assert not ground.heights.any() and not ground.known.any()
