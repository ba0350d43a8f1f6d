import numpy as np
import pytest

from dsrc.data.sample import users_in
from dsrc.ops.anchors import ANCHORS, anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER
from dsrc.ops.grid import GridSpec
from dsrc.ops.postprocess import PostSettings, decode_detections
from dsrc.ops.targets import assign_targets
from sim.bodies.vehicle_types import TYPES
from sim.boxes import CLASSES, Boxes
from sim.errors import SettingsError
from tests.paths import GOLDENS

GOLDEN = GOLDENS / "models" / "anchors.npz"
GRIDS = {
    "full_stride2": (GridSpec(), 2),
    "small_stride2": (GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)), 2),
    "small_stride4": (GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)), 4),
    "v2xvit_stride4": (GridSpec(range_m=(-140.8, -38.4, -3, 140.8, 38.4, 1)), 4),
}


@pytest.mark.parametrize("case", GRIDS)
def test_anchors_equal_the_released_ones(case: str) -> None:
    grid, stride = GRIDS[case]
    golden = np.load(GOLDEN)
    anchors = anchor_grid(grid, stride)
    np.testing.assert_allclose(anchors[0, :, 0, 0], golden[f"{case}/x"], atol=1e-12, rtol=0)
    np.testing.assert_allclose(anchors[:, 0, 0, 1], golden[f"{case}/y"], atol=1e-12, rtol=0)
    template = golden[f"{case}/template"][:, list(REFERENCE_ORDER)]
    np.testing.assert_allclose(anchors[0, 0, :, 2:], template[:, 2:], atol=1e-12, rtol=0)
    assert anchors.shape == (grid.height // stride, grid.width // stride, 2, 7)
    if f"{case}/all" in golden.files:
        np.testing.assert_allclose(anchors[..., REFERENCE_ORDER], golden[f"{case}/all"], atol=1e-12, rtol=0)


def test_anchors_sit_at_the_centres_of_the_output_cells() -> None:
    grid = GridSpec(range_m=(0, 0, -3, 8, 4, 1), cell_m=0.5)
    anchors = anchor_grid(grid)
    np.testing.assert_allclose(anchors[0, :, 0, 0], np.arange(8) + 0.5)
    np.testing.assert_allclose(anchors[:, 0, 0, 1], np.arange(4) + 0.5)


def test_a_grid_that_the_stride_does_not_divide_is_refused() -> None:
    with pytest.raises(SettingsError, match="multiple of 2"):
        anchor_grid(GridSpec(range_m=(0, 0, -3, 1.2, 4, 1)))


def test_every_vulnerable_road_user_has_an_anchor_of_its_class_wherever_it_stands() -> None:
    grid = GridSpec(range_m=(-12.8, -12.8, -3, 12.8, 12.8, 1), cell_m=0.2)
    anchors, (_, label, takes, least, _) = anchor_grid(grid, users="vulnerable"), ANCHORS["vulnerable"]
    rng = np.random.default_rng(0)
    for name, size in (("pedestrian", (0.5, 0.6, 1.7)), ("bicycle", (1.8, 0.65, 1.7)), ("motorcycle", (2.2, 0.8, 1.5))):
        place = np.append(rng.uniform(-10, 10, (60, 2)), rng.uniform(-1.2, -0.8, (60, 1)), axis=1)
        rows = np.column_stack([place, np.tile(size, (60, 1)), rng.uniform(-np.pi, np.pi, 60)])
        for row in rows:
            found = assign_targets(row[None], anchors, least, fits=takes[[CLASSES.index(name)]])
            classes = {CLASSES[label[anchor]] for anchor in np.nonzero(found.positive)[2]}
            assert classes == {"pedestrian" if name == "pedestrian" else "bicycle"}


def test_every_class_of_road_users_has_an_anchor_that_takes_it() -> None:
    for users, (_, label, takes, *_) in ANCHORS.items():
        everybody = Boxes.from_array(np.ones((len(CLASSES), 7)), np.arange(len(CLASSES)))
        assert np.array_equal(takes.any(axis=1), users_in(everybody, users))
        assert all(takes[kind, row] for row, kind in enumerate(label))


def test_people_have_about_as_many_positive_anchors_as_two_wheelers() -> None:
    """Those with fewer are found with lower scores. Motorcycles, the largest, have more than both."""
    grid = GridSpec(range_m=(-12.8, -12.8, -3, 12.8, 12.8, 1), cell_m=0.2)
    anchors, (_, _, takes, least, _) = anchor_grid(grid, users="vulnerable"), ANCHORS["vulnerable"]
    rng = np.random.default_rng(0)
    counts = {}
    for kind in (kind for kind in TYPES.values() if kind.label in ("pedestrian", "bicycle")):
        fits = takes[[CLASSES.index(kind.label)]]
        rows = [(*rng.uniform(-10, 10, 2), -1.0, *kind.size, rng.uniform(-np.pi, np.pi)) for _ in range(150)]
        counts[kind.name] = np.mean([assign_targets([row], anchors, least, fits=fits).positive.sum() for row in rows])
    assert len(counts) == 5 and max(counts.values()) < 1.75 * min(counts.values()), counts


def test_perfect_maps_decode_to_the_road_users_and_their_classes() -> None:
    grid = GridSpec(range_m=(-12.8, -12.8, -3, 12.8, 12.8, 1), cell_m=0.2)
    anchors, (_, label, takes, least, _) = anchor_grid(grid, users="vulnerable"), ANCHORS["vulnerable"]
    boxes = np.array([(3.0, 4.0, -1.0, 0.5, 0.6, 1.7, 2.0), (-6.1, 2.0, -1.0, 1.8, 0.65, 1.7, -0.8)])
    fits = takes[[CLASSES.index("pedestrian"), CLASSES.index("bicycle")]]
    found = assign_targets(boxes, anchors, least, fits=fits)
    logits = np.where(np.moveaxis(found.positive, -1, 0), 4.0, -9.0)
    regression = np.moveaxis(found.regression, -1, 0)
    read = decode_detections(logits, regression, anchors, PostSettings(), label)
    read = read[np.argsort(-read.boxes.label)]
    assert [CLASSES[i] for i in read.boxes.label] == ["pedestrian", "bicycle"]
    np.testing.assert_allclose(read.boxes.array, boxes, atol=1e-5)


def test_two_wheelers_along_and_across_are_learned_at_half_a_right_angle_from_their_anchor() -> None:
    """The loss is of the sine of the angle: it has no slope at a right angle."""
    grid = GridSpec(range_m=(-12.8, -12.8, -3, 12.8, 12.8, 1), cell_m=0.2)
    anchors, (_, _, takes, least, headed) = anchor_grid(grid, users="vulnerable"), ANCHORS["vulnerable"]
    for yaw in (0.0, np.pi / 2):
        box = np.array([(1.0, 2.0, -1.0, 1.8, 0.65, 1.7, yaw)])
        found = assign_targets(box, anchors, least, fits=takes[[CLASSES.index("bicycle")]])
        place = np.nonzero(found.positive)
        assert headed[place[2]].all()
        angles = found.regression.reshape(*anchors.shape[:2], 2, 7)[place][:, 6]
        np.testing.assert_allclose(np.abs(angles), np.pi / 4, atol=1e-6)
