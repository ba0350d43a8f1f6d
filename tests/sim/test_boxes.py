import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shapely.geometry import Polygon

from sim.boxes import CLASSES, Boxes, concatenate
from sim.geometry import carla_matrix, invert, pose_angles, pose_matrix, transform_points
from tests.paths import GOLDENS

HWL = [0, 1, 2, 5, 4, 3, 6]
"""Columns of a reference box (h, w, l) in our order."""

rows = arrays(
    np.float64,
    st.tuples(st.integers(0, 6), st.just(7)),
    elements=st.floats(0.5, 12.0),
).map(lambda a: a * [8, -8, 0.3, 1, 1, 1, 1])
planar = st.builds(
    lambda x, y, z, yaw: pose_matrix([x, y, z], yaw),
    st.floats(-100, 100), st.floats(-100, 100), st.floats(-5, 5), st.floats(-7, 7),
)  # fmt: skip


def test_corners_equal_the_reference() -> None:
    golden = np.load(GOLDENS / "models" / "corners.npz")
    np.testing.assert_allclose(Boxes.from_array(golden["boxes"][:, HWL]).corners(), golden["corners_hwl"], atol=1e-4)
    boxes = Boxes.from_array(golden["boxes"])
    np.testing.assert_allclose(boxes.corners(), golden["corners_lwh"], atol=1e-4)
    wrapped = Boxes.from_array(golden["wrap_center"][:, HWL])
    np.testing.assert_allclose(wrapped.corners(), golden["wrap_corners"], atol=1e-4)


def test_hulls_projections_and_range_masks_equal_the_reference() -> None:
    golden = np.load(GOLDENS / "models" / "corners.npz")
    corners = Boxes.from_array(golden["boxes"][:, HWL]).corners()
    plane = corners[:, :4, :2]
    hull = np.concatenate([plane.min(axis=1), plane.max(axis=1)], axis=1)
    np.testing.assert_allclose(hull, golden["standup"], atol=1e-4)
    np.testing.assert_allclose(transform_points(golden["T"], corners), golden["projected"], atol=1e-4)
    inside = ((corners >= [-100, -30, -2.5]) & (corners <= [100, 30, 0.5])).all(axis=2).sum(axis=1)
    np.testing.assert_array_equal(inside >= 8, golden["range_mask8"])
    np.testing.assert_array_equal(inside >= 2, golden["range_mask2"])


@pytest.mark.parametrize("case", ["case0", "case1", "case2"])
def test_vehicles_seen_from_a_tilted_lidar_equal_the_reference(case: str) -> None:
    golden = {k.removeprefix(f"{case}/"): v for k, v in np.load(GOLDENS / "coords.npz").items() if k.startswith(case)}
    place = golden["location"] + golden["center"]
    lidar_from_vehicle = invert(carla_matrix(golden["lidar_pose"])) @ carla_matrix(np.hstack([place, golden["angle"]]))
    n = len(place)
    body = Boxes.from_array(np.hstack([np.zeros((n, 3)), 2 * golden["extent"], np.zeros((n, 1))]))
    tilted = transform_points(lidar_from_vehicle, body.corners())
    np.testing.assert_allclose(tilted, golden["tilted_corners"], atol=1e-9)
    expected = Boxes.from_array(golden["unfiltered/boxes"][:, HWL])
    np.testing.assert_allclose(tilted.mean(axis=1), expected.center, atol=1e-6)
    yaw = pose_angles(lidar_from_vehicle)[0]
    np.testing.assert_allclose(np.sin(yaw - expected.yaw), 0, atol=1e-6)
    np.testing.assert_allclose(expected.corners(), golden["unfiltered/corners"], atol=1e-4)


def test_points_in_boxes_equal_the_reference() -> None:
    golden = np.load(GOLDENS / "points_in_boxes.npz")
    boxes = Boxes.from_array(golden["boxes"][:, HWL])
    np.testing.assert_array_equal(boxes.contains(golden["points"]), golden["in_rotated"])


def test_a_car_at_45_degrees_contains_its_own_corners_but_not_those_of_its_hull() -> None:
    car = Boxes.from_array([[10, -3, 0.8, 4.6, 1.9, 1.6, np.pi / 4]])
    corners = car.corners()[0]
    assert car.contains(corners).all()
    hull = np.array([[x, y, 0.8] for x in np.ptp(corners[:, 0]) * np.array([-0.5, 0.5]) + 10 for y in (-5, -1)])
    assert not car.contains(hull).any()


@given(rows)
def test_every_box_contains_its_corners_and_its_centre(array: np.ndarray) -> None:
    boxes = Boxes.from_array(array)
    assert np.diagonal(boxes.contains(boxes.center)).all()
    for i, corners in enumerate(boxes.corners()):
        assert boxes[i : i + 1].contains(corners, margin=1e-6).all()
        assert not boxes[i : i + 1].contains(boxes.center[i] + 1.001 * (corners - boxes.center[i])).any()


@given(rows, planar)
def test_boxes_move_like_their_corners(array: np.ndarray, destination_from_source: np.ndarray) -> None:
    boxes = Boxes.from_array(array)
    moved = boxes.transform(destination_from_source)
    expected = transform_points(destination_from_source, boxes.corners().reshape(-1, 3)).reshape(-1, 8, 3)
    np.testing.assert_allclose(moved.corners(), expected, atol=1e-9)
    back = moved.transform(invert(destination_from_source))
    np.testing.assert_allclose(back.corners(), boxes.corners(), atol=1e-9)
    np.testing.assert_array_equal(moved.size, boxes.size)


@given(rows, planar)
def test_points_inside_stay_inside_when_everything_moves(
    array: np.ndarray, destination_from_source: np.ndarray
) -> None:
    boxes = Boxes.from_array(array)
    local = np.random.default_rng(0).uniform(-0.7, 0.7, (40, 3))
    points = (boxes.center[:, None] + local * 3).reshape(-1, 3)
    before = boxes.contains(points)
    clear = before == boxes.contains(points, margin=-1e-6)
    clear &= before == boxes.contains(points, margin=1e-6)
    after = boxes.transform(destination_from_source).contains(transform_points(destination_from_source, points))
    np.testing.assert_array_equal(after[clear], before[clear])


def test_corners_run_front_right_front_left_rear_left_rear_right_bottom_first() -> None:
    corners = Boxes.from_array([[0, 0, 0, 4, 2, 1, 0]]).corners()[0]
    np.testing.assert_allclose(corners[:4], [[2, -1, -0.5], [2, 1, -0.5], [-2, 1, -0.5], [-2, -1, -0.5]])
    np.testing.assert_allclose(corners[4:] - corners[:4], [[0, 0, 1]] * 4)


@given(rows)
def test_footprints_are_counter_clockwise_and_as_large_as_length_times_width(array: np.ndarray) -> None:
    boxes = Boxes.from_array(array)
    for polygon, (length, width, _) in zip(boxes.bev_polygons(), boxes.size, strict=True):
        shape = Polygon(polygon)
        assert shape.exterior.is_ccw
        assert shape.area == pytest.approx(length * width)


def test_a_margin_grows_every_face() -> None:
    car = Boxes.from_array([[0, 0, 0, 4, 2, 1, np.pi / 2]])
    beside = [[1.05, 0, 0], [0, 2.05, 0], [0, 0, 0.55]]
    assert not car.contains(beside).any()
    assert car.contains(beside, margin=0.1).all()
    assert not car.contains([[0.95, 0, 0]], margin=-0.1).any()


def test_a_tilted_destination_keeps_boxes_upright() -> None:
    car = Boxes.from_array([[10, 0, 0, 4, 2, 1.5, 0.3]])
    tilted = car.transform(pose_matrix([0, 0, 0], 0.5, 0.05, 0.02))
    np.testing.assert_allclose(tilted.size, car.size)
    assert tilted.yaw[0] == pytest.approx(0.8, abs=0.01)
    assert np.ptp(tilted.corners()[0, :4, 2]) == pytest.approx(0, abs=1e-12)


def test_rows_keep_labels_and_ids_through_selection_and_stacking() -> None:
    boxes = Boxes.from_array(np.ones((3, 7)), label=[0, 3, 6], object_id=[1000, 1001, 1002])
    assert boxes.is_vehicle.tolist() == [True, True, False]
    picked = concatenate([boxes[boxes.is_vehicle], boxes[[2]], boxes[:0]])
    assert picked.object_id.tolist() == [1000, 1001, 1002]
    assert [CLASSES[i] for i in picked.label] == ["car", "bus", "pedestrian"]
    np.testing.assert_array_equal(picked.array, boxes.array)


def test_no_boxes_are_boxes() -> None:
    none = Boxes.zeros()
    assert len(none) == len(concatenate([])) == 0
    assert none.corners().shape == (0, 8, 3)
    assert none.bev_polygons().shape == (0, 4, 2)
    assert none.contains(np.ones((5, 3))).shape == (0, 5)
    assert len(none.transform(np.eye(4))) == 0
    assert Boxes.from_array(np.ones((2, 7))).contains(np.zeros((0, 3))).shape == (2, 0)


def test_columns_of_the_wrong_length_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Boxes\.yaw must have shape \(2,\)"):
        Boxes(np.zeros((2, 3)), np.ones((2, 3)), np.zeros(3), np.zeros(2, np.int64), np.zeros(2, np.int64))
