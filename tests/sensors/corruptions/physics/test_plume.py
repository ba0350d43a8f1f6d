"""Plumes: place and extinction of a vehicle's spray."""

import itertools

import numpy as np
import pytest

from sensors.corruptions.physics.plume import (
    FAINTEST_PER_M,
    LEAST_SPEED_MPS,
    PERIOD_M,
    WATER_DENSITY,
    Plume,
    draw_patches,
    patches_at,
    plumes_of,
)
from sensors.frame import Frame
from sim.boxes import CLASSES, Boxes
from sim.geometry import invert, transform_points

SIZES = {"car": (4.5, 1.8, 1.5), "truck": (12.0, 2.5, 3.8)}


def frame(speed: float = 25.0, label: str = "car", heading: float = 0.0, at: tuple = (0.0, 0.0)) -> Frame:
    """A vehicle alone on a road at z = 2."""
    length, width, height = SIZES.get(label, SIZES["car"])
    truth = Boxes.from_array(
        [[*at, 2.0 + 0.5 * height, length, width, height, heading]],
        label=[CLASSES.index(label)],
        object_id=[1000],
    )
    velocity = speed * np.array([[np.cos(heading), np.sin(heading)]])
    return Frame(0, 0.0, (), truth, velocity, np.zeros((0, 1), np.int32))


def plume(speed: float = 25.0, label: str = "car", water_mm: float = 0.5) -> Plume:
    return plumes_of(frame(speed, label), water_mm)[0]


def extinction(made: Plume, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return made.mean_extinction(*(np.asarray(v, np.float32) for v in np.broadcast_arrays(x, y, z)))


def test_extinction_grows_with_the_square_of_the_speed_and_with_the_water() -> None:
    assert plume(20.0).extinction == pytest.approx(4.0 * plume(10.0).extinction)
    assert plume(water_mm=1.0).extinction == pytest.approx(2.0 * plume(water_mm=0.5).extinction)
    assert plume(25.0).extinction == pytest.approx(0.29, abs=0.01) and plume(8.33).extinction == pytest.approx(
        0.03, abs=0.005
    )


def test_fast_vehicles_draw_longer_plumes() -> None:
    assert plume(20.0).tail_m == pytest.approx(4.0 * plume(10.0).tail_m)
    lengths = [plume(speed).length_m for speed in (8.0, 12.0, 18.0, 25.0)]
    assert all(a < b for a, b in itertools.pairwise(lengths))
    assert plume(25.0).tail_m == pytest.approx(29.0, abs=0.5) and plume(8.33).tail_m == pytest.approx(3.3, abs=0.2)


def test_a_truck_lifts_the_densest_spray_that_was_published() -> None:
    made = plume(25.0, "truck", 1.0)
    drop_m = 0.8e-3 * 6.0 / 25.0
    mass = made.extinction * WATER_DENSITY * drop_m / (1.5 * 2.0)
    assert mass == pytest.approx(0.03, rel=0.15)


def test_as_much_water_hangs_in_the_wake_as_the_tyres_lift() -> None:
    made = plume(25.0)
    grid = np.meshgrid([12.0], np.linspace(-8, 8, 400), np.linspace(0.005, 10, 400), indexing="ij")
    across = extinction(made, *grid).sum() * (16 / 400) * (10 / 400)
    lifted = made.extinction * made.width * made.height
    # All of it, less what fell out on 12 m; the cube root of growth cancels.
    assert across == pytest.approx(lifted * np.exp(-12.0 / made.tail_m), rel=0.02)


def test_spray_is_behind_the_vehicle_on_the_road() -> None:
    for heading in (0.0, 0.7, np.pi, -2.0):
        made = plumes_of(frame(20.0, heading=heading, at=(30.0, -12.0)), 0.5)[0]
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        rear = np.array([30.0, -12.0, 2.0]) - 2.25 * forward
        assert np.allclose(made.world_from_plume[:3, 3], rear)
        into = invert(made.world_from_plume)
        behind, ahead, above = (
            transform_points(into, (rear + offset)[None])[0] for offset in (-3.0 * forward, forward, [0.0, 0.0, 9.0])
        )
        assert behind[0] > 0.0 > ahead[0] and behind[2] == pytest.approx(0.0)
        assert extinction(made, behind[:1], behind[1:2], [0.2])[0] > 0.05
        assert extinction(made, ahead[:1], ahead[1:2], [0.2])[0] == 0.0
        assert extinction(made, [3.0], above[1:2], above[2:])[0] < 1e-4
    assert extinction(plume(), [5.0], [0.0], [-0.1])[0] == 0.0


def test_it_thins_out_with_distance_height_and_aside() -> None:
    made = plume()
    for place in (
        ([3.0, 10.0, 30.0, 60.0], 0.0, 0.3),
        (5.0, 0.0, [0.1, 1.0, 2.0, 4.0]),
        (5.0, [0.0, 0.5, 1.5, 3.0], 0.3),
    ):
        assert (np.diff(extinction(made, *place)) < 0.0).all()
    low, high = made.bounds
    rng = np.random.default_rng(1)
    outside = rng.uniform([-5, -30, -1], [200, 30, 20], (20_000, 3))
    outside = outside[((outside < low) | (outside > high)).any(axis=1)]
    assert extinction(made, *outside.T).max() < 0.04 * made.extinction
    assert extinction(made, [made.length_m - 0.1], [0.0], [0.01])[0] == pytest.approx(FAINTEST_PER_M, rel=0.2)


@pytest.mark.parametrize(
    ("speed", "label", "water_mm"),
    [(LEAST_SPEED_MPS - 0.1, "car", 2.0), (20.0, "pedestrian", 2.0), (20.0, "bicycle", 2.0), (20.0, "car", 0.0)],
)
def test_who_lifts_no_spray(speed: float, label: str, water_mm: float) -> None:
    assert plumes_of(frame(speed, label), water_mm) == []


def test_empty_scenes_have_no_spray() -> None:
    empty = Frame(0, 0.0, (), Boxes.zeros(), np.zeros((0, 2)), np.zeros((0, 0), np.int32))
    assert plumes_of(empty, 1.0) == []


def test_patches_have_mean_one_and_repeat() -> None:
    field, made = draw_patches(np.random.default_rng(3)), plume()
    places = np.random.default_rng(1).uniform(0.0, PERIOD_M, (3, 200_000)).astype(np.float32)
    dense = patches_at(field, made, places)
    assert dense.mean() == pytest.approx(1.0, abs=0.02) and dense.std() > 0.4 and dense.min() > 0.0
    assert np.allclose(patches_at(field, made, places[:, :99] + np.float32(PERIOD_M)), dense[:99], rtol=1e-2)
    # Neighbours belong to one patch, strangers do not.
    near = patches_at(field, made, places + np.float32(0.05))
    assert np.corrcoef(np.log(dense), np.log(near))[0, 1] > 0.9
    far = patches_at(field, made, places + np.float32(1.0))
    assert abs(np.corrcoef(np.log(dense), np.log(far))[0, 1]) < 0.1
