"""The index of errors against plain loops, the laws of its filters, and the average precision of `dsrc evaluate`."""

import math
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import pytest
from shapely.geometry import Polygon

from dsrc.evaluation.detection_table import join_tables
from dsrc.evaluation.metrics.ap import evaluate
from dsrc.review.errors.filters import FN, FP, KINDS, POOR, ErrorFilter, Span
from dsrc.review.errors.index import POOR_IOU, ErrorIndex, ErrorTable, changes, next_error, worst_frames
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.sources.base import Setup
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY
from sim.boxes import Boxes
from sim.errors import SettingsError
from tests.dsrc.review.errors.runs import draw_run

SEEDS = range(4)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    one, other = (Polygon(Boxes.from_array(box).bev_polygons()[0]) for box in (a, b))
    shared = one.intersection(other).area
    return shared / (one.area + other.area - shared)


def oracle(run: JudgedRun, threshold: float, iou: float, poor_iou: float) -> set[tuple]:
    """Errors by plain loops: (kind, row, object, rank, score, IoU)."""
    errors = set()
    for frame, result in zip(run.table.frames(), run.table.results(), strict=True):
        row, boxes, truth = int(frame.position[0]), result.detections.boxes.array, result.truth.array
        ious = [[overlap(a, b) for b in truth] for a in boxes]
        free, found_by = set(range(len(truth))), {}
        for rank in range(len(boxes)):
            best = max(free, key=lambda j: ious[rank][j], default=None)
            if best is not None and ious[rank][best] >= iou:
                free.remove(best)
                found_by[best] = rank
        for j, object_id in enumerate(frame.object_id.tolist()):
            rank = found_by.get(j)
            if rank is None:
                largest = max((values[j] for values in ious), default=0.0)
                errors.add((FN, row, object_id, -1, None, round(largest, 4)))
            elif frame.score[rank] < threshold:
                errors.add((FN, row, object_id, rank, float(frame.score[rank]), round(ious[rank][j], 4)))
            elif ious[rank][j] < poor_iou:
                errors.add((POOR, row, object_id, rank, float(frame.score[rank]), round(ious[rank][j], 4)))
        for rank in set(range(len(boxes))) - set(found_by.values()):
            if frame.score[rank] >= threshold:
                j = max(range(len(truth)), key=lambda j: ious[rank][j], default=None)
                hit = j is not None and ious[rank][j] > 0.0
                near = int(frame.object_id[j]) if hit else -1
                errors.add((FP, row, near, rank, float(frame.score[rank]), round(ious[rank][j], 4) if hit else 0.0))
    return errors


def listed(errors: ErrorTable) -> set[tuple]:
    return {
        (
            int(errors.kind[i]),
            int(errors.row[i]),
            int(errors.object_id[i]),
            int(errors.rank[i]),
            None if math.isnan(errors.score[i]) else float(errors.score[i]),
            round(float(errors.iou[i]), 4),
        )
        for i in range(len(errors))
    }


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("threshold", "iou"), [(0.0, 0.5), (0.3, 0.5), (0.55, 0.3), (0.8, 0.7), (1.01, 0.5)])
def test_errors_are_those_of_plain_loops(seed: int, threshold: float, iou: float) -> None:
    run = draw_run(seed)
    errors = ErrorIndex([run]).errors(threshold, iou)
    expected = oracle(run, threshold, iou, POOR_IOU)
    assert len(errors) == len(expected)
    # IoU of shapely and of powerboxes differ in the last of four digits at most.
    for mine, theirs in zip(sorted(listed(errors), key=repr), sorted(expected, key=repr), strict=True):
        assert mine[:5] == theirs[:5] and mine[5] == pytest.approx(theirs[5], abs=2e-4)


@pytest.mark.parametrize("seed", SEEDS)
def test_average_precision_is_exactly_that_of_an_evaluation(seed: int) -> None:
    run = draw_run(seed)
    metrics = evaluate(run.table.results())
    for iou in (0.3, 0.5, 0.7):
        curve = ErrorIndex([run]).curves(iou)["DSRC"]
        theirs = metrics.curves["bev", iou]
        assert curve.ap == theirs.ap and curve.ap_opencood == theirs.ap_opencood
        np.testing.assert_array_equal(curve.precision, theirs.precision)
        np.testing.assert_array_equal(curve.recall, theirs.recall)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("threshold", [0.0, 0.4, 0.9])
def test_counts_errors_and_the_curve_agree(seed: int, threshold: float) -> None:
    run = draw_run(seed)
    index, iou = ErrorIndex([run]), 0.5
    counts, errors, curve = (
        index.counts(threshold, iou)["DSRC"],
        index.errors(threshold, iou),
        index.curves(iou)["DSRC"],
    )
    assert counts.fn == np.count_nonzero(errors.kind == FN) and counts.fp == np.count_nonzero(errors.kind == FP)
    assert counts.tp + counts.fn == len(run.table.truth)
    kept = int(np.count_nonzero(curve.score >= threshold))
    if kept:
        assert curve.recall[kept - 1] == pytest.approx(counts.recall)
        assert curve.precision[kept - 1] == pytest.approx(counts.precision)


def test_columns_say_what_the_table_holds() -> None:
    run = draw_run(0)
    errors, table = ErrorIndex([run]).errors(0.3, 0.5), run.table
    for i in range(len(errors)):
        frame = int(np.flatnonzero(table.position == errors.row[i])[0])
        assert errors.frame[i] == table.index[frame] and errors.ego_id[i] == 7
        assert errors.distance_m[i] == pytest.approx(np.hypot(*errors.box[i, :2]), rel=1e-6)
        if errors.object_id[i] < 0:
            assert errors.label[i] == -1 and (errors.points[i] == -1).all() and errors.seen_by[i] == 255
            continue
        row = int(np.flatnonzero((run.truth_frame_of == frame) & (table.object_id == errors.object_id[i]))[0])
        assert errors.label[i] == table.label[row]
        np.testing.assert_array_equal(errors.points[i], table.points[row])
        ego, everyone = table.points[row, :2]
        assert errors.seen_by[i] == (BY_EGO if ego else BY_HELPER if everyone else BY_NOBODY)
        if errors.kind[i] != FP:
            np.testing.assert_array_equal(errors.box[i], table.truth[row])


def test_the_worst_come_first_and_a_clear_miss_is_worse_than_a_hidden_one() -> None:
    errors = ErrorIndex([draw_run(1)]).errors(0.3, 0.5)
    assert (np.diff(errors.loss) <= 0).all() and 0.0 <= errors.loss.min() <= errors.loss.max() <= 2.0
    missed = errors[errors.kind == FN]
    by_points = missed[np.argsort(-missed.points[:, 3], kind="stable")]
    assert (np.diff(by_points.loss) <= 0).all()
    ordered = errors.in_order()
    assert (np.diff(ordered.row) >= 0).all() and len(ordered) == len(errors)


FILTERS = {
    "kinds": (ErrorFilter(kinds=("missed",)), lambda e: e.kind == FN),
    "two kinds": (ErrorFilter(kinds=("false", "poor")), lambda e: e.kind != FN),
    "methods": (ErrorFilter(methods=("B",)), lambda e: e.method == 1),
    "distance_m": (ErrorFilter(distance_m=Span(20, 50)), lambda e: (e.distance_m >= 20) & (e.distance_m <= 50)),
    "classes": (ErrorFilter(classes=("van", "bus")), lambda e: np.isin(e.label, (1, 3))),
    "seen_by": (ErrorFilter(seen_by=("helper",)), lambda e: e.seen_by == BY_HELPER),
}


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_filter_keeps_exactly_the_errors_with_the_property(name: str, seed: int) -> None:
    index = ErrorIndex([draw_run(seed, "A"), draw_run(seed, "B", skill=0.6)])
    only, holds = FILTERS[name]
    everything, chosen = index.errors(0.2, 0.5), index.errors(0.2, 0.5, only)
    expected = everything[holds(everything)]
    assert 0 < len(chosen) < len(everything)
    for field in fields(ErrorTable):
        if field.name not in ("methods", "conditions"):
            np.testing.assert_array_equal(
                getattr(chosen, field.name), getattr(expected, field.name), err_msg=field.name
            )


@pytest.mark.parametrize("name", ["distance_m", "classes", "seen_by"])
def test_objects_of_a_filter_and_of_its_opposite_are_all_objects(name: str) -> None:
    run = draw_run(2)
    only = FILTERS[name][0]
    chosen = only.objects(run)
    value = getattr(only, name)
    if isinstance(value, Span):
        rest = [replace(only, **{name: Span(-np.inf, np.nextafter(value.low, -np.inf))})]
        rest += [replace(only, **{name: Span(np.nextafter(value.high, np.inf), np.inf)})]
    else:
        names = ("ego", "helper", "nobody") if name == "seen_by" else ("car", "van", "truck", "bus")
        rest = [replace(only, **{name: tuple(set(names) - set(value))})]
    masks = [chosen, *(other.objects(run) for other in rest)]
    assert (np.sum(masks, axis=0) == 1).all() and 0 < chosen.sum() < len(chosen)


def test_average_precision_of_a_filter_is_that_of_its_objects_alone() -> None:
    run = draw_run(3)
    only = ErrorFilter(distance_m=Span(0, 30))
    found = ErrorIndex([run]).curves(0.5, only)["DSRC"]
    among = only.objects(run)
    matched = run.at(0.5).matched
    kept = np.where(matched >= 0, np.append(among, False)[matched], run.distance_m <= 30)
    # The same by hand: detections that count, the most confident first.
    order = np.argsort(-run.table.score[kept], kind="stable")
    hits = np.cumsum((matched[kept] >= 0)[order])
    np.testing.assert_allclose(found.precision, hits / np.arange(1, len(hits) + 1))
    np.testing.assert_allclose(found.recall, hits / among.sum())


def test_frames_are_ranked_by_the_sum_of_their_losses() -> None:
    run = draw_run(0)
    errors = ErrorIndex([run]).errors(0.3, 0.5)
    ranking = worst_frames(errors, run.table.position)
    assert sorted(ranking.row.tolist()) == run.table.position.tolist()
    for i, row in enumerate(ranking.row):
        own = errors[errors.row == row]
        assert ranking.loss[i] == pytest.approx(own.loss.sum())
        kinds = (ranking.missed[i], ranking.false[i], ranking.poor[i])
        assert kinds == tuple(np.count_nonzero(own.kind == kind) for kind in (FN, FP, POOR))
    assert (np.diff(ranking.loss) <= 0).all()


def test_the_next_error_of_a_kind_is_found_in_both_directions_and_none_is_said() -> None:
    errors = ErrorIndex([draw_run(0)]).errors(0.3, 0.5, ErrorFilter(kinds=("missed",))).in_order()
    visited, at = [], next_error(errors, row=0)
    while at is not None:
        visited.append(at)
        at = next_error(errors, int(errors.row[at]), after=at)
    assert visited == list(range(len(errors))) and len(visited) > 2
    assert next_error(errors, int(errors.row[visited[-1]]), after=visited[-1], step=-1) == visited[-2]
    middle = int(errors.row[len(errors) // 2])
    assert (
        errors.row[next_error(errors, middle)] >= middle and errors.row[next_error(errors, middle, step=-1)] <= middle
    )
    assert next_error(errors, row=10_000) is None and next_error(errors[:0], row=0) is None
    assert next_error(errors, 0, after=visited[0], step=-1) is None


def test_an_empty_run_has_no_errors_and_no_average_precision() -> None:
    empty = JudgedRun("none", Setup(), join_tables([]))
    index = ErrorIndex([empty])
    assert len(index.errors(0.5, 0.5)) == len(ErrorIndex([]).errors(0.5, 0.5)) == 0
    assert math.isnan(index.curves(0.5)["none"].ap)
    assert (index.counts(0.5, 0.5)["none"].tp, index.counts(0.5, 0.5)["none"].precision) == (0, None)
    assert worst_frames(index.errors(0.5, 0.5), np.zeros(0, np.int64)).row.tolist() == []
    with pytest.raises(ValueError, match="one name"):
        ErrorIndex([empty, empty])


def test_a_wrong_filter_is_one_line() -> None:
    with pytest.raises(SettingsError, match="filter: classes: expected a known name, found carr; did you mean 'car'"):
        ErrorFilter(classes=("carr",))
    with pytest.raises(SettingsError, match="filter: kinds"):
        ErrorFilter(kinds=("fn",))
    with pytest.raises(SettingsError, match="filter: distance_m: expected a range from low to high"):
        ErrorFilter(distance_m=Span(9, 1))
    assert ErrorFilter().kinds == KINDS


def objects_of(run: JudgedRun) -> Iterator[tuple[int, int]]:
    return zip(run.table.position[run.truth_frame_of].tolist(), run.table.object_id.tolist(), strict=True)


def found_objects(run: JudgedRun, threshold: float, iou: float) -> set[tuple[int, int]]:
    return {key for key, found in zip(objects_of(run), run.found(threshold, iou), strict=True) if found}


@pytest.mark.parametrize("seed", range(4))
def test_changes_are_the_differences_of_the_found_objects(seed: int) -> None:
    clean, fog = draw_run(seed, skill=0.9), draw_run(seed, kind="fog", skill=0.5)
    broken, fixed = changes(clean, fog, 0.3, 0.5)
    before, after = found_objects(clean, 0.3, 0.5), found_objects(fog, 0.3, 0.5)
    assert (broken, fixed) == (before - after, after - before)
    assert changes(fog, clean, 0.3, 0.5) == (fixed, broken)


def test_a_filter_chooses_the_objects_that_change() -> None:
    clean, fog = draw_run(1, skill=0.9), draw_run(1, kind="fog", skill=0.3)
    near = changes(clean, fog, 0.3, 0.5, ErrorFilter(distance_m=Span(0, 30)))
    everything = changes(clean, fog, 0.3, 0.5)
    boxes = {key: m for key, m in zip(objects_of(fog), fog.truth_distance_m.tolist(), strict=True)}
    for some, every in zip(near, everything, strict=True):
        assert some == {key for key in every if boxes[key] <= 30}
    assert 0 < len(near[0]) < len(everything[0]) and changes(clean, clean, 0.3, 0.5) == (set(), set())
