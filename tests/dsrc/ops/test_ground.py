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


def test_a_flat_world_is_left_as_it_is_within_its_noise() -> None:
    rng = np.random.default_rng(5)
    for noise in (0.02, 0.08):
        xy = rng.uniform(-60, 60, (60000, 2))
        points = np.column_stack([xy, rng.normal(-1.9, noise, len(xy))])
        at = fit_ground(points).at(rng.uniform(-50, 50, (500, 2)))
        assert abs(np.median(at) + 1.9) < 0.5 * noise and np.ptp(at) < noise


def test_a_lorry_is_not_swallowed() -> None:
    # 16 m long, 2.5 m wide, on a road of 4 %; no ray reaches the ground below it, nor 4 m of it behind it.
    rng = np.random.default_rng(6)
    road = sweep(rng, slope=0.04)
    hidden = (np.abs(road[:, 0] - 12) < 8) & (road[:, 1] > 3) & (road[:, 1] < 9.5)
    x, z = rng.uniform(4, 20, 6000), rng.uniform(0.5, 3.6, 6000)
    side = np.column_stack([x, np.full(6000, 3.0), 0.04 * x - 1.8 + z])
    top = np.column_stack([rng.uniform(4, 20, 4000), rng.uniform(3, 5.5, 4000), np.full(4000, 2.2)])
    ground = fit_ground(np.concatenate([road[~hidden], side, top]))
    below = np.column_stack([np.linspace(5, 19, 8), np.full(8, 4.25)])
    assert np.abs(ground.at(below) - (0.04 * below[:, 0] - 1.8)).max() < 0.2


def test_under_a_bridge_the_road_is_ground_and_on_its_deck_the_deck() -> None:
    rng = np.random.default_rng(7)
    road = sweep(rng)
    deck = np.column_stack([rng.uniform(15, 25, 4000), rng.uniform(-30, 30, 4000), np.full(4000, 3.2)])
    under = fit_ground(np.concatenate([road, deck]))
    assert under.at(np.array([[20.0, 0.0], [20.0, 15.0]])) == pytest.approx([-1.8, -1.8], abs=0.1)
    # On a bridge: the deck, 20 m wide, and a valley 6 m below, seen beside it from 6 m on.
    x, y = rng.uniform(-60, 60, (2, 60000))
    z = np.where(np.abs(y) < 10, -1.8, -7.8) + rng.normal(0, 0.02, 60000)
    seen = (np.abs(y) < 10) | (np.abs(y) > 16)
    over = fit_ground(np.column_stack([x, y, z])[seen])
    assert over.at(np.array([[0.0, 0.0], [20.0, 3.0], [-40.0, -3.0]])) == pytest.approx([-1.8] * 3, abs=0.15)


def test_a_road_on_an_embankment_and_the_field_beside_it_are_both_ground() -> None:
    rng = np.random.default_rng(8)
    x, y = rng.uniform(-60, 60, (2, 80000))
    # A dam of 3 m with banks of 1 in 1.5.
    z = -1.8 - np.clip((np.abs(y) - 8.0) / 1.5, 0.0, 3.0) + rng.normal(0, 0.03, len(y))
    at = fit_ground(np.column_stack([x, y, z])).at(np.array([[0.0, 0.0], [30.0, 2.0], [0.0, 25.0], [20.0, -30.0]]))
    assert at == pytest.approx([-1.8, -1.8, -4.8, -4.8], abs=0.2)


def test_reflections_below_the_ground_do_not_pull_it_down() -> None:
    rng = np.random.default_rng(9)
    points = sweep(rng)
    ghost = np.column_stack([rng.uniform(20, 22, (40, 2)), rng.uniform(-8, -3, 40)])
    assert fit_ground(np.concatenate([points, ghost])).at(np.array([[21.0, 21.0]])) == pytest.approx(-1.8, abs=0.1)
