import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Polygon

from dsrc.ops.iou import bev_iou, paired_volume_iou
from sim.boxes import Boxes
from tests.paths import GOLDENS

GOLDEN = np.load(GOLDENS / "models" / "rotated_iou.npz")

box = st.tuples(
    st.floats(-5, 5), st.floats(-5, 5), st.floats(-1, 1),
    st.floats(0.5, 12), st.floats(0.5, 4), st.floats(0.5, 4), st.floats(-7, 7),
)  # fmt: skip


def iou_3d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, m) IoU of volumes."""
    a, b = np.reshape(a, (-1, 7)), np.reshape(b, (-1, 7))
    footprint = bev_iou(a, b)
    volume, (first, second) = np.zeros_like(footprint), np.nonzero(footprint)
    volume[first, second] = paired_volume_iou(a[first], b[second], footprint[first, second])
    return volume


def random_boxes(rng: np.random.Generator, n: int, spread: float = 6.0) -> np.ndarray:
    return np.column_stack([rng.uniform(-spread, spread, (n, 3)), rng.uniform(0.5, 8, (n, 3)), rng.uniform(-7, 7, n)])


def test_overlaps_equal_the_released_ones() -> None:
    boxes = GOLDEN["boxes"][:, [0, 1, 2, 5, 4, 3, 6]]
    np.testing.assert_allclose(bev_iou(boxes, boxes), GOLDEN["iou"], atol=1e-4)
    near = np.flatnonzero((np.abs(boxes[:, :2]).max(axis=1) < 60) & (np.arange(len(boxes)) != 13))
    block = np.ix_(near, near)
    np.testing.assert_allclose(bev_iou(boxes, boxes)[block], GOLDEN["iou"][block], atol=2e-5)


def test_overlaps_equal_polygon_clipping() -> None:
    rng = np.random.default_rng(1)
    a, b = random_boxes(rng, 30), random_boxes(rng, 40)
    polygons = [[Polygon(p) for p in Boxes.from_array(boxes).bev_polygons()] for boxes in (a, b)]
    expected = [[p.intersection(q).area / p.union(q).area for q in polygons[1]] for p in polygons[0]]
    np.testing.assert_allclose(bev_iou(a, b), expected, atol=1e-6)


@pytest.mark.parametrize("case", ["equal", "slid", "halved", "turned", "touching"])
def test_boxes_with_coincident_edges(case: str) -> None:
    """The library underneath fails on these if it is asked naively."""
    a = random_boxes(np.random.default_rng(2), 300, spread=60.0)
    a[:100, 6] = np.arange(100) * np.pi / 2
    b = a.copy()
    along = np.column_stack([np.cos(a[:, 6]), np.sin(a[:, 6])])
    expected = np.ones(300)
    if case == "slid":
        b[:, :2] += 0.25 * along
        expected = (a[:, 3] - 0.25) / (a[:, 3] + 0.25)
    elif case == "halved":
        b[:, 4] *= 0.5
        expected *= 0.5
    elif case == "turned":
        b[:, 6] += np.pi
    elif case == "touching":
        b[:, :2] += a[:, 3:4] * along
        expected *= 0
    np.testing.assert_allclose(np.diagonal(bev_iou(a, b)), expected, atol=2e-6)


@given(box, box)
def test_overlap_is_symmetric_and_between_0_and_1(a: list[float], b: list[float]) -> None:
    for overlap in (bev_iou, iou_3d):
        ab, ba = overlap([a], [b])[0, 0], overlap([b], [a])[0, 0]
        assert ab == pytest.approx(ba, abs=2e-6)
        assert 0 <= ab <= 1
        assert overlap([a], [a])[0, 0] == pytest.approx(1, abs=2e-6)


@given(box, box, st.floats(-3, 3), st.floats(-500, 500))
def test_overlap_does_not_change_when_the_world_turns_and_moves(
    a: list[float], b: list[float], turn: float, shift: float
) -> None:
    def moved(row: list[float]) -> list[list[float]]:
        c, s = np.cos(turn), np.sin(turn)
        x, y, z, *size, yaw = row
        return [[c * x - s * y + shift, s * x + c * y - shift, z, *size, yaw + turn]]

    assert bev_iou(moved(a), moved(b))[0, 0] == pytest.approx(bev_iou([a], [b])[0, 0], abs=5e-6)


def test_volumes_overlap_as_footprints_times_heights() -> None:
    a = [[0, 0, 0, 4, 2, 2, 0.4]]
    assert iou_3d(a, [[0, 0, 1, 4, 2, 2, 0.4]])[0, 0] == pytest.approx(1 / 3, abs=1e-6)
    assert iou_3d(a, [[0, 0, 2.5, 4, 2, 2, 0.4]])[0, 0] == 0
    assert iou_3d(a, [[0, 0, 0, 4, 2, 1, 0.4]])[0, 0] == pytest.approx(0.5, abs=1e-6)


def test_boxes_without_area_or_with_nan_overlap_nothing() -> None:
    good = [0, 0, 0, 4, 2, 1.5, 0]
    bad = [[0, 0, 0, 0, 2, 1, 0], [0, 0, 0, 4, -1, 1, 0], [np.nan, 0, 0, 4, 2, 1, 0], [0, 0, 0, np.inf, 2, 1, 0]]
    for overlap in (bev_iou, iou_3d):
        assert not overlap([good], bad).any()
        assert not overlap(bad, bad).any()
    assert iou_3d([good], [[0, 0, 0, 4, 2, 0, 0]])[0, 0] == 0


def test_no_boxes_have_no_overlaps() -> None:
    none, some = np.zeros((0, 7)), np.ones((3, 7))
    assert bev_iou(none, some).shape == (0, 3)
    assert iou_3d(some, none).shape == (3, 0)
