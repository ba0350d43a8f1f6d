import numpy as np
import pytest

from dsrc.ops.anchors import anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER, decode
from dsrc.ops.grid import GridSpec
from dsrc.ops.targets import assign_targets
from tests.paths import GOLDENS

GOLDEN = np.load(GOLDENS / "models" / "targets.npz")
ANCHORS = anchor_grid(GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)))


def our_order(array: np.ndarray) -> np.ndarray:
    return array[..., REFERENCE_ORDER]


def dense_mask(index: np.ndarray) -> np.ndarray:
    mask = np.zeros((32, 64, 2), bool)
    mask[tuple(index.T)] = True
    return mask


def test_legacy_labels_equal_the_released_ones_where_no_best_anchor_is_tied() -> None:
    targets = assign_targets(our_order(GOLDEN["unique/gt"]), ANCHORS, legacy_iou=True)
    index = tuple(GOLDEN["unique/pos_index"].T)
    np.testing.assert_array_equal(targets.positive, dense_mask(GOLDEN["unique/pos_index"]))
    np.testing.assert_array_equal(targets.owner[index], GOLDEN["unique/pos_gt"])
    regression = targets.regression.reshape(32, 64, 2, 7)[index]
    np.testing.assert_allclose(regression, our_order(GOLDEN["unique/pos_targets"]), atol=1e-5)
    decoded = decode(regression.astype(np.float64), ANCHORS[index])
    np.testing.assert_allclose(decoded, our_order(GOLDEN["unique/pos_decoded"]), atol=1e-4)


def test_legacy_labels_equal_the_released_ones_up_to_ties() -> None:
    targets = assign_targets(our_order(GOLDEN["gt"]), ANCHORS, legacy_iou=True)
    owner = targets.owner.ravel()
    threshold = GOLDEN["thr_anchor"]
    np.testing.assert_array_equal(owner[threshold], GOLDEN["thr_gt"])
    forced = np.setdiff1d(np.flatnonzero(owner >= 0), threshold)
    tied = {tuple(pair) for pair in GOLDEN["best_ties"].tolist()}
    assert all((owner[anchor], anchor) in tied for anchor in forced)
    expected = np.setdiff1d(np.ravel_multi_index(GOLDEN["pos_index"].T, (32, 64, 2)), threshold)
    assert len(forced) == len(expected)


def car(x: float, y: float, yaw: float, length: float = 4.9, width: float = 2.1) -> np.ndarray:
    return np.array([[x, y, -1.0, length, width, 1.6, yaw]])


def test_a_car_gets_several_anchors_whatever_its_heading() -> None:
    for yaw in np.radians(range(-180, 181, 15)):
        assert 2 <= assign_targets(car(3.1, -2.3, yaw), ANCHORS).positive.sum() <= 12, yaw


def test_positive_anchors_decode_to_their_box() -> None:
    boxes = np.concatenate([car(3.1, -2.3, 0.3), car(-8.0, 4.0, 1.7), car(10, 0, -0.1, length=12.0, width=2.5)])
    targets = assign_targets(boxes, ANCHORS)
    deltas = targets.regression.reshape(32, 64, 2, 7)[targets.positive]
    decoded = decode(deltas.astype(np.float64), ANCHORS[targets.positive])
    np.testing.assert_allclose(decoded, boxes[targets.owner[targets.positive]], atol=1e-4)
    assert not targets.regression.reshape(32, 64, 2, 7)[~targets.positive].any()


def test_a_bus_owns_every_anchor_that_fits_inside_it() -> None:
    targets = assign_targets(car(0.0, 0.0, 0.0, length=12.0, width=2.5), ANCHORS)
    centres = ANCHORS[targets.positive]
    assert len(centres) >= 10
    assert (np.abs(centres[:, 0]) <= (12.0 - 3.9) / 2 + 1e-6).all()
    assert (centres[:, 6] == 0).all()


def test_a_box_has_only_anchors_that_fit_it() -> None:
    targets = assign_targets(
        np.concatenate([car(0, 0, 0), car(8, 0, 0)]), ANCHORS, fits=np.array([[1, 1], [0, 1]], bool)
    )
    _, _, anchor = np.nonzero(targets.owner == 1)
    assert len(anchor) and (anchor == 1).all() and (targets.owner == 0).any()
    with pytest.raises(ValueError, match=r"fits: expected \(2, 2\), found \(2, 1\)"):
        assign_targets(np.concatenate([car(0, 0, 0), car(8, 0, 0)]), ANCHORS, fits=np.ones((2, 1), bool))


def test_two_cars_side_by_side_share_no_anchor_and_both_get_some() -> None:
    targets = assign_targets(np.concatenate([car(0, 0, 0), car(0.3, 2.4, 0)]), ANCHORS)
    assert (targets.owner == 0).any()
    assert (targets.owner == 1).any()


@pytest.mark.parametrize("legacy_iou", [False, True])
@pytest.mark.parametrize("boxes", [np.zeros((0, 7)), car(500.0, 0.0, 0.0)])
def test_no_box_on_the_grid_means_no_positive_anchor(boxes: np.ndarray, legacy_iou: bool) -> None:
    targets = assign_targets(boxes, ANCHORS, legacy_iou=legacy_iou)
    assert not targets.positive.any()
    assert targets.regression.shape == (32, 64, 14)
