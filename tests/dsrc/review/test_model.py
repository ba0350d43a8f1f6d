from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.review.model import ReviewModel, open_model
from dsrc.review.state import ReviewState
from dsrc.review.texts import quoted, selection_report, summary
from dsrc.review.view import (
    DETECTED_TRUTH,
    FALSE_NEGATIVES,
    FALSE_POSITIVES,
    LAYERS,
    OTHER_TRUTH,
    SELECTED,
    TRUE_POSITIVES,
)
from sensors.frame import BY_EGO, BY_HELPER, Frame
from sim.errors import DataError
from sim.geometry import transform_points
from tests.dsrc.review.conftest import FakeDetector, FakeDrive, cells


def test_points_under_their_pose_are_the_world_around_the_first_ego(truth_model: ReviewModel, frame: Frame) -> None:
    view = truth_model.view(ReviewState())
    origin = frame.agents[0].world_from_body[:3, 3]
    for agent, drawn in zip(frame.agents, view.agents, strict=True):
        placed = transform_points(drawn.review_from_lidar, drawn.points.astype(np.float64))
        np.testing.assert_allclose(placed, agent.sweep.world_points - origin, atol=1e-6)


def test_drawn_points_survive_float16_although_the_world_is_far_away(truth_model: ReviewModel) -> None:
    for agent in truth_model.view(ReviewState()).agents:
        assert np.abs(agent.points.astype(np.float16) - agent.points).max() < 0.04


def test_without_a_detector_there_is_only_truth_and_no_counts(truth_model: ReviewModel) -> None:
    view = truth_model.view(ReviewState())
    assert view.counts is None
    assert (
        len(view.layers[TRUE_POSITIVES]) == len(view.layers[FALSE_POSITIVES]) == len(view.layers[FALSE_NEGATIVES]) == 0
    )
    # The ego's own body is not an object that it could detect.
    assert view.layers[DETECTED_TRUTH].object_id.tolist() == [1001, 1002, 1003, 1004, 1005]
    assert view.layers[OTHER_TRUTH].object_id.tolist() == [1000]


def test_boxes_are_classified_as_tp_fp_and_fn(model: ReviewModel) -> None:
    view = model.view(ReviewState(threshold=0.0))
    objects = len(view.layers[DETECTED_TRUTH]) + len(view.layers[FALSE_NEGATIVES])
    assert (view.counts.tp, view.counts.fp, view.counts.fn) == (objects - 1, 1, 1)
    assert len(view.layers[TRUE_POSITIVES]) == objects - 1 and len(view.layers[FALSE_POSITIVES]) == 1
    assert sum(len(view.layers[name]) for name in (DETECTED_TRUTH, FALSE_NEGATIVES, OTHER_TRUTH)) == len(view.truth)
    assert view.counts.precision == pytest.approx(view.counts.tp / (view.counts.tp + 1))
    assert set(view.layers) == set(LAYERS)


def test_true_positives_are_drawn_on_their_objects(model: ReviewModel) -> None:
    view = model.view(ReviewState(frame=3))
    np.testing.assert_allclose(view.layers[TRUE_POSITIVES].center, view.layers[DETECTED_TRUTH].center, atol=0.01)


def test_the_threshold_cuts_detections_without_detecting_again(model: ReviewModel, detector: FakeDetector) -> None:
    counts = [model.view(ReviewState(threshold=t)).counts for t in (0.0, 0.5, 0.7, 1.0)]
    assert len(detector.samples) == 1
    assert [c.fp for c in counts] == [1, 0, 0, 0]
    assert counts[0].tp == counts[1].tp > counts[2].tp > counts[3].tp == 0
    assert all(c.tp + c.fn == counts[0].tp + counts[0].fn for c in counts)


def test_a_corruption_changes_what_is_drawn_and_what_the_detector_gets_once(
    model: ReviewModel, detector: FakeDetector, fake_fog: list[tuple[int, str, int]]
) -> None:
    clean = model.view(ReviewState())
    foggy = replace(ReviewState(), corruption="fog", severity=4)
    for threshold in (0.1, 0.5):
        view = model.view(replace(foggy, threshold=threshold))
    assert fake_fog == [(0, "fog", 4)]
    assert len(view.agents[0].points) == (len(clean.agents[0].points) + 1) // 2
    assert len(detector.samples) == 2
    assert len(detector.samples[1].clouds[0]) < len(detector.samples[0].clouds[0])


def test_lost_points_are_counted_beside_those_that_are_left(
    truth_model: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    clean = truth_model.view(ReviewState())
    foggy = truth_model.view(ReviewState(corruption="fog"))
    assert " lost" not in summary(clean)
    for before, after in zip(clean.agents, foggy.agents, strict=True):
        assert before.lost == 0 and after.lost == before.total // 2
        assert f"points, {after.lost} lost" in summary(foggy)


def test_both_families_are_kept_apart_in_the_caches(
    truth_model: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    for family in ("physical", "paper", "physical"):
        truth_model.view(ReviewState(corruption="fog", family=family))
    assert len(fake_fog) == 2


def test_an_error_relative_to_the_ego_follows_the_ego(truth_model: ReviewModel) -> None:
    poses = {}
    for ego_id in (1000, 1002):
        view = truth_model.view(ReviewState(corruption="pose_error", severity=5, ego_id=ego_id))
        clean = truth_model.view(ReviewState(ego_id=ego_id))
        poses[ego_id] = [
            np.array_equal(a.review_from_lidar, b.review_from_lidar)
            for a, b in zip(view.agents, clean.agents, strict=True)
        ]
    assert poses == {1000: [True, False, False], 1002: [False, True, False]}


def test_counts_sum_over_the_viewed_frames(model: ReviewModel) -> None:
    first = model.view(ReviewState(frame=0))
    second = model.view(ReviewState(frame=1))
    assert (first.seen_frames, second.seen_frames) == (1, 2)
    assert second.seen == first.counts + second.counts


def test_a_sketch_detects_and_corrupts_nothing(
    model: ReviewModel, detector: FakeDetector, fake_fog: list[tuple[int, str, int]]
) -> None:
    sketch = model.sketch(ReviewState())
    assert len(sketch.layers[DETECTED_TRUTH]) == 5 and sketch.counts is None
    assert [len(agent.points) > 0 for agent in sketch.agents] == [True, False, False]
    foggy = model.sketch(ReviewState(corruption="fog"))
    assert not any(len(agent.points) for agent in foggy.agents), "clean points are none of a frame in fog"
    assert detector.samples == fake_fog == []


def test_another_ego_detects_from_its_own_place(model: ReviewModel, detector: FakeDetector) -> None:
    model.view(ReviewState(ego_id=1002, cooperative=False))
    assert detector.samples[0].agent_ids == (1002,)


def test_a_hidden_agent_has_no_points_and_is_still_detected_with(model: ReviewModel, detector: FakeDetector) -> None:
    view = model.view(ReviewState(hidden=frozenset({1002})))
    assert len(view.agents[1].points) == 0 and not view.agents[1].visible
    assert 1002 in detector.samples[0].agent_ids


def test_frames_are_read_once(truth_model: ReviewModel, drive: FakeDrive) -> None:
    for frame in (0, 1, 0, 1):
        truth_model.view(ReviewState(frame=frame))
    assert sorted(drive.reads) == [0, 1]


def test_links_join_the_ego_with_its_collaborators(model: ReviewModel) -> None:
    view = model.view(ReviewState())
    assert view.linked.shape == (2, 2, 3)
    assert len(model.view(ReviewState(cooperative=False)).linked) == 0


def test_wrong_input_is_one_line(tmp_path: Path, drive: FakeDrive) -> None:
    with pytest.raises(DataError, match=str(tmp_path)):
        open_model(tmp_path)
    with pytest.raises(DataError):
        open_model(Path("nowhere/at/all"))
    drive.frames = ()
    with pytest.raises(DataError, match="at least one frame"):
        ReviewModel([drive])


def test_object_details_give_motion_lights_and_visibility(truth_model: ReviewModel) -> None:
    view = truth_model.view(ReviewState(object_id=1003))
    details = view.details
    assert (details.object_id, details.class_name, details.lane, details.lights) == (
        1003,
        "car",
        "main_0",
        ("brake light",),
    )
    assert details.speed == pytest.approx(3.0) and details.acceleration == pytest.approx(-2.5)
    assert [s.points for s in details.visibility] == [40, 40, 40]
    assert [s.fraction for s in details.visibility] == [0.25, 1.0, 0.5]
    assert details.seen_by == BY_EGO
    assert view.layers[SELECTED].object_id.tolist() == [1003]
    assert truth_model.view(ReviewState(object_id=1000)).details.seen_by == BY_HELPER  # the ego's own body
    gone = truth_model.view(ReviewState(object_id=77))
    assert gone.details is None and len(gone.layers[SELECTED]) == 0
    assert truth_model.view(ReviewState()).details is None


def test_object_details_as_text(truth_model: ReviewModel) -> None:
    text = selection_report(truth_model.view(ReviewState(object_id=1003)).details)
    assert "<b>car 1003</b>, seen by the ego" in text
    assert "3.0 m/s, -2.5 m/s² · brake light · lane main_0" in text
    assert cells(text)[1] == ["ego", "40", "25 %"]
    unknown = selection_report(truth_model.view(ReviewState(object_id=1005)).details)
    assert "seen by the ego</p>" in unknown and ">4.4 × 1.9 × 1.6 m · 60.0 m away · 0.0 m/s</p>" in unknown
    assert cells(unknown)[-1] == ["roadside unit 1", "40", ""]


def test_a_detection_is_said_to_overlap_a_road_user_by_its_name(model: ReviewModel) -> None:
    cards = [selection_report(model.view(ReviewState(detection=rank)).details) for rank in range(5)]
    assert any(f"with car {number}" in card for card in cards for number in (1001, 1002, 1003, 1004, 1005))
    assert all("overlaps no object" in card or "with car 1" in card or "with truck 1" in card for card in cards)


def test_a_corruption_of_an_agent_changes_nothing_in_frames_without_it_and_the_page_says_so(
    truth_model: ReviewModel,
) -> None:
    clean = truth_model.view(ReviewState())
    for who, counts in (("1777", [0, 0, 0]), ("1002,1777", [0, 1, 0])):
        view = truth_model.view(ReviewState(corruption="beam_missing", severity=5, corrupted_agents=who))
        pairs = zip(clean.agents, view.agents, strict=True)
        assert [int(len(one.points) != len(other.points)) for one, other in pairs] == counts[: len(clean.agents)]
        assert ("no such agent in this frame" in view.notice) == (not any(counts))


def test_names_from_files_are_shown_as_they_are_and_are_no_html(truth_model: ReviewModel) -> None:
    details = truth_model.view(ReviewState(object_id=1003)).details
    text = selection_report(replace(details, lane='`<iframe srcdoc="<script>1</script>">'))
    assert "<iframe" not in text and "<script" not in text and "`&lt;iframe" in text
    assert quoted("a|b\n# c") == r"a\|b \# c"
