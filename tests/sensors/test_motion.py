from dataclasses import replace

import numpy as np
import pytest

from sensors.motion import Path, actor_paths
from sim.errors import DataError
from sim.geometry import pose_angles, pose_matrix
from tests.sensors.fakes import cars, rows_of


def test_a_path_goes_through_its_poses() -> None:
    poses = pose_matrix(np.array([[0, 0, 0], [1, 2, 0.1], [5, 2, 0.2]]), [3.0, -3.1, -2.9], [0.0, 0.02, 0.0])
    path = Path.through([1.0, 1.1, 1.3], poses)
    np.testing.assert_allclose(path.at(np.array([1.0, 1.1, 1.3])), poses, atol=1e-12)


def test_headings_turn_the_short_way() -> None:
    path = Path.through([0.0, 1.0], pose_matrix(np.zeros((2, 3)), [np.pi - 0.1, -np.pi + 0.1]))
    yaw = pose_angles(path.at(np.array([0.5])))[0]
    np.testing.assert_allclose(np.abs(yaw), np.pi, atol=1e-12)


def test_outside_its_instants_a_path_stands_still() -> None:
    path = Path.through([0.0, 1.0], pose_matrix(np.array([[0.0, 0, 0], [4, 0, 0]])))
    np.testing.assert_allclose(path.at(np.array([-1.0, 0.25, 2.0]))[:, 0, 3], [0.0, 1.0, 4.0])


def test_actors_are_matched_by_id_and_newcomers_drive_straight() -> None:
    before = rows_of(cars([[0, 0, 3.1], [9, 9, 0]], time_s=0.9), [0])
    now = cars([[1, 0, -3.1], [10, 9, 0]], time_s=1.0, speed=[0.0, 10.0])
    paths = actor_paths(now, before, None, reach_s=0.05)
    assert paths.time_s.tolist() == [0.9, 1.0, 1.05]
    start = paths.at(np.array([0.9]))[:, 0]
    np.testing.assert_allclose(start[:, 0, 3], [0.0, 9.0], atol=1e-12)
    np.testing.assert_allclose(pose_angles(start[0])[0], 3.1, atol=1e-12)
    np.testing.assert_allclose(paths.at(np.array([1.05]))[:, 0, 0, 3], [1.0, 10.5], atol=1e-12)


def test_at_the_reference_time_a_path_is_the_pose_of_the_actor() -> None:
    now = cars([[1, 2, 0.3], [10, 9, -2.0]], time_s=1.0, speed=7.0)
    np.testing.assert_allclose(actor_paths(now).at(np.array([1.0]))[:, 0], now.world_from_body(), atol=1e-12)


def test_no_actors_make_no_paths() -> None:
    assert len(actor_paths(rows_of(cars([[0, 0, 0]]), []))) == 0


@pytest.mark.parametrize("times", [[], [1.0], [1.0, 1.0], [1.0, 0.9], [0.0, np.nan]])
def test_a_path_of_less_than_two_ascending_times_is_refused(times: list[float]) -> None:
    with pytest.raises(DataError, match=f"path: time_s: expected at least two ascending times, found {len(times)}: "):
        Path.through(times, np.tile(np.eye(4), (len(times), 1, 1)))


def test_a_body_rolls_as_it_pitches_and_its_sensor_with_it() -> None:
    now = replace(cars([[1, 2, 0.3]], time_s=1.0), pitch=np.array([0.05]), roll=np.array([-0.03]))
    before = replace(cars([[1, 2, 0.3]], time_s=0.9), roll=np.array([0.01]))
    paths = actor_paths(now, before)
    np.testing.assert_allclose(paths.at(np.array([1.0]))[:, 0], now.world_from_body(), atol=1e-12)
    yaw, pitch, roll = pose_angles(paths.at(np.array([0.95]))[0, 0])
    np.testing.assert_allclose([yaw, pitch, roll], [0.3, 0.025, -0.01], atol=1e-12)
