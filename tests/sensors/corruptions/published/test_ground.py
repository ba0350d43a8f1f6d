"""Ground and noise level as published."""

import numpy as np
import pytest

from sensors.corruptions.published.ground import (
    FALLBACK,
    Plane,
    fit_plane,
    ground_of,
    intensity_line,
    labelled_ground,
    noise_floor,
    noise_line,
)
from tests.sensors.corruptions.published.goldens import arrays, cloud, table

CLOUDS = ("synth16", "synth64", "synth64_carla_intensity")


def on_255(name: str) -> np.ndarray:
    points = cloud(name.split("_")[0]).astype(np.float64)
    if "carla" in name:
        points[:, 3] = np.exp(-0.004 * np.linalg.norm(points[:, :3], axis=1))
    points[:, 3] *= 255.0
    return points


def golden_plane(name: str) -> Plane:
    golden = table("snow_ground")[name]
    return Plane(np.array(golden["w"]), golden["h"])


@pytest.mark.parametrize("name", CLOUDS)
def test_a_legacy_generator_finds_the_published_plane(name: str) -> None:
    plane, golden = fit_plane(on_255(name), np.random.RandomState(0)), golden_plane(name)
    assert np.allclose(plane.normal, golden.normal, atol=1e-12)
    assert np.isclose(plane.offset, golden.offset, atol=1e-12)


@pytest.mark.parametrize("name", CLOUDS)
def test_ground_and_noise_floor_are_the_published_ones(name: str) -> None:
    points, golden = on_255(name), table("snow_ground")[name]
    ground = ground_of(points, golden_plane(name))
    intensity = points[ground.rows, 3]
    line = noise_line(ground, intensity)
    assert ground.rows.sum() == golden["n_ground"]
    assert np.allclose(intensity_line(ground, intensity), golden["ground_linear_fit"], rtol=1e-6)
    assert line is not None
    floor = noise_floor(ground, line, 0.7)
    assert np.allclose(floor, golden["threshold_poly"], rtol=1e-4)
    at = np.polyval(floor, [5.0, 10.0, 20.0, 40.0, 60.0, 80.0])
    assert np.allclose(at, golden["threshold_at_5_10_20_40_60_80"], atol=2e-3)
    below = np.round(points[:, 3]) <= np.polyval(golden["threshold_poly"], np.linalg.norm(points[:, :3], axis=1))
    assert abs(below.sum() - golden["n_below_threshold"]) <= 0.001 * golden["n_below_threshold"]


def test_incidence_is_the_published_one() -> None:
    golden = arrays("wet_ground")
    ground = ground_of(cloud("synth16"), Plane(golden["plane"][:3], golden["plane"][3]))
    assert np.allclose(np.arccos(ground.cosine), golden["incidence"], atol=1e-7)
    line = noise_line(ground, np.round(255.0 * cloud("synth16")[ground.rows, 3].astype(np.float64)))
    assert line is not None
    assert np.allclose(0.7 * np.polyval(line, ground.range_m), golden["adaptive_threshold"], atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_any_generator_finds_a_tilted_road_among_clutter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(5, 80, 4000), rng.uniform(-10, 10, 4000)
    road = np.column_stack([x, y, -1.75 + 0.004 * y + rng.normal(0, 0.01, 4000)])
    clutter = np.column_stack([rng.uniform(5, 80, 2000), rng.uniform(-10, 10, 2000), rng.uniform(-2.5, 2, 2000)])
    plane = fit_plane(np.concatenate([road, clutter]), rng)
    assert np.allclose(plane.normal, [0.0, 0.004, -1.0], atol=2e-3)
    assert ground_of(road, plane).rows.all()


def test_without_a_road_the_plane_is_above_the_sensor() -> None:
    points = on_255("synth64")
    plane = fit_plane(points - [0, 0, 3.0, 0], np.random.default_rng(1))
    assert plane is FALLBACK
    golden = table("snow_ground")["synth64"]
    seen = points[ground_of(points, plane).rows, 2]
    assert len(seen) == golden["fallback_plane_n_points"]
    assert np.isclose(seen.mean(), golden["fallback_plane_z_mean"], rtol=1e-5)


def test_labelled_ground_lies_level() -> None:
    points = np.array([[3.0, 0.0, -4.0, 0.1], [0.0, 0.0, 0.0, 0.1], [1.0, 1.0, 1.0, 0.1]])
    ground = labelled_ground(points, np.array([True, True, False]))
    assert np.allclose(ground.range_m, [5.0, 0.0]) and np.allclose(ground.cosine, [0.8, 1.0])


def test_little_ground_has_no_lines() -> None:
    for points in (np.zeros((0, 4)), np.array([[10.0, 0, -1.8, 9.0]]), np.tile([10.0, 0, -1.8, 9.0], (50, 1))):
        ground = ground_of(points, Plane(np.array([0.0, 0.0, -1.0]), -1.8))
        assert ground.rows.sum() == len(points)
        assert noise_line(ground, points[:, 3]) is None
        assert (intensity_line(ground, points[:, 3]) == 0).all()
