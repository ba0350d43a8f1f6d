"""Intervals: resampled AP equals that of copied frames, and properties of the intervals."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from dsrc.evaluation.metrics.ap import Matches, curve_of, evaluate_matches, join_matches, match_frames
from dsrc.evaluation.metrics.intervals import (
    Interval,
    RankedDetections,
    draw_weights,
    percentile_interval,
    resampled_ap,
)
from tests.dsrc.evaluation.metrics.test_ap import random_frames


def difference(
    a: RankedDetections, b: RankedDetections, group: Sequence[int] | np.ndarray, seed: int = 0, count: int = 400
) -> Interval:
    """Return the interval of the difference in AP@0.5."""
    weights = draw_weights(np.asarray(group), count, np.random.default_rng(seed))
    values = (resampled_ap(a, weights) - resampled_ap(b, weights))[0]
    return percentile_interval(values, len(np.unique(group)))


def judged_of(frames: int, skill: float, seed: int) -> Matches:
    """Return ten boxes a frame, each found with a chance of `skill`, and ten scores of which the hits' are higher."""
    rng = np.random.default_rng(seed)
    hit = rng.uniform(size=(frames, 10)) < skill
    score = (rng.uniform(size=hit.shape) + 0.3 * hit).astype(np.float32)
    order = np.argsort(-score, axis=1)
    hit, score = (np.take_along_axis(values, order, axis=1) for values in (hit, score))
    box = np.where(hit, np.arange(hit.size).reshape(hit.shape), -1).ravel()
    counts = np.full(frames, 10)
    return Matches(counts, counts, score.ravel(), {("bev", 0.5): box, ("bev", 0.7): box})


def made_up(frames: int, skill: float, seed: int) -> RankedDetections:
    return RankedDetections.of(judged_of(frames, skill, seed))


@pytest.mark.parametrize("seed", range(4))
def test_each_frame_once_is_the_average_precision_itself(seed: int) -> None:
    judged = match_frames(random_frames(np.random.default_rng(seed), 30))
    found = resampled_ap(RankedDetections.of(judged, (0.3, 0.5, 0.7)), np.ones((1, 30), np.float32))
    curves = evaluate_matches(judged).curves
    assert found[:, 0] == pytest.approx([curves["bev", iou].ap for iou in (0.3, 0.5, 0.7)], abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_sorted_inside_frames_it_is_that_of_opencood_also_without_the_boxes_below_a_score(seed: int) -> None:
    judged = match_frames(random_frames(np.random.default_rng(seed), 30))
    ranked = RankedDetections.of(judged, (0.5,), inside_frames=True)
    curve = evaluate_matches(judged).curves["bev", 0.5]
    assert resampled_ap(ranked, np.ones((1, 30), np.float32))[0, 0] == pytest.approx(curve.ap_opencood, abs=1e-12)
    least = float(np.median(judged.score))
    kept = judged.score >= least
    fewer = RankedDetections.of(judged, (0.5,), inside_frames=True, least_score=least)
    hit = judged.matched["bev", 0.5][kept] >= 0
    expected = curve_of(hit, judged.score[kept], int(judged.truth_counts.sum())).ap_opencood
    assert resampled_ap(fewer, np.ones((1, 30), np.float32))[0, 0] == pytest.approx(expected, abs=1e-12)
    assert 0 < kept.sum() < len(kept)


@pytest.mark.parametrize("seed", range(4))
def test_weights_say_what_copies_of_the_frames_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = random_frames(rng, 12)
    # No two detections of a frame are equally sure, so that the order of the copies does not matter.
    weights = draw_weights(np.array([0, 0, 0, 1, 1, 2, 3, 3, 4, 4, 4, 5]), 20, rng)
    found = resampled_ap(RankedDetections.of(match_frames(frames)), weights)
    for row, times in enumerate(weights.astype(int)):
        copies = [frame for frame, n in zip(frames, times, strict=True) for _ in range(n)]
        curves = evaluate_matches(match_frames(copies)).curves
        assert found[:, row] == pytest.approx([curves["bev", iou].ap for iou in (0.5, 0.7)], abs=1e-12)


def test_a_case_that_can_be_counted_by_hand() -> None:
    # Frame 0: a hit at 0.9 and a miss at 0.5 of two boxes; frame 1: a miss at 0.8 and a hit at 0.7 of one box.
    judged = Matches(
        np.array([2, 1]),
        np.array([2, 2]),
        np.array([0.9, 0.5, 0.8, 0.7], np.float32),
        {("bev", iou): np.array([0, -1, -1, 2]) for iou in (0.5, 0.7)},
    )
    weights = np.array([[1, 1], [2, 0], [0, 2], [3, 1]], np.float32)
    # Of three boxes one at precision 1 and one at 2/3; one in two; at 1/2; of seven boxes three at 1 and one at 4/5.
    expected = [(1 + 2 / 3) / 3, 1 / 2, 1 / 2, (3 + 4 / 5) / 7]
    np.testing.assert_allclose(resampled_ap(RankedDetections.of(judged), weights), [expected, expected], atol=1e-12)


def test_a_resample_has_as_many_frames_or_drives_as_there_are() -> None:
    frames = draw_weights(np.arange(9), 500, np.random.default_rng(1))
    assert frames.shape == (500, 9) and (frames.sum(axis=1) == 9).all()
    assert abs(frames.mean(axis=0) - 1.0).max() < 0.2
    drives = draw_weights(np.array([0, 0, 0, 1, 2, 2]), 500, np.random.default_rng(1))
    assert (drives[:, 0] == drives[:, 2]).all() and (drives[:, 4] == drives[:, 5]).all()
    assert (drives[:, [0, 3, 4]].sum(axis=1) == 3).all()
    again = draw_weights(np.array([0, 0, 0, 1, 2, 2]), 500, np.random.default_rng(1))
    np.testing.assert_array_equal(drives, again)


def test_a_method_against_itself_differs_by_exactly_0() -> None:
    hits = made_up(40, 0.6, 0)
    assert difference(hits, hits, np.arange(40)) == (0.0, 0.0)
    assert not Interval(0.0, 0.0).excludes_zero


def test_the_interval_shrinks_with_the_root_of_the_number_of_frames() -> None:
    widths = [
        high - low
        for n in (25, 400)
        for low, high in [difference(made_up(n, 0.6, 1), made_up(n, 0.6, 2), np.arange(n))]
    ]
    assert widths[0] / widths[1] == pytest.approx(4.0, rel=0.3)


def test_an_interval_holds_the_truth_as_often_as_it_says() -> None:
    held = 0
    for trial in range(60):
        low, high = difference(made_up(30, 0.6, 2 * trial), made_up(30, 0.6, 2 * trial + 1), np.arange(30), trial, 200)
        held += low <= 0.0 <= high
    assert 51 <= held <= 60  # 57 are expected, with a standard deviation of 1.7
    assert difference(made_up(100, 0.8, 0), made_up(100, 0.5, 1), np.arange(100)).excludes_zero


@pytest.mark.parametrize("units", [5, 7, 40])
def test_of_a_mean_of_few_normal_values_the_interval_is_students(units: int) -> None:
    sample = stats.norm.ppf((np.arange(units) + 0.5) / units)
    # Resampled means of such a sample are normal, with its deviation over n, not over n - 1.
    means = sample.std() / np.sqrt(units) * stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    low, high = percentile_interval(means, units)
    wanted = stats.t.ppf(0.975, units - 1) * sample.std(ddof=1) / np.sqrt(units)
    assert (-low, high) == pytest.approx((wanted, wanted), rel=5e-3)


def test_frames_of_a_drive_that_are_alike_widen_the_interval_by_drive() -> None:
    def alike(skills: list[float], seed: int) -> RankedDetections:
        return RankedDetections.of(join_matches([judged_of(20, skill, seed + k) for k, skill in enumerate(skills)]))

    a, b = alike([0.9, 0.2, 0.9, 0.2, 0.9, 0.2], 0), alike([0.2, 0.9, 0.9, 0.2, 0.2, 0.9], 50)
    by_frame, by_drive = difference(a, b, np.arange(120)), difference(a, b, np.repeat(np.arange(6), 20))
    assert by_drive.high - by_drive.low > 2.0 * (by_frame.high - by_frame.low)


def test_where_nothing_is_found_it_is_0_and_where_nothing_is_there_unknown() -> None:
    nothing = np.zeros(0, np.float32)
    nowhere = {("bev", iou): np.zeros(0, np.int64) for iou in (0.5, 0.7)}
    hits = RankedDetections.of(Matches(np.array([3, 0]), np.array([0, 0]), nothing, nowhere))
    np.testing.assert_array_equal(resampled_ap(hits, np.array([[1, 1], [0, 2]], np.float32))[0], [0.0, math.nan])
    assert percentile_interval(np.array([math.nan, 1.0, 3.0]), 9, 1.0) == (1.0, 3.0)
    for values, units in (([math.nan], 9), ([1.0, 1.0], 1)):
        unknown = percentile_interval(np.array(values), units)
        assert math.isnan(unknown.low) and not unknown.excludes_zero
    empty = RankedDetections.of(join_matches([match_frames([])]))
    assert np.isnan(resampled_ap(empty, draw_weights(np.zeros(0, np.int64), 2, np.random.default_rng(0)))).all()
