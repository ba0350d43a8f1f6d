import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.geometry import (
    carla_from_matrix,
    carla_matrix,
    center_from_sumo,
    invert,
    matrix_from_carla,
    nearest_rotation,
    pose_angles,
    pose_matrix,
    transform_points,
    wrap_angle,
)
from tests.paths import GOLDENS

GOLDEN = np.load(GOLDENS / "coords.npz")

angle = st.floats(-10, 10)
place = st.tuples(st.floats(-1000, 1000), st.floats(-1000, 1000), st.floats(-50, 50))
pose = st.builds(pose_matrix, place, angle, st.floats(-1.5, 1.5), angle)


def random_poses(n: int = 1000, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (n, 3) places and (n,) yaw, pitch and roll of road vehicles anywhere, heading anywhere."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-5000, 5000, (n, 3)) * [1, 1, 0.02]
    return xyz, rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.3, 0.3, n), rng.uniform(-0.3, 0.3, n)


@given(pose, pose, pose)
def test_poses_form_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-8)
    np.testing.assert_allclose(a @ np.eye(4), a)
    np.testing.assert_allclose(a @ invert(a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(invert(a @ b), invert(b) @ invert(a), atol=1e-8)
    np.testing.assert_allclose(invert(invert(a)), a, atol=1e-9)


@given(pose)
def test_a_pose_is_a_rotation_and_a_place(matrix: np.ndarray) -> None:
    rotation = matrix[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


@given(pose)
def test_angles_of_a_pose_make_the_pose(matrix: np.ndarray) -> None:
    yaw, pitch, roll = pose_angles(matrix)
    np.testing.assert_allclose(pose_matrix(matrix[:3, 3], yaw, pitch, roll), matrix, atol=1e-9)


@given(pose)
def test_a_rounded_rotation_becomes_one_again(matrix: np.ndarray) -> None:
    rotation = matrix[:3, :3]
    assert np.allclose(nearest_rotation(rotation), rotation, atol=1e-12)
    back = nearest_rotation(np.round(rotation, 3))
    assert np.allclose(back @ back.T, np.eye(3), atol=1e-12) and np.linalg.det(back) > 0.0
    assert np.allclose(back, rotation, atol=2e-3)
    assert np.array_equal(nearest_rotation(back), back)


def test_a_mirror_has_a_rotation_next_to_it() -> None:
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


def test_yaw_is_counter_clockwise_and_pitch_lowers_the_front() -> None:
    forward, left = [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]
    north = pose_matrix([0, 0, 0], np.pi / 2)
    np.testing.assert_allclose(transform_points(north, forward), [[0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(transform_points(north, left), [[-1, 0, 0]], atol=1e-12)
    assert transform_points(pose_matrix([0, 0, 0], 0.0, pitch=0.1), forward)[0, 2] < 0
    assert transform_points(pose_matrix([0, 0, 0], 0.0, roll=0.1), left)[0, 2] > 0


def test_many_poses_at_once_equal_one_at_a_time() -> None:
    xyz, yaw, pitch, roll = random_poses(20)
    together = pose_matrix(xyz, yaw, pitch, roll)
    for i in range(20):
        np.testing.assert_array_equal(together[i], pose_matrix(xyz[i], yaw[i], pitch[i], roll[i]))
    np.testing.assert_allclose(invert(together)[7], invert(together[7]))


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_in_one_turn_and_point_the_same_way(a: float) -> None:
    wrapped = float(wrap_angle(a))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(a), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(a), abs=1e-9)


@pytest.mark.parametrize("turns", [-3, -1, 1, 3])
def test_half_turns_wrap_to_plus_pi(turns: int) -> None:
    assert wrap_angle(turns * np.pi) == pytest.approx(np.pi)
    assert -np.pi < wrap_angle(np.nextafter(turns * np.pi, 100)) <= np.pi
    assert -np.pi < wrap_angle(np.nextafter(turns * np.pi, -100)) <= np.pi


def test_points_keep_their_dtype_but_are_moved_in_double_precision() -> None:
    far = pose_matrix([4e6, 0, 0], 0.3)
    local = np.array([[1.25, 2.5, 0.0]], np.float32)
    there = transform_points(far, local.astype(np.float64))
    back = transform_points(invert(far), there)
    np.testing.assert_allclose(back, local, atol=1e-8)
    assert transform_points(far, local).dtype == np.float32
    assert transform_points(far, [[1, 2, 3]]).dtype == np.float64
    assert transform_points(far, np.zeros((0, 3), np.float32)).shape == (0, 3)


def test_a_sumo_car_heading_north_has_its_centre_south_of_its_bumper() -> None:
    base, yaw, pitch = center_from_sumo([[10.0, 20.0, 1.0]], [0.0], [0.0], [5.0])
    np.testing.assert_allclose(base, [[10, 17.5, 1]], atol=1e-12)
    np.testing.assert_allclose([yaw, pitch], [[np.pi / 2], [0]], atol=1e-12)
    _, east, _ = center_from_sumo([[0.0, 0.0, 0.0]], [90.0], [0.0], [5.0])
    np.testing.assert_allclose(east, [0], atol=1e-12)


def test_a_sumo_car_going_uphill_has_its_nose_up_and_its_centre_lower() -> None:
    base, yaw, pitch = center_from_sumo([[0.0, 0.0, 0.0]], [90.0], [10.0], [4.0])
    nose = transform_points(pose_matrix(base, yaw, pitch)[0], [[2.0, 0.0, 0.0]])
    np.testing.assert_allclose(nose, [[0, 0, 0]], atol=1e-12)
    assert base[0, 2] < 0


def test_a_carla_car_has_y_to_the_right() -> None:
    matrix = matrix_from_carla([1.0, 2.0, 0.5, 0.0, 90.0, 0.0])
    np.testing.assert_allclose(matrix[:3, 3], [1, -2, 0.5])
    np.testing.assert_allclose(transform_points(matrix, [[1, 0, 0]]), [[1, -3, 0.5]], atol=1e-12)
    uphill = matrix_from_carla([0, 0, 0, 0, 0, 10.0])
    assert transform_points(uphill, [[1.0, 0, 0]])[0, 2] > 0


def sumo_from_center(
    base: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return SUMO's (front_xyz, angle_deg in [0, 360), slope_deg), the inverse of `center_from_sumo`."""
    slope = -pitch
    forward = np.stack([np.cos(slope) * np.cos(yaw), np.cos(slope) * np.sin(yaw), np.sin(slope)], axis=-1)
    return base + 0.5 * length[:, None] * forward, np.mod(90.0 - np.degrees(yaw), 360.0), np.degrees(slope)


def test_sumo_to_ours_and_back() -> None:
    xyz, yaw, pitch, _ = random_poses()
    length = np.random.default_rng(1).uniform(1, 18, len(yaw))
    front, angle_deg, slope_deg = sumo_from_center(xyz, yaw, pitch, length)
    assert ((angle_deg >= 0) & (angle_deg < 360)).all()
    base, yaw_again, pitch_again = center_from_sumo(front, angle_deg, slope_deg, length)
    np.testing.assert_allclose(base, xyz, atol=1e-9)
    np.testing.assert_allclose(wrap_angle(yaw_again - yaw), 0, atol=1e-12)
    np.testing.assert_allclose(pitch_again, pitch, atol=1e-12)


def test_ours_to_carla_and_back() -> None:
    matrix = pose_matrix(*random_poses())
    poses = carla_from_matrix(matrix)
    np.testing.assert_allclose(matrix_from_carla(poses), matrix, atol=1e-9)
    np.testing.assert_allclose(carla_from_matrix(matrix_from_carla(poses)), poses, atol=1e-9)


def test_sumo_to_carla_and_back_through_ours() -> None:
    xyz, yaw, pitch, _ = random_poses(seed=5)
    length = np.full(len(yaw), 4.6)
    front, angle_deg, slope_deg = sumo_from_center(xyz, yaw, pitch, length)
    base, yaw, pitch = center_from_sumo(front, angle_deg, slope_deg, length)
    matrix = matrix_from_carla(carla_from_matrix(pose_matrix(base, yaw, pitch)))
    yaw, pitch, roll = pose_angles(matrix)
    again = sumo_from_center(matrix[:, :3, 3], yaw, pitch, length)
    np.testing.assert_allclose(again[0], front, atol=1e-9)
    np.testing.assert_allclose(np.mod(again[1] - angle_deg + 180, 360), 180, atol=1e-9)
    np.testing.assert_allclose(again[2], slope_deg, atol=1e-9)
    np.testing.assert_allclose(roll, 0, atol=1e-12)


def test_carla_matrices_equal_the_reference() -> None:
    world = carla_matrix(GOLDEN["poses"])
    np.testing.assert_allclose(world, GOLDEN["x_to_world"], atol=1e-9)
    np.testing.assert_allclose(invert(np.roll(world, -1, axis=0)) @ world, GOLDEN["x1_to_x2_next"], atol=1e-9)
    np.testing.assert_allclose(invert(world[0]) @ world, GOLDEN["x1_to_x2_first"], atol=1e-9)
    agents = carla_matrix(GOLDEN["pair_poses"])
    pairs = invert(agents)[None, :] @ agents[:, None]
    np.testing.assert_allclose(pairs, GOLDEN["pairwise_t_matrix"][:3, :3], atol=1e-9)


def test_our_matrices_are_the_references_mirrored() -> None:
    ours, theirs = matrix_from_carla(GOLDEN["poses"]), GOLDEN["x_to_world"]
    points = np.random.default_rng(2).uniform(-50, 50, (30, 3))
    flip = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        transform_points(ours, points), flip * transform_points(theirs, flip * points), atol=1e-9
    )


def test_moved_points_equal_the_reference() -> None:
    moved = transform_points(GOLDEN["points_T"], GOLDEN["points"])
    np.testing.assert_allclose(moved, GOLDEN["points_projected"], atol=1e-4)
