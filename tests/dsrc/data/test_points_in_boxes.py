import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsrc.data.points_in_boxes import points_in_boxes
from sim.boxes import Boxes
from sim.geometry import pose_matrix, transform_points


def street(seed: int, n: int, p: int) -> tuple[Boxes, np.ndarray]:
    """Boxes of all sizes, some in one another and one far away, and points most of which lie near one."""
    rng = np.random.default_rng(seed)
    array = np.zeros((n, 7))
    array[:, :2], array[:, 2] = rng.normal(0.0, 40.0, (n, 2)), rng.normal(0.0, 0.5, n)
    array[:, 3:6], array[:, 6] = rng.uniform(0.3, 9.0, (n, 3)), rng.uniform(-4.0, 4.0, n)
    array[n // 2 :, :2] += 3e5
    near = array[rng.integers(0, max(n, 1), p), :3] if n else np.zeros((p, 3))
    return Boxes.from_array(array), (near + rng.normal(0.0, 3.0, (p, 3))).astype(np.float32)


@given(st.integers(0, 999), st.integers(0, 12))
def test_pairs_are_those_of_contains(seed: int, n: int) -> None:
    boxes, points = street(seed, n, 200)
    rows, owners = points_in_boxes(boxes, points)
    expected = np.nonzero(boxes.contains(points).T)
    assert np.array_equal(rows, expected[0])
    assert sorted(zip(rows, owners, strict=True)) == sorted(zip(*expected, strict=True))


@given(st.integers(0, 999))
def test_points_may_be_in_another_frame(seed: int) -> None:
    boxes, points = street(seed, 8, 200)
    move = pose_matrix([3.0, -4.0, 0.5], 0.7, 0.02, -0.01)
    rows, owners = points_in_boxes(boxes, points, move)
    mask = np.zeros((8, 200), bool)
    mask[owners, rows] = True
    assert np.array_equal(mask, boxes.contains(transform_points(move, points.astype(np.float64))))


def test_faces_are_included_and_overlapping_boxes_both_have_a_point() -> None:
    boxes = Boxes.from_array(np.repeat([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]], 100, axis=0))
    points = np.array([[8.0, 1.0, 0.0], [12.0, -1.0, 2.0], [12.001, 0.0, 1.0]], np.float32)
    rows, owners = points_in_boxes(boxes, points)
    assert np.bincount(rows, minlength=3).tolist() == [100, 100, 0]
    assert sorted(owners[rows == 0]) == list(range(100))


@given(st.integers(0, 999), st.floats(0.0, 2.0))
def test_boxes_may_be_grown(seed: int, margin: float) -> None:
    boxes, points = street(seed, 8, 200)
    rows, owners = points_in_boxes(boxes, points, margin=margin)
    mask = np.zeros((8, 200), bool)
    mask[owners, rows] = True
    assert np.array_equal(mask, boxes.contains(points, margin))


@given(st.integers(0, 999))
def test_hulls_are_between_the_least_and_the_greatest_corner(seed: int) -> None:
    boxes, points = street(seed, 8, 200)
    rows, owners = points_in_boxes(boxes, points, hull=True)
    corners = boxes.corners().astype(np.float32)
    inside = [((points >= box.min(axis=0)) & (points <= box.max(axis=0))).all(axis=1) for box in corners]
    assert sorted(zip(rows, owners, strict=True)) == sorted(zip(*np.nonzero(np.transpose(inside)), strict=True))
