import numpy as np

from dsrc.evaluation.metrics.matching import match


def test_the_more_confident_detection_takes_the_truth() -> None:
    outcome = match(np.array([[0.9], [0.8]]), np.array([0.3, 0.6]), 0.5)
    assert outcome.order.tolist() == [1, 0]
    assert outcome.truth.tolist() == [0, -1]


def test_a_duplicate_may_take_another_free_truth() -> None:
    iou = np.array([[0.9, 0.6], [0.8, 0.55]])
    assert match(iou, np.array([0.9, 0.8]), 0.5).truth.tolist() == [0, 1]


def test_a_duplicate_with_no_free_truth_left_is_false() -> None:
    iou = np.array([[0.9, 0.1], [0.8, 0.2]])
    assert match(iou, np.array([0.9, 0.8]), 0.5).truth.tolist() == [0, -1]


def test_the_threshold_itself_is_a_match() -> None:
    assert match(np.array([[0.5]]), np.array([1.0]), 0.5).hit.tolist() == [True]


def test_matching_changes_no_input() -> None:
    iou, scores = np.array([[0.9, 0.6], [0.8, 0.55]]), np.array([0.2, 0.8])
    before = iou.copy()
    match(iou, scores, 0.5)
    np.testing.assert_array_equal(iou, before)


def test_without_truth_or_detections() -> None:
    assert match(np.zeros((2, 0)), np.ones(2), 0.5).hit.tolist() == [False, False]
    assert match(np.zeros((0, 3)), np.zeros(0), 0.5).hit.tolist() == []
