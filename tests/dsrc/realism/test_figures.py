"""Figures of a sweep: known scenes have the figures that they were made with."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.realism.figures import FIGURES, figures_of
from sensors.sweep import Sweep, make_sweep
from sim.boxes import Boxes

NONE = Boxes.zeros()


def road(rng: np.random.Generator, slope: float = 0.0, noise_m: float = 0.01) -> NDArray[np.float64]:
    xy = rng.uniform(-50, 50, (30000, 2))
    return np.column_stack([xy, slope * xy[:, 0] - 1.8 + rng.normal(0, noise_m, len(xy))])


def sweep(*parts: NDArray[np.float64], intensity: float = 0.3) -> Sweep:
    points = np.concatenate(parts)
    return make_sweep(points, intensity=np.full(len(points), intensity))


def test_the_slope_of_a_plane() -> None:
    for slope in (0.0, 0.05):
        found = figures_of(sweep(road(np.random.default_rng(0), slope)), NONE)
        assert np.median(found["slope"]) == pytest.approx(slope, abs=0.01)


def test_noise_of_the_ground_is_its_residual() -> None:
    rng = np.random.default_rng(1)
    smooth, rough = (figures_of(sweep(road(rng, noise_m=noise)), NONE) for noise in (0.01, 0.05))
    assert smooth["residual"][0] < 0.02
    assert rough["residual"][0] > smooth["residual"][0] + 0.02
    assert np.median(rough["noise"]) > 2 * np.median(smooth["noise"])


def test_a_wall_stands_and_a_crown_is_leaf_like() -> None:
    rng = np.random.default_rng(2)
    ground = road(rng)
    wall = np.column_stack([rng.uniform(-20, 20, 8000), np.full(8000, 10.0), rng.uniform(-1.5, 3, 8000)])
    crown = np.column_stack([rng.normal(12, 1.5, 8000), rng.normal(-8, 1.5, 8000), rng.normal(2, 0.6, 8000)])
    bare, walled, leafy = (figures_of(sweep(ground, *more), NONE) for more in ((), (wall,), (crown,)))
    assert bare["standing_5"] == pytest.approx(0.0, abs=0.01)
    assert walled["standing_5"] > 0.3
    assert walled["scattered"] < 0.1
    assert leafy["scattered"] > 0.6


def test_vehicles_have_their_size_and_stand_on_the_ground() -> None:
    rng = np.random.default_rng(3)
    box = np.array([[15.0, 5.0, -1.0, 4.4, 1.8, 1.6, 0.3], [-20.0, 3.0, -1.0, 4.0, 1.7, 1.6, 0.0]])
    on_car = np.column_stack([rng.normal(15, 0.3, 50), rng.normal(5, 0.3, 50), rng.uniform(-1.5, -0.5, 50)])
    found = figures_of(sweep(road(rng), on_car), Boxes.from_array(box))
    # The ground touches both boxes; a box counts from five points on.
    assert sorted(found["length"]) == [4.0, 4.4]
    assert found["bottom"] == pytest.approx([0.0, 0.0], abs=0.05)


def test_road_users_do_not_count_as_roadside() -> None:
    rng = np.random.default_rng(4)
    person = np.column_stack([rng.normal(10, 0.1, 4000), rng.normal(2, 0.1, 4000), rng.uniform(-1.4, 0, 4000)])
    alone = figures_of(sweep(road(rng), person), NONE)
    known = figures_of(sweep(road(rng), person), Boxes.from_array([[10, 2, -0.9, 0.9, 0.9, 1.8, 0]], [6]))
    assert alone["standing_5"] > 0.2
    assert known["standing_5"] < 0.01
    assert "length" not in known


def test_intensities_are_those_of_their_class() -> None:
    rng = np.random.default_rng(5)
    ground = road(rng)
    wall = np.column_stack([rng.uniform(-20, 20, 3000), np.full(3000, 10.0), rng.uniform(-1.2, 3, 3000)])
    points = np.concatenate([ground, wall])
    found = figures_of(make_sweep(points, intensity=np.repeat([0.2, 0.7], [len(ground), len(wall)])), NONE)
    assert np.median(found["intensity_ground"]) == pytest.approx(0.2)
    assert np.median(found["intensity_standing"]) == pytest.approx(0.7)


def test_a_cloud_without_intensities_has_no_figure_of_them() -> None:
    ground = road(np.random.default_rng(6))
    assert not any("intensity" in name for name in figures_of(sweep(ground, intensity=0.2), NONE))


def test_beams_without_a_return_lower_their_share() -> None:
    azimuth = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    elevation = np.radians(np.linspace(2, -24, 32))
    both = np.stack(np.meshgrid(azimuth, elevation), axis=-1).reshape(-1, 2)
    ring = np.repeat(np.arange(32), 900)
    kept = (ring >= 4) | (both[:, 0] > 0)  # the four top beams see the sky on one side
    cos = np.cos(both[:, 1])
    points = 20 * np.column_stack([cos * np.cos(both[:, 0]), cos * np.sin(both[:, 0]), np.sin(both[:, 1])])[kept]
    for rings in (ring[kept], np.zeros(kept.sum(), int)):  # known, or found by their elevations
        found = figures_of(make_sweep(points, ring=rings), NONE)
        assert found["returns_0"] == pytest.approx(0.5, abs=0.01)
        assert found["returns_7"] == pytest.approx(1.0)


def test_an_empty_sweep_has_no_figures() -> None:
    assert figures_of(make_sweep(np.zeros((0, 3))), NONE) == {}


def test_names_are_unique_and_families_together() -> None:
    assert len({one.name for one in FIGURES}) == len(FIGURES)
    families = [one.family for one in FIGURES]
    assert sum(a != b for a, b in pairwise(families)) + 1 == len(set(families))
