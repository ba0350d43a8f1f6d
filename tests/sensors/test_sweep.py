from dataclasses import replace

import numpy as np
import pytest

from sensors.sweep import ADDED, POINT_FIELDS, STATIC, make_sweep
from sim.geometry import pose_matrix
from sim.rows import stacked


def test_columns_left_out_have_defaults() -> None:
    sweep = make_sweep(np.ones((3, 3)))
    assert sweep.points.dtype == np.float32
    assert (sweep.object_id == STATIC).all()
    assert (sweep.return_number == 1).all()


def test_an_unknown_column_is_refused() -> None:
    with pytest.raises(TypeError, match="colour"):
        make_sweep(np.ones((1, 3)), colour=np.zeros(1))


def test_columns_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="ring"):
        make_sweep(np.ones((2, 3)), ring=np.zeros(3))


def test_selection_selects_every_column() -> None:
    sweep = make_sweep(np.arange(12).reshape(4, 3), ring=np.arange(4))
    half = sweep[np.array([True, False, True, False])]
    assert half.ring.tolist() == [0, 2]
    assert all(len(getattr(half, name)) == 2 for name in POINT_FIELDS)


def test_concatenation_with_no_points_changes_nothing() -> None:
    sweep = make_sweep(np.ones((2, 3)), intensity=np.array([0.1, 0.2]))
    joined = stacked(sweep, make_sweep(np.zeros((0, 3))))
    assert len(joined) == 2
    added = stacked(sweep, make_sweep(np.zeros((1, 3)), object_id=np.array([ADDED])))
    assert added.object_id.tolist() == [STATIC, STATIC, ADDED]


def test_lost_points_are_of_the_whole_sweep() -> None:
    assert make_sweep(np.ones((2, 3))).lost == 0
    sweep = replace(make_sweep(np.ones((4, 3))), lost=7)
    assert sweep[:2].lost == sweep[np.array([3])].lost == 7
    assert stacked(sweep[:2], sweep[2:]).lost == 7


def test_world_points_use_the_pose_in_double_precision() -> None:
    pose = pose_matrix([5e5, 1e6, 0.0], np.pi / 2)
    sweep = make_sweep(np.array([[1.0, 0.0, 0.0]]), world_from_lidar=pose)
    np.testing.assert_allclose(sweep.world_points, [[5e5, 1e6 + 1.0, 0.0]], atol=1e-6)
