import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dsrc.evaluation.metrics.ap import (
    FrameResult,
    Pairs,
    average_precision,
    envelope,
    evaluate,
    evaluate_matches,
    join_matches,
    match_frames,
    metric_name,
    precision_recall,
)
from dsrc.evaluation.metrics.matching import match
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from sim.boxes import Boxes
from tests.dsrc.ops.test_iou import iou_3d
from tests.paths import GOLDENS as ALL_GOLDENS

GOLDENS = ALL_GOLDENS / "models"


def boxes_from_corners(corners: np.ndarray) -> Boxes:
    """Undo `Boxes.corners`, for upright boxes."""
    corners = corners.astype(np.float64)
    forward = corners[:, 0, :2] - corners[:, 3, :2]
    length, width = np.linalg.norm(forward, axis=1), np.linalg.norm(corners[:, 1, :2] - corners[:, 0, :2], axis=1)
    height = corners[:, 4, 2] - corners[:, 0, 2]
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    return Boxes.from_array(np.column_stack([corners.mean(axis=1), length, width, height, yaw]))


def golden_frames() -> tuple[Mapping[str, np.ndarray], list[FrameResult]]:
    golden = np.load(GOLDENS / "ap.npz")
    return golden, [
        FrameResult(
            Detections(boxes_from_corners(golden[f"det/{i}"]), golden[f"score/{i}"]),
            boxes_from_corners(golden[f"gt/{i}"]),
        )
        for i in range(20)
    ]


def test_every_detection_of_the_golden_frames_is_judged_as_released() -> None:
    golden, frames = golden_frames()
    for i, frame in enumerate(frames):
        iou = bev_iou(frame.detections.boxes.array, frame.truth.array)
        for digit in (3, 5, 7):
            hit = match(iou, frame.detections.score, digit / 10).hit
            np.testing.assert_array_equal(hit, golden[f"tp_{digit}/{i}"].astype(bool), err_msg=f"{i} {digit}")


def test_ap_equals_the_released_one_to_twelve_digits_in_both_orders() -> None:
    expected = json.loads((GOLDENS / "ap.json").read_text())["results"]
    golden, frames = golden_frames()
    result = evaluate(frames)
    for digit in (3, 5, 7):
        curve, want = result.curves["bev", digit / 10], expected[str(digit / 10)]
        assert curve.ap == pytest.approx(want["ap_global"], rel=1e-12)
        assert curve.ap_opencood == pytest.approx(want["ap_local"], rel=1e-12)
        assert (result.truth, result.detections, curve.hits) == (want["gt"], want["n_det"], want["tp"])
        recall, precision = envelope(curve.recall, curve.precision)
        np.testing.assert_allclose(recall, golden[f"curve_{digit}_global/rec"], atol=1e-9)
        np.testing.assert_allclose(precision, golden[f"curve_{digit}_global/prec"], atol=1e-9)


def test_only_the_opencood_order_depends_on_the_order_of_frames() -> None:
    expected = json.loads((GOLDENS / "ap.json").read_text())["results"]["0.5"]
    _, frames = golden_frames()
    backwards = evaluate(frames[::-1]).curves["bev", 0.5]
    assert backwards.ap == pytest.approx(expected["ap_global"], abs=1e-9)
    assert backwards.ap_opencood == pytest.approx(expected["ap_local_reversed_frame_order"], abs=1e-9)


def test_evaluating_twice_gives_the_same() -> None:
    _, frames = golden_frames()
    assert evaluate(frames).metrics() == evaluate(frames).metrics()


def brute_force_ap(
    frames: list[FrameResult], threshold: float, overlap: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> float:
    """The definition, slowly: for every recall reached, the best precision at that recall or beyond."""
    judged, n_truth = [], 0
    for frame in frames:
        free = list(range(len(frame.truth)))
        n_truth += len(frame.truth)
        for d in sorted(range(len(frame.detections)), key=lambda d: -frame.detections.score[d]):
            pairs = [
                (overlap(frame.detections.boxes.array[d : d + 1], frame.truth.array[t : t + 1])[0, 0], -t) for t in free
            ]
            best = max(pairs, default=(0.0, 0))
            hit = best[0] >= threshold
            if hit:
                free.remove(-best[1])
            judged.append((float(frame.detections.score[d]), hit))
    judged.sort(key=lambda pair: -pair[0])
    points = []
    for k in range(1, len(judged) + 1):
        hits = sum(hit for _, hit in judged[:k])
        points.append((hits / n_truth, hits / k))
    area = 0.0
    for step in range(1, n_truth + 1):
        area += max((p for r, p in points if r >= step / n_truth - 1e-12), default=0.0) / n_truth
    return area


def random_frames(rng: np.random.Generator, n: int) -> list[FrameResult]:
    frames = []
    for _ in range(n):
        truth = np.column_stack(
            [
                rng.uniform(-20, 20, (rng.integers(0, 6), 3)) * [1, 1, 0.02],
            ]
        )
        truth = np.column_stack([truth, np.tile([4.5, 1.9, 1.6], (len(truth), 1)), rng.uniform(-3, 3, len(truth))])
        near = np.repeat(truth, rng.integers(0, 3, len(truth)), axis=0)
        near = near + rng.normal(0, [0.5, 0.3, 0.1, 0.2, 0.1, 0.1, 0.1], near.shape)
        far = truth[: rng.integers(0, 3)] + np.array([30, 0, 0, 0, 0, 0, 0])
        found = np.concatenate([near, far])
        score = rng.permutation(1000)[: len(found)].astype(np.float32) / 1000
        frames.append(FrameResult(Detections(Boxes.from_array(found), score), Boxes.from_array(truth)))
    return frames


@pytest.mark.parametrize("seed", range(6))
def test_ap_equals_brute_force_on_random_sets(seed: int) -> None:
    frames = random_frames(np.random.default_rng(seed), 8)
    result = evaluate(frames)
    for (space, threshold), curve in result.curves.items():
        expected = brute_force_ap(frames, threshold, {"bev": bev_iou, "3d": iou_3d}[space])
        assert curve.ap == pytest.approx(expected, abs=1e-9), (space, threshold)


def test_frames_may_be_judged_in_parts_and_asked_for_some_boxes_only() -> None:
    frames = random_frames(np.random.default_rng(11), 9)
    whole, parts = (
        match_frames(frames),
        join_matches([match_frames(frames[:4]), match_frames([]), match_frames(frames[4:])]),
    )
    assert evaluate_matches(parts).metrics() == evaluate_matches(whole).metrics() == evaluate(frames).metrics()
    assert evaluate_matches(whole, np.ones(whole.truth, bool)).metrics() == evaluate(frames).metrics()
    hit = np.isin(np.arange(whole.truth), whole.matched["bev", 0.5])
    missed = evaluate_matches(whole, ~hit)
    assert missed.truth == (~hit).sum() and missed.curves["bev", 0.5].hits == 0
    # Of those that were hit all are found; what hit no box at all is as wrong as before.
    found = evaluate_matches(whole, hit).curves["bev", 0.5]
    assert found.hits == hit.sum() and found.recall[-1] == 1.0
    assert len(found.score) == len(whole.score)


def test_a_perfect_detector_has_ap_1_and_the_truth_itself_is_one() -> None:
    frames = random_frames(np.random.default_rng(9), 10)
    frames = [
        FrameResult(Detections(f.truth, np.linspace(0.9, 0.3, len(f.truth)).astype(np.float32)), f.truth)
        for f in frames
    ]
    assert all(ap == pytest.approx(1.0) for ap in evaluate(frames).metrics().values())


def test_height_counts_in_3d_only() -> None:
    frames = random_frames(np.random.default_rng(10), 10)
    lifted = []
    for frame in frames:
        boxes = replace(frame.truth, center=frame.truth.center + np.array([0, 0, 5]))
        lifted.append(FrameResult(Detections(boxes, np.full(len(boxes), 0.5, np.float32)), frame.truth))
    result = evaluate(lifted)
    assert result.curves["bev", 0.7].ap == pytest.approx(1.0)
    assert result.curves["3d", 0.3].ap == 0.0


def test_a_false_alarm_lowers_ap_only_where_it_outranks_a_hit() -> None:
    recall, precision = precision_recall(np.array([True, True, False]), 2)
    assert average_precision(recall, precision, 2) == 1.0
    recall, precision = precision_recall(np.array([False, True, True]), 2)
    assert average_precision(recall, precision, 2) == pytest.approx(2 / 3)


def test_without_detections_ap_is_0_and_without_truth_it_is_undefined() -> None:
    car = Boxes.from_array([[0, 0, 0, 4, 2, 1.5, 0]])
    nothing_found = evaluate([FrameResult(Detections.zeros(), car)])
    assert set(nothing_found.metrics().values()) == {0.0}
    nothing_there = evaluate([FrameResult(Detections(car, np.ones(1, np.float32)), Boxes.zeros())])
    assert all(math.isnan(ap) for ap in nothing_there.metrics().values())
    assert nothing_there.curves["bev", 0.5].precision.tolist() == [0.0]
    assert all(math.isnan(ap) for ap in evaluate([]).metrics().values())


def test_metrics_are_named_by_order_space_and_threshold() -> None:
    assert metric_name("bev", 0.5) == "ap_bev_50"
    assert metric_name("3d", 0.7, opencood=True) == "ap_opencood_3d_70"


def curve(hits: Sequence[bool | int], n_truth: int) -> tuple[np.ndarray, np.ndarray, int]:
    return *precision_recall(np.array(hits, bool), n_truth), n_truth


def test_the_recalls_of_kitti_by_hand() -> None:
    # Hit, miss, hit of four objects: precision 1 up to recall 1/4, 2/3 up to 1/2, 0 beyond.
    found = curve([1, 0, 1], 4)
    assert average_precision(*found, "11") == pytest.approx((3 * 1.0 + 3 * 2 / 3) / 11)  # 0 .1 .2, .3 .4 .5
    assert average_precision(*found, "40") == pytest.approx((10 * 1.0 + 10 * 2 / 3) / 40)  # up to 10/40, up to 20/40
    assert average_precision(*found) == pytest.approx(1 / 4 + 2 / 3 / 4)
    # One hit of many objects is worth a point of the eleven, none of the forty.
    lucky = curve([1], 1000)
    assert average_precision(*lucky, "11") == pytest.approx(1 / 11) and average_precision(*lucky, "40") == 0.0


@pytest.mark.parametrize("n_truth", [3, 7, 10, 20, 40, 120])
def test_a_perfect_detector_has_every_recall(n_truth: int) -> None:
    perfect = curve([1] * n_truth, n_truth)
    assert average_precision(*perfect) == average_precision(*perfect, "11") == average_precision(*perfect, "40") == 1.0
    # DAIR-V2X's area begins at the first detection: its share of the objects is lost.
    assert average_precision(*perfect, "all-but-first") == pytest.approx(1 - 1 / n_truth)


@pytest.mark.parametrize("recalls", ["all", "all-but-first", "11", "40"])
def test_no_detections_and_no_objects(recalls: str) -> None:
    assert average_precision(*curve([], 5), recalls) == 0.0
    assert math.isnan(average_precision(*curve([0], 0), recalls))


def test_true_boxes_that_choose_first_take_the_nearest_detection() -> None:
    truth = Boxes.from_array([[0, 0, 0, 4, 2, 1.5, 0], [1.0, 0, 0, 4, 2, 1.5, 0]])
    # The best detection lies nearer to the second object, the other one nearer to it too.
    found = Detections(
        Boxes.from_array([[0.6, 0, 0, 4, 2, 1.5, 0], [1.0, 0, 0, 4, 2, 1.5, 0]]), np.array([0.9, 0.8], np.float32)
    )
    frames = [FrameResult(found, truth)]
    assert match_frames(frames).matched["bev", 0.7].tolist() == [1, -1]
    assert match_frames(frames, by="truth").matched["bev", 0.7].tolist() == [0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_one_object_or_none_gives_the_same_matches_whoever_chooses(seed: int) -> None:
    frames = [FrameResult(f.detections, f.truth[:1]) for f in random_frames(np.random.default_rng(seed), 12)]
    ours, theirs = match_frames(frames), match_frames(frames, by="truth")
    for key, matched in ours.matched.items():
        assert ((matched >= 0).sum(), (theirs.matched[key] >= 0).sum()) == ((matched >= 0).sum(),) * 2


def test_an_overlap_of_exactly_the_threshold_is_a_hit() -> None:
    pairs = Pairs(np.array([0, 1]), np.array([0, 1]), np.array([0.5, np.nextafter(0.5, 0.0)]))
    assert pairs.matched(0.5, detections=2).tolist() == [0, -1]
