from dataclasses import replace

import numpy as np

from dsrc.data.formats.levelling import levelled, occlusion
from sensors.sweep import make_sweep
from sim.geometry import pose_matrix


def test_a_tilted_sensors_points_stay_where_they_are_in_a_level_frame() -> None:
    points = np.random.default_rng(0).normal(0, 30, (50, 3))
    sweep = make_sweep(points, pose_matrix([5.0, 2.0, 6.0], 0.7, 0.3, -0.1))
    level = levelled(sweep)
    assert np.allclose(level.world_from_lidar, pose_matrix([5.0, 2.0, 6.0], 0.7))
    assert np.allclose(level.world_points, sweep.world_points, atol=1e-5)


def test_a_level_sensors_points_stay_bit_for_bit() -> None:
    sweep = make_sweep(np.ones((3, 3)) / 3, pose_matrix([5.0, 2.0, 6.0], 0.7))
    assert levelled(sweep) is sweep
    assert levelled(replace(sweep, world_from_lidar=pose_matrix([0, 0, 0], 0.7, 1e-3))) is not sweep


def test_occlusion_has_three_degrees_and_unmeasured_objects_are_visible() -> None:
    assert occlusion(np.array([1.0, 0.96, 0.94, 0.5, 0.49, 0.0, np.nan], np.float32)).tolist() == [0, 0, 1, 1, 2, 2, 0]
