from typing import Any

import msgspec
import numpy as np
import pytest

from sensors.optics.reflectance import drop_chance
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import POINT_FIELDS, STATIC, Sweep
from sim.geometry import pose_matrix
from sim.mesh.materials import MATERIALS, material_index
from tests.sensors.fakes import BRIGHT, box, cars, ground, ideal, scene_of

SENSOR = pose_matrix([0.0, 0.0, 1.9])


def sweep_of(scene: RayScene, spec: LidarSpec, pose: np.ndarray = SENSOR, seed: int = 0, **more: Any) -> Sweep:
    return scan(scene, spec, pose, pose, 0.0, np.random.default_rng(seed), **more)


def test_points_have_the_elevation_of_their_ring_and_the_azimuth_of_their_column() -> None:
    spec = ideal()
    sweep = sweep_of(scene_of(box((30, 30, 30))), spec, pose_matrix([1.0, 2.0, 0.5], 1.0, 0.1, 0.05))
    points = sweep.points.astype(np.float64)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(elevation, spec.elevation[sweep.ring], atol=1e-5)
    np.testing.assert_allclose(np.cos(azimuth - spec.azimuth[sweep.column]), 1.0, atol=1e-9)
    order = sweep.ring.astype(np.int64) * spec.columns + sweep.column
    assert (np.diff(order) > 0).all()


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_points_on_a_car_lie_in_its_box_and_nowhere_else(yaw: float) -> None:
    actors = cars([[12.0, 4.0, yaw], [-8.0, -9.0, yaw + 1.0]])
    spec = get_lidar("opv2v-64")
    sweep = sweep_of(scene_of(ground(), actors), spec)
    inside = actors.boxes.contains(sweep.world_points, margin=0.02 + 4 * spec.range_noise_m)
    for row, object_id in enumerate(actors.boxes.object_id):
        on_it = sweep.object_id == object_id
        assert on_it.sum() > 100
        assert inside[row][on_it].all()
    assert (sweep.object_id[~inside.any(axis=0)] == STATIC).all()


def test_the_own_body_is_not_seen() -> None:
    actors = cars([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    scene = scene_of(ground(), actors)
    assert (sweep_of(scene, ideal()).object_id == 1000).any()
    assert set(np.unique(sweep_of(scene, ideal(), exclude_id=1000).object_id)) == {STATIC, 1001}


def test_one_seed_gives_the_same_bytes_and_another_does_not() -> None:
    scene = scene_of(ground(), cars([[9.0, 3.0, 0.2]], speed=8.0))
    spec = get_lidar("debug-16")
    first, again, other = (sweep_of(scene, spec, seed=seed) for seed in (7, 7, 8))
    for name in POINT_FIELDS:
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert first.points.tobytes() != other.points.tobytes()


def test_an_empty_scene_gives_an_empty_sweep() -> None:
    sweep = sweep_of(scene_of(), get_lidar("debug-16"))
    assert len(sweep) == 0
    assert sweep.points.shape == (0, 3)


def test_nothing_lies_beyond_the_range_and_intensity_is_a_share() -> None:
    spec = msgspec.structs.replace(get_lidar("opv2v-64"), range_noise_m=0.5)
    start, end = pose_matrix([-1.5, 0.0, 1.9]), pose_matrix([1.5, 0.0, 1.9], 0.05)
    scene = scene_of(box((300, 230, 30), (0, 0, 15)), cars([[20.0, 0.0, 0.0]]))
    sweep = scan(scene, spec, start, end, 0.0, np.random.default_rng(0))
    fired_at = np.column_stack([30.0 * sweep.time_offset, np.zeros((len(sweep), 2))])
    measured = np.linalg.norm(sweep.points - fired_at, axis=1)
    assert 118.0 < measured.max() <= spec.range_max_m + 0.01
    assert sweep.intensity.min() >= 0.0
    assert sweep.intensity.max() <= 1.0


def test_a_moving_car_is_smeared_by_its_motion_around_its_box() -> None:
    """A car at 20 m/s is 0.5 m farther when a column fires a quarter of a rotation later."""
    speed, spec = 20.0, ideal("opv2v-64")
    ahead = cars([[0.0, 20.0, np.pi / 2]], speed=speed)
    sweep = sweep_of(scene_of(None, ahead), spec)
    rear = sweep.points[:, 1] < 18.6
    # The rear plate is at y = 17.75 at time 0; straight left is fired a quarter of a rotation after straight ahead.
    expected = 17.75 + speed * sweep.time_offset[rear]
    np.testing.assert_allclose(sweep.points[rear, 1], expected, rtol=0.0, atol=1e-4)
    assert sweep.time_offset[rear].mean() == pytest.approx(0.025, abs=2e-3)


def test_without_rolling_shutter_a_moving_car_is_not_smeared() -> None:
    spec = ideal("opv2v-64", rolling_shutter=False)
    sweep = sweep_of(scene_of(None, cars([[0.0, 20.0, np.pi / 2]], speed=20.0)), spec)
    assert len(sweep) > 50
    assert (sweep.time_offset == 0.0).all()
    assert sweep.points[:, 1].min() == pytest.approx(17.75, abs=1e-3)


def test_a_static_world_is_sharp_however_the_sensor_moves() -> None:
    half = np.array([15.0, 11.0, 5.0])
    start, end = pose_matrix([-1.0, 0.2, 0.0], -0.1), pose_matrix([1.0, -0.2, 0.0], 0.1)
    sweep = scan(scene_of(box(2 * half)), ideal(), start, end, 5.0, np.random.default_rng(0))
    np.testing.assert_allclose(sweep.world_from_lidar, np.eye(4), atol=1e-12)
    world = sweep.world_points
    np.testing.assert_allclose(np.abs(world / half).max(axis=1), 1.0, atol=1e-4)


def test_noise_runs_along_the_ray() -> None:
    spec = ideal(range_noise_m=0.05)
    room = scene_of(box((30, 30, 30)))
    clean, noisy = sweep_of(room, ideal()), sweep_of(room, spec)
    assert len(clean) == len(noisy)
    assert np.std(noisy.range - clean.range) == pytest.approx(0.05, rel=0.05)
    along = np.einsum("ij,ij->i", noisy.points, clean.points) / (noisy.range * clean.range)
    np.testing.assert_allclose(along, 1.0, atol=1e-6)


def test_random_loss_follows_the_rate() -> None:
    room = scene_of(box((30, 30, 30)))
    kept = len(sweep_of(room, ideal("opv2v-64", dropoff_rate=0.1))) / len(sweep_of(room, ideal("opv2v-64")))
    assert kept == pytest.approx(0.9, abs=0.01)


def test_drop_chance_is_linear_up_to_the_limit() -> None:
    spec = ideal(dropoff_intensity_limit=0.8, dropoff_zero_intensity=0.4)
    chance = drop_chance(np.array([0.0, 0.4, 0.8, 1.0], np.float32), spec)
    np.testing.assert_allclose(chance, [0.4, 0.2, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("name", ["hdl-64e-s3", "vlp-16", "vlp-32c"])
def test_a_real_sensor_hardly_loses_the_road_beside_it(name: str) -> None:
    road = ground()
    road.face_attributes["material"][:] = material_index("asphalt")
    spec = get_lidar(name)
    seen, all_of_it = (sweep_of(scene_of(road), s) for s in (spec, ideal(name)))
    assert (seen.range < 15.0).sum() / (all_of_it.range < 15.0).sum() > 0.97


def test_grazing_far_and_dark_targets_vanish_first() -> None:
    spec = ideal("opv2v-64", range_10_m=40.0)
    floor = sweep_of(scene_of(ground()), spec)
    ideal_floor = sweep_of(scene_of(ground()), ideal("opv2v-64"))
    assert 15.0 < floor.range.max() < ideal_floor.range.max()
    wall = sweep_of(scene_of(box((160, 160, 40))), spec, pose_matrix([0.0, 0.0, 0.0]))
    assert wall.range.max() > floor.range.max()


def test_retro_reflectors_are_the_brightest() -> None:
    retro = next(i for i, material in enumerate(MATERIALS) if material.finish == "retro")
    plain = sweep_of(scene_of(box((30, 30, 30))), ideal())
    shiny = sweep_of(scene_of(box((30, 30, 30), material=retro)), ideal())
    assert shiny.intensity.min() > plain.intensity.max()
    assert plain.intensity.max() <= MATERIALS[BRIGHT].reflectivity
