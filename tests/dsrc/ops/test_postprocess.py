from collections.abc import Sequence

import numpy as np
import pytest

from dsrc.ops.anchors import anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER, encode
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.postprocess import PostSettings, candidates, decode_detections, suppressed
from sim.boxes import Boxes, concatenate
from tests.paths import GOLDENS

GOLDEN = np.load(GOLDENS / "models" / "postprocess.npz")
ANCHORS = anchor_grid(GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)))
RELEASED = PostSettings(range_m=(-140, -40, -3, 140, 40, 1), max_extent_m=6.0)


def golden_maps() -> tuple[np.ndarray, np.ndarray]:
    regression = GOLDEN["rm"][0].reshape(2, 7, 32, 64)[:, REFERENCE_ORDER].reshape(14, 32, 64)
    return GOLDEN["psm"][0], regression


def assert_same_boxes(detections: Detections, corners: np.ndarray, scores: np.ndarray) -> None:
    np.testing.assert_allclose(detections.score, scores, atol=1e-6)
    np.testing.assert_allclose(detections.boxes.corners(), corners, atol=1e-4)


def assert_same_moved_boxes(detections: Detections, corners: np.ndarray, scores: np.ndarray) -> None:
    """The transform tilts by half a degree: ours stay upright, so the centres are equal and the corners nearly."""
    center = corners.mean(axis=1)
    # Two agents with one map have each score twice; which of the two comes first is open.
    ours = np.lexsort([detections.boxes.center[:, 0], -detections.score.round(5)])
    theirs = np.lexsort([center[:, 0], -scores.round(5)])
    np.testing.assert_allclose(detections.score[ours], scores[theirs], atol=1e-6)
    np.testing.assert_allclose(detections.boxes.center[ours], center[theirs], atol=1e-4)
    np.testing.assert_allclose(detections.boxes.corners()[ours], corners[theirs], atol=0.06)


def test_detections_equal_the_released_ones() -> None:
    detections = decode_detections(*golden_maps(), ANCHORS, RELEASED)
    assert_same_boxes(detections, GOLDEN["final_corners"], GOLDEN["final_scores"])


def test_candidates_equal_the_released_ones() -> None:
    boxes, scores = candidates(*golden_maps(), ANCHORS, 0.25)
    expected = GOLDEN["cand_boxes"][:, REFERENCE_ORDER]
    np.testing.assert_allclose(scores, GOLDEN["cand_scores"], atol=1e-6)
    np.testing.assert_allclose(boxes.array[:, :6], expected[:, :6], atol=1e-4)
    np.testing.assert_allclose(np.sin(boxes.yaw - expected[:, 6]), 0, atol=1e-5)


def test_late_fusion_equals_the_released_one() -> None:
    own = candidates(*golden_maps(), ANCHORS, 0.25)
    rolled = candidates(*(np.roll(m, 3, axis=2) for m in golden_maps()), ANCHORS, 0.25)
    moved = suppressed(own[0].transform(GOLDEN["T"]), own[1], RELEASED)
    assert_same_moved_boxes(moved, GOLDEN["final_corners_T"], GOLDEN["final_scores_T"])
    both = concatenate([own[0], rolled[0].transform(GOLDEN["T"])])
    fused = suppressed(both, np.concatenate([own[1], rolled[1]]), RELEASED)
    assert_same_moved_boxes(fused, GOLDEN["late_corners"], GOLDEN["late_scores"])


def maps_of(
    boxes: Sequence[Sequence[float]] | np.ndarray, scores: Sequence[float] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return maps on which the nearest anchor of each box says exactly that box."""
    logits, regression = np.full((2, 32, 64), -9.0), np.zeros((2, 7, 32, 64))
    for box, score in zip(boxes, scores, strict=True):
        row, column = np.unravel_index(
            np.hypot(*(ANCHORS[:, :, 0, :2] - box[:2]).transpose(2, 0, 1)).argmin(), (32, 64)
        )
        logits[0, row, column] = np.log(score / (1 - score))
        regression[0, :, row, column] = encode(np.asarray(box, float), ANCHORS[row, column, 0])
    return logits, regression.reshape(14, 32, 64)


BUS = (0.0, 0.0, -0.5, 12.0, 2.5, 3.0, 0.3)


def test_a_bus_is_kept_unless_the_released_filter_is_asked_for() -> None:
    maps = maps_of([BUS], [0.9])
    kept = decode_detections(*maps, ANCHORS, PostSettings())
    np.testing.assert_allclose(kept.boxes.array, [BUS], atol=1e-5)
    assert len(decode_detections(*maps, ANCHORS, PostSettings(max_extent_m=6.0))) == 0


def test_boxes_that_leave_the_range_are_dropped() -> None:
    boxes = [(0, 0, -1, 4, 2, 1.6, 0), (9.5, 0, -1, 4, 2, 1.6, 0), (0, 4, 0.5, 4, 2, 1.6, 0)]
    maps = maps_of(boxes, [0.9, 0.8, 0.7])
    assert len(decode_detections(*maps, ANCHORS, PostSettings())) == 3
    inside = decode_detections(*maps, ANCHORS, PostSettings(range_m=(-10, -10, -3, 10, 10, 1)))
    np.testing.assert_allclose(inside.boxes.array, boxes[:1], atol=1e-5)


def test_detections_come_best_first_and_above_the_threshold() -> None:
    maps = maps_of([(-9, 0, -1, 4, 2, 1.6, 0), (0, 0, -1, 4, 2, 1.6, 0), (9, 0, -1, 4, 2, 1.6, 0)], [0.3, 0.9, 0.1])
    detections = decode_detections(*maps, ANCHORS, PostSettings(score_threshold=0.2))
    np.testing.assert_allclose(detections.score, [0.9, 0.3], atol=1e-6)


@pytest.mark.parametrize("value", [np.nan, -50.0])
def test_maps_that_say_nothing_give_no_detections(value: float) -> None:
    empty = decode_detections(np.full((2, 32, 64), value), np.zeros((14, 32, 64)), ANCHORS, PostSettings())
    assert len(empty) == 0
    assert len(empty.boxes) == 0


def test_a_box_with_nan_is_dropped() -> None:
    logits, regression = maps_of([BUS, (-20, -9, -1, 4, 2, 1.6, 0)], [0.9, 0.8])
    regression[:, 16, :] = np.nan
    regression[:, 15, :] = np.nan
    assert len(decode_detections(logits, regression, ANCHORS, PostSettings())) == 1


def test_selecting_from_nothing() -> None:
    assert len(suppressed(Boxes.zeros(), np.zeros(0, np.float32), RELEASED)) == 0
