import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsrc.evaluation.metrics.ap import Matches, curve_of
from dsrc.evaluation.metrics.calibration import IOU, Reliability, best_f1, choice_metrics, first_sight_m, reliability


def matches_of(score: list[float], box: list[int], truth: int) -> Matches:
    """Detections of one frame with the true boxes they hit, the best first."""
    scores, boxes = np.array(score, np.float32), np.array(box, np.int64)
    return Matches(np.array([truth]), np.array([len(score)]), scores, {IOU: boxes})


def test_the_best_threshold_keeps_hits_and_leaves_false_boxes() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6, 0.5], np.float32)
    hit = np.array([True, True, False, True, False])
    point = best_f1(curve_of(hit, score, 4))
    assert point.score == pytest.approx(0.6)
    assert (point.precision, point.recall, point.false_boxes) == (0.75, 0.75, 1.0)
    assert point.f1 == pytest.approx(0.75)


def test_detections_of_one_score_are_kept_or_left_together() -> None:
    score = np.full(4, 0.5, np.float32)
    point = best_f1(curve_of(np.array([True, False, False, False]), score, 1))
    assert (point.precision, point.recall, point.false_boxes) == (0.25, 1.0, 3.0)


@given(st.lists(st.tuples(st.floats(0, 1, width=32), st.booleans()), min_size=1, max_size=30), st.integers(0, 9))
def test_no_threshold_has_a_better_f1(detections: list[tuple[float, bool]], more: int) -> None:
    ranked = sorted(detections, key=lambda one: -one[0])
    score, hit = np.array([s for s, _ in ranked], np.float32), np.array([h for _, h in ranked])
    truth = int(hit.sum()) + more
    point = best_f1(curve_of(hit, score, truth))
    values = []
    for threshold in set(score.tolist()):
        kept = score >= threshold
        values.append(2 * hit[kept].sum() / (kept.sum() + truth))
    if hit.any():
        assert point.f1 == pytest.approx(max(values))
        assert point.false_boxes == (score >= point.score).sum() - hit[score >= point.score].sum()
    else:
        assert math.isnan(point.f1)


def test_scores_that_are_probabilities_have_no_calibration_error_and_boasts_have_their_gap() -> None:
    score = np.repeat([0.25, 0.75], 400)
    hit = np.concatenate([np.arange(400) % 4 == 0, np.arange(400) % 4 != 0])
    assert reliability(score, hit).error == pytest.approx(0.0)
    assert reliability(np.full(800, 0.95), hit).error == pytest.approx(0.45)
    assert reliability(np.array([1.0, 0.0]), np.array([True, False])).error == 0.0
    assert math.isnan(reliability(np.zeros(0), np.zeros(0, bool)).error)


def test_bins_hold_every_detection() -> None:
    score = np.random.default_rng(3).random(500)
    curve = reliability(score, score > 0.5, bins=7)
    assert curve.count.sum() == 500
    assert (np.floor(curve.score * 7) == np.arange(7)).all()


def test_the_first_sight_of_an_object_is_where_it_is_first_found_and_0_of_one_that_never_is() -> None:
    # Frame by frame: object 0 comes nearer and is found in the second frame, 1 at once, 2 never.
    objects = np.array([0, 1, 2, 0, 1, 2, 0])
    distance = np.array([60.0, 35.0, 20.0, 50.0, 30.0, 25.0, 40.0])
    found = np.array([0, 1, 0, 1, 1, 0, 1], bool)
    assert first_sight_m(found, objects, distance) == 35.0  # the median of 50, 35 and 0
    assert first_sight_m(found[objects < 2], objects[objects < 2], distance[objects < 2]) == 42.5
    assert first_sight_m(~found, objects, distance) == 20.0  # 60, 0 and 20
    assert math.isnan(first_sight_m(found[:0], objects[:0], distance[:0]))


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 4), st.floats(0, 99)), min_size=1, max_size=30))
def test_who_finds_more_of_what_comes_nearer_sees_it_no_later(boxes: list[tuple[bool, bool, int, float]]) -> None:
    boxes = sorted(boxes, key=lambda box: -box[3])
    found, more, objects, distance = (np.array(column) for column in zip(*boxes, strict=True))
    assert first_sight_m(found | more, objects, distance) >= first_sight_m(found, objects, distance)


def test_recall_of_what_only_others_see_counts_their_objects_alone() -> None:
    # True boxes: seen by the ego, by others alone and hit, by others alone and missed, by nobody, unknown.
    points = np.array([[5, 9], [0, 4], [0, 7], [0, 0], [-1, -1]])
    place = np.arange(5), 10.0 * np.arange(5)
    matches = matches_of([0.9, 0.8, 0.3], [0, 1, 2], truth=5)
    curve = curve_of(matches.matched[IOU] >= 0, matches.score, 5)
    assert choice_metrics(curve, matches, points, *place)["helped_recall"] == 1.0
    late = matches_of([0.9, 0.8, 0.3, 0.3, 0.3, 0.3, 0.3], [0, 1, 2, -1, -1, -1, -1], truth=5)
    curve = curve_of(late.matched[IOU] >= 0, late.score, 5)
    found = choice_metrics(curve, late, points, *place)
    assert found["best_score"] == pytest.approx(0.8) and found["helped_recall"] == 0.5
    assert found["false_boxes"] == 0.0 and found["best_recall"] == 0.4 and found["first_sight_m"] == 0.0
    assert math.isnan(choice_metrics(curve, late, points * [1, 0], *place)["helped_recall"])


def test_joined_curves_are_the_curve_of_all_detections() -> None:
    rng = np.random.default_rng(0)
    score = rng.uniform(size=200)
    hit = rng.uniform(size=200) < score
    joined = Reliability.joined([reliability(score[part], hit[part]) for part in (slice(0, 3), slice(3, 200))])
    whole = reliability(score, hit)
    assert (joined.count == whole.count).all() and joined.error == pytest.approx(whole.error)
    assert joined.score == pytest.approx(whole.score) and joined.precision == pytest.approx(whole.precision)
    assert whole.right == pytest.approx(hit.mean())
    assert math.isnan(Reliability.joined([reliability(np.zeros(0), np.zeros(0, bool))]).right)
