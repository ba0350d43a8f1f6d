"""Sweeps on slopes: what counts is how the sensor stands to the ground, and bodies are where their boxes say."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.sweep import Sweep
from sim.geometry import Array, invert, pose_matrix, transform_points
from sim.world.standing import stand
from tests.sensors.fakes import cars, ground, scene_of

SENSOR = pose_matrix([0.0, 0.0, 1.9])


@pytest.mark.parametrize("preset", ["hdl-64e-s2", "debug-16"])
def test_a_plane_tilted_by_5_percent_returns_what_a_tilted_sensor_gets_of_a_level_one(preset: str) -> None:
    turn = pose_matrix(np.zeros(3), 0.0, np.arctan(0.05), 0.02)
    tilted = ground()
    tilted.apply_transform(turn)

    def sweep(plane: trimesh.Trimesh, pose: Array) -> Sweep:
        scene = scene_of(plane)
        return scan(scene, get_lidar(preset), pose, pose, 0.0, np.random.default_rng(3))

    slope, level = sweep(tilted, SENSOR), sweep(ground(), invert(turn) @ SENSOR)
    assert len(slope) == len(level) > 500
    np.testing.assert_array_equal(slope.ring, level.ring)
    np.testing.assert_allclose(slope.points, level.points, atol=2e-3)
    np.testing.assert_allclose(slope.intensity, level.intensity, atol=1e-3)
    assert np.ptp(slope.world_points[:, 2]) > 1.0


def test_points_on_a_car_at_8_percent_lie_in_its_tilted_box_and_by_its_tilt_outside_the_upright_one() -> None:
    plane = ground()
    plane.vertices[:, 2] = 0.08 * plane.vertices[:, 0]
    actors = stand(cars([[12.0, 4.0, 0.7], [-8.0, -9.0, 2.1]]), lambda xy: 0.08 * xy[:, 0])
    spec = get_lidar("opv2v-64")
    sweep = scan(scene_of(plane, actors), spec, SENSOR, SENSOR, 0.0, np.random.default_rng(0))
    margin = 0.02 + 4 * spec.range_noise_m
    angle = np.hypot(actors.pitch, actors.roll)[:, None]
    grown = replace(actors.boxes, size=actors.boxes.size + angle * np.array([[3.0, 3.0, 6.3]]))
    for row, object_id in enumerate(actors.boxes.object_id):
        on_it = sweep.world_points[sweep.object_id == object_id]
        local = transform_points(invert(actors.world_from_body()[row]), on_it.astype(np.float64))
        half = 0.5 * actors.boxes.size[row]
        assert len(on_it) > 100
        assert (np.abs(local - [0.0, 0.0, half[2]]) <= half + margin).all()
        assert grown.contains(on_it, margin=margin)[row].all()
        assert actors.boxes.contains(on_it, margin=0.2)[row].all()
