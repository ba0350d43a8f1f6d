"""Tracks are the road users: their number, motion, heading and life, whatever the frame or the order of the boxes."""

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from dsrc.closed_loop.tracking.settings import VEHICLE, TrackerSettings
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Percept, Tracks
from sim.boxes import CLASSES, Boxes, concatenate
from sim.geometry import pose_matrix, wrap_angle

CAR = [0.8, 4.5, 1.9, 1.6]
"""Height of the centre, length, width, height."""
SIZES = {"pedestrian": [0.9, 0.45, 0.6, 1.8], "bicycle": [0.8, 1.8, 0.65, 1.6], "motorcycle": [0.7, 2.2, 0.8, 1.4]}
"""The same of others."""


def percept(
    time_s: float,
    xy: ArrayLike,
    yaw: ArrayLike = 0.0,
    score: ArrayLike = 0.7,
    velocity: ArrayLike = np.nan,
    label: str = "car",
) -> Percept:
    """Return cars (or what `label` says), of their size, at positions (N, 2)."""
    xy = np.asarray(xy, float).reshape(-1, 2)
    n = len(xy)
    rows = np.column_stack([xy, np.tile(SIZES.get(label, CAR), (n, 1)), np.broadcast_to(yaw, n)])
    boxes = Boxes.from_array(rows, np.full(n, CLASSES.index(label)))
    return Percept(time_s, boxes, np.full(n, score, float), np.broadcast_to(velocity, (n, 2)).astype(float))


def follow(percepts: Sequence[Percept], settings: TrackerSettings | None = None) -> list[Tracks]:
    """Return the tracks after each percept, without latency."""
    tracker = Tracker(settings)
    return [tracker.update(each, each.time_s) for each in percepts]


def content(tracks: Tracks) -> list[bytes]:
    boxes = tracks.boxes
    arrays = [boxes.array, boxes.label, boxes.object_id, tracks.velocity, tracks.yaw_rate, tracks.position_sd]
    return [np.ascontiguousarray(array).tobytes() for array in [*arrays, tracks.score, tracks.unseen_s]]


def speeds(tracks: Tracks) -> NDArray[np.float64]:
    return np.hypot(*tracks.velocity.T)


# Motion


def test_a_car_at_35_m_per_s_is_tracked_from_its_second_detection() -> None:
    for dt in (0.1, 0.2):
        after = follow([percept(dt * k, [[100.0 - 35.0 * dt * k, 3.0]], yaw=np.pi) for k in range(4)])
        assert [len(tracks) for tracks in after] == [0, 1, 1, 1]
        assert [*after[-1].boxes.object_id] == [0]
        assert after[1].velocity[0] == pytest.approx([-35.0, 0.0], abs=2.0)
        assert after[-1].velocity[0] == pytest.approx([-35.0, 0.0], abs=0.3)


def test_a_standing_car_stands_although_its_boxes_jump() -> None:
    rng = np.random.default_rng(0)
    squared = []
    for _ in range(60):
        jumps = rng.normal(0.0, 0.2, (30, 2))
        squared.append([speeds(t)[0] ** 2 for t in follow([percept(0.1 * k, jumps[k]) for k in range(30)])[10:]])
    assert np.sqrt(np.mean(squared)) < 0.3
    assert np.sqrt(np.mean(squared, axis=0)).max() < 0.35


def test_two_neighbours_do_not_swap() -> None:
    tracker = Tracker()
    for k in range(10):
        tracker.update(percept(0.1 * k, [[0.0, 0.0], [0.0, 2.9]]), 0.1 * k)
    after = tracker.update(percept(1.0, [[0.0, 0.1], [0.0, 2.8]]), 1.0)
    assert after.boxes.center[:, 1] == pytest.approx([0.0, 2.9], abs=0.1)
    after = tracker.update(percept(1.1, [[0.0, 0.1], [0.0, -2.8]]), 1.1)
    assert after.boxes.center[:, 1] == pytest.approx([0.0, 2.9], abs=0.1)
    assert speeds(after).max() < 0.5


def test_a_turning_car_is_predicted_better_than_by_a_constant_velocity() -> None:
    rng = np.random.default_rng(4)
    rate, speed, ahead_s = 0.4, 8.0, 1.0
    error: dict[float, list[float]] = {VEHICLE.curvature_per_m: [], 0.0: []}

    def place(t: float) -> NDArray[np.float64]:
        return speed / rate * np.array([np.sin(rate * t), 1.0 - np.cos(rate * t)])

    for _ in range(20):
        noise = rng.normal(0.0, [0.15, 0.15, 0.03], (30, 3))
        percepts = [
            percept(0.1 * k, place(0.1 * k) + noise[k, :2], yaw=rate * 0.1 * k + noise[k, 2]) for k in range(30)
        ]
        for curvature, errors in error.items():
            tracker = Tracker(TrackerSettings(vehicle=msgspec.structs.replace(VEHICLE, curvature_per_m=curvature)))
            for each in percepts:
                now = tracker.update(each, each.time_s)
            later = tracker.update(None, now.time_s + ahead_s)
            errors.append(float(np.linalg.norm(later.boxes.center[0, :2] - place(later.time_s))))
            if curvature:
                assert now.yaw_rate[0] == pytest.approx(rate, abs=0.15)
    assert np.mean(error[VEHICLE.curvature_per_m]) < 0.6 * np.mean(error[0.0])


def test_a_braking_car_is_followed() -> None:
    """A car at 15 m/s brakes with 7 m/s2; after one second it still has 8 m/s."""
    times = np.arange(0.0, 3.01, 0.1)
    braking = np.maximum(times - 2.0, 0.0)
    after = follow([percept(t, [[15.0 * t - 3.5 * b**2, 0.0]]) for t, b in zip(times, braking, strict=True)])
    assert speeds(after[20])[0] == pytest.approx(15.0, abs=0.1)
    assert speeds(after[-1])[0] == pytest.approx(8.0, abs=2.0)


def test_a_pedestrian_walks_in_any_direction_of_its_box() -> None:
    after = follow([percept(0.1 * k, [[0.0, 0.14 * k]], yaw=0.0, label="pedestrian") for k in range(20)])
    assert after[-1].velocity[0] == pytest.approx([0.0, 1.4], abs=0.1)
    assert after[-1].yaw_rate[0] == 0.0


@pytest.mark.parametrize("labels", [("bicycle",), ("bicycle", "pedestrian"), ("bicycle", "bicycle", "pedestrian")])
def test_a_pedestrian_taken_for_a_bicycle_is_one_object_that_may_step_sideways(labels: tuple[str, ...]) -> None:
    """It stands for a second, then crosses at 2 m/s, and every percept has it as this or that."""
    steps = [max(k - 10, 0) for k in range(20)]
    after = follow(
        [percept(0.1 * k, [[0.0, 0.2 * n]], yaw=0.0, label=labels[k % len(labels)]) for k, n in enumerate(steps)]
    )
    assert [tracks.boxes.object_id.tolist() for tracks in after[2:]] == [[0]] * 18
    assert after[-1].velocity[0] == pytest.approx([0.0, 2.0], abs=0.3)


@pytest.mark.parametrize("other", ["bicycle", "motorcycle"])
def test_two_boxes_of_one_road_user_as_this_and_that_are_one_object(other: str) -> None:
    walker, rider = (percept(0.0, [[0.0, 0.0]], label=name) for name in ("pedestrian", other))
    boxes = concatenate([walker.boxes, rider.boxes])
    tracker = Tracker()
    for k in range(3):
        tracks = tracker.update(Percept(0.1 * k, boxes, np.array([0.9, 0.8]), np.full((2, 2), np.nan)), 0.1 * k)
    assert tracks.boxes.label.tolist() == [CLASSES.index("pedestrian")]


def test_a_pedestrian_beside_a_bicycle_is_another_object() -> None:
    boxes = concatenate(
        [percept(0.0, [[0.0, y]], label=name).boxes for name, y in (("bicycle", 0), ("pedestrian", 0.8))]
    )
    tracker = Tracker()
    for k in range(3):
        tracks = tracker.update(Percept(0.1 * k, boxes, np.full(2, 0.9), np.full((2, 2), np.nan)), 0.1 * k)
    assert sorted(tracks.boxes.label) == [CLASSES.index("bicycle"), CLASSES.index("pedestrian")]


def test_a_size_is_that_of_the_boxes_of_its_class() -> None:
    """A pedestrian whom every third percept takes for a bicycle is not a long pedestrian."""
    names = ["pedestrian", "pedestrian", "bicycle"]
    after = follow([percept(0.1 * k, [[0.0, 0.0]], label=names[k % 3]) for k in range(15)])
    assert [CLASSES[row] for row in after[-1].boxes.label] == ["pedestrian"]
    assert after[-1].boxes.size[0] == pytest.approx(SIZES["pedestrian"][1:])


def test_a_lost_pedestrian_and_a_bicycle_that_comes_to_its_place_are_one_object() -> None:
    standing = [percept(0.1 * k, [[0.0, 0.0]], score=1.0, label="pedestrian") for k in range(10)]
    aside = [max(2.4 - 0.8 * k, 0.0) for k in range(5)]
    coming = [percept(1.0 + 0.1 * k, [[0.0, y]], score=0.5, label="bicycle") for k, y in enumerate(aside)]
    after = follow([*standing, *coming])
    assert [tracks.boxes.object_id.tolist() for tracks in after[1:11]] == [[0]] * 10
    assert after[-1].boxes.object_id.tolist() == [0]


def test_a_turning_bicycle_is_predicted_around_its_turn() -> None:
    rate, speed, ahead_s = 0.6, 5.0, 1.0

    def place(t: float) -> NDArray[np.float64]:
        return speed / rate * np.array([np.sin(rate * t), 1.0 - np.cos(rate * t)])

    tracker = Tracker()
    for k in range(16):
        now = tracker.update(percept(0.2 * k, place(0.2 * k), yaw=rate * 0.2 * k, label="bicycle"), 0.2 * k)
    later = tracker.update(None, now.time_s + ahead_s)
    assert np.linalg.norm(later.boxes.center[0, :2] - place(later.time_s)) < 1.0
    assert now.yaw_rate[0] == pytest.approx(rate, abs=0.15)


@pytest.mark.parametrize("turn", [np.pi, 0.5 * np.pi, -0.5 * np.pi])
def test_a_moving_bicycle_faces_its_motion_however_its_boxes_lie(turn: float) -> None:
    after = follow([percept(0.2 * k, [[k, 0.0]], yaw=turn, label="bicycle") for k in range(12)])
    assert [*after[-1].boxes.object_id] == [0]
    assert after[-1].boxes.yaw[0] == pytest.approx(0.0, abs=0.15)
    assert after[-1].velocity[0] == pytest.approx([5.0, 0.0], abs=0.2)


def test_a_measured_velocity_is_believed_at_once() -> None:
    tracker = Tracker()
    tracks = tracker.update(percept(0.0, [[0.0, 0.0]], score=1.0, velocity=[12.0, 0.0]), 0.0)
    assert tracks.velocity[0] == pytest.approx([12.0, 0.0])
    tracks = tracker.update(percept(0.1, [[1.17, 0.0]], score=1.0, velocity=[11.4, 0.0]), 0.1)
    assert tracks.velocity[0] == pytest.approx([11.4, 0.0], abs=0.15)
    assert tracks.boxes.center[0, 0] == pytest.approx(1.17, abs=0.02)


# Heading


def test_a_moving_car_faces_its_motion_although_half_of_the_headings_point_backwards() -> None:
    yaw = 0.4
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    for first in (0, 1):
        after = follow([percept(0.1 * k, 0.8 * k * ahead, yaw=yaw + np.pi * ((k + first) % 2)) for k in range(20)])
        assert after[-1].boxes.yaw[0] == pytest.approx(yaw, abs=0.02)
        assert after[-1].velocity[0] == pytest.approx(8.0 * ahead, abs=0.1)


def test_a_standing_car_faces_where_most_of_its_headings_point() -> None:
    backwards = [True, False, False, False, True, False, False, False, False, True]
    after = follow([percept(0.1 * k, [[0.0, 0.0]], yaw=1.0 + np.pi * wrong) for k, wrong in enumerate(backwards)])
    assert after[-1].boxes.yaw[0] == pytest.approx(1.0, abs=0.05)
    assert speeds(after[-1])[0] < 0.1


def test_a_reversing_car_with_a_reported_velocity_keeps_its_heading() -> None:
    after = follow([percept(0.1 * k, [[-0.3 * k, 0.0]], score=1.0, velocity=[-3.0, 0.0]) for k in range(10)])
    assert after[-1].boxes.yaw[0] == pytest.approx(0.0, abs=1e-6)


def test_a_sure_car_that_lies_across_its_first_box_has_one_number() -> None:
    """Its first box alone confirms a track; the moving one that it starts as well is another."""
    for tracks in follow([percept(0.2 * k, [[3.0 * k, 0.0]], yaw=0.5 * np.pi, score=0.9) for k in range(8)]):
        numbers = tracks.boxes.object_id
        assert len(set(numbers.tolist())) == len(numbers) > 0
    assert tracks.velocity[-1] == pytest.approx([15.0, 0.0], abs=0.5)


def test_a_car_is_tracked_from_its_third_box_although_all_lie_across_it() -> None:
    """As detectors report a crossing car whose place they know and whose heading they do not."""
    for turn in (0.5 * np.pi, -0.5 * np.pi):
        after = follow([percept(0.2 * k, [[15.0 * 0.2 * k, 0.0]], yaw=turn) for k in range(6)])
        assert [len(tracks) for tracks in after] == [0, 0, 1, 1, 1, 1]
        assert after[2].velocity[0] == pytest.approx([15.0, 0.0], abs=1.0)
        assert [*after[-1].boxes.object_id] == [0]
        assert after[-1].velocity[0] == pytest.approx([15.0, 0.0], abs=0.5)
        assert after[-1].boxes.yaw[0] == pytest.approx(0.0, abs=0.05)


def test_a_box_across_a_moving_car_does_not_turn_it() -> None:
    after = follow([percept(0.1 * k, [[1.0 * k, 0.0]], yaw=1.5 if k in (6, 7, 11) else 0.0) for k in range(14)])
    assert max(abs(tracks.boxes.yaw[0]) for tracks in after[1:]) < 0.05
    assert after[-1].velocity[0] == pytest.approx([10.0, 0.0], abs=0.2)


def test_neighbours_that_are_found_in_turns_do_not_drive_into_each_other() -> None:
    """Two parked cars side by side, 3 m apart, of which each percept has one."""
    tracker = Tracker()
    for k in range(12):
        tracks = tracker.update(percept(0.1 * k, [[0.0, 3.0 * (k % 2)]], score=0.5), 0.1 * k)
        assert speeds(tracks).max(initial=0.0) < 0.5
    assert sorted(tracks.boxes.center[:, 1]) == pytest.approx([0.0, 3.0], abs=0.3)


# Life


def test_a_false_box_whose_score_does_not_confirm_it_never_appears() -> None:
    tracker = Tracker()
    assert len(tracker.update(percept(0.0, [[5.0, 5.0]], score=0.799), 0.0)) == 0
    for k in range(1, 30):
        assert len(tracker.update(percept(0.1 * k, np.zeros((0, 2))), 0.1 * k)) == 0


@pytest.mark.parametrize(("score", "needed"), [(1.0, 1), (0.8, 1), (0.79, 2), (0.3, 2), (0.2, 3), (0.15, 4)])
def test_surer_detections_confirm_sooner(score: float, needed: int) -> None:
    after = follow([percept(0.1 * k, [[0.0, 0.0]], score=score) for k in range(8)])
    assert [len(tracks) for tracks in after] == [0] * (needed - 1) + [1] * (9 - needed)
    assert after[-1].score[0] == pytest.approx(score)


def test_ghosts_that_lie_anywhere_are_no_track_and_a_steady_car_of_their_score_is() -> None:
    """Both are boxes of score 0.25 in every percept; the ghost's is drawn anew around one place."""
    rng = np.random.default_rng(7)
    known = {"ghost": 0, "car": 0}
    for _ in range(20):
        ghost, car = Tracker(), Tracker()
        for k in range(25):
            time_s = 0.2 * k
            known["ghost"] += len(ghost.update(percept(time_s, rng.normal(0.0, 1.5, 2), score=0.25), time_s))
            place = rng.normal([1.6 * k, 0.0], 0.15)
            known["car"] += len(car.update(percept(time_s, place, score=0.25), time_s))
    assert known["car"] > 0.8 * 20 * 25
    assert known["ghost"] < 0.1 * 20 * 25


def doubtful(settings: TrackerSettings | None = None) -> list[int]:
    """Numbers of known tracks when the boxes of a sure car turn doubtful: low scores, to either side of it."""
    sure = [percept(0.1 * k, [[0.0, 0.0]], score=0.7) for k in range(10)]
    low = [percept(0.1 * k, [[0.0, 0.75 * (-1) ** k]], score=0.2) for k in range(10, 30)]
    return [len(tracks) for tracks in follow([*sure, *low], settings)]


def test_a_track_whose_boxes_turn_doubtful_ends() -> None:
    known = doubtful()
    assert known[9] == 1 and 10 < known.index(0, 9) < 16
    assert 0 not in doubtful(TrackerSettings(refute_evidence=-4.0))[9:]  # which is as little as evidence can be
    longer = doubtful(TrackerSettings(most_evidence=30.0))
    assert longer.index(0, 9) > known.index(0, 9) + 3


def test_the_box_that_ends_a_track_may_start_the_next() -> None:
    """A doubtful track, a doubtful box 0.9 m beside it that ends it, and then a sure one there."""
    scores, aside = [0.3, 0.3, 0.2, 0.5, 0.5], [0.0, 0.0, 0.9, 0.9, 0.9]
    boxes = [percept(0.1 * k, [[0.0, y]], score=score) for k, (score, y) in enumerate(zip(scores, aside, strict=True))]
    assert [[*tracks.boxes.object_id] for tracks in follow(boxes)] == [[], [0], [], [1], [1]]


def test_a_doubtful_box_that_overlaps_a_sure_car_beyond_its_gate_does_not_end_it() -> None:
    sure = [percept(0.1 * k, [[0.0, 0.0]], score=0.8) for k in range(15)]
    jumped = [percept(0.1 * k, [[2.5, 0.0]], score=0.3) for k in range(15, 20)]
    assert all([*tracks.boxes.object_id] == [0] for tracks in follow([*sure, *jumped]))


def test_a_car_that_was_doubtful_for_long_is_confirmed_as_soon_as_it_is_found_well() -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        far = [percept(0.2 * k, rng.normal(0.0, 0.45, 2), score=0.15) for k in range(50)]
        near = [percept(0.2 * k, rng.normal(0.0, 0.1, 2), score=0.9) for k in range(50, 53)]
        assert len(follow([*far, *near])[-1]) == 1


def test_a_missed_percept_is_evidence_against_a_track() -> None:
    gone = [percept(0.05 * k, np.zeros((0, 2))) for k in range(10, 60)]
    seen = [percept(0.05 * k, [[0.0, 0.0]], score=1.0) for k in range(10)]
    lasted = [
        sum(len(tracks) for tracks in follow([*seen, *gone], TrackerSettings(missed_evidence=loss))[10:])
        for loss in (0.0, 0.7, 3.0)
    ]
    assert lasted[0] > lasted[1] > lasted[2] > 0


@pytest.mark.parametrize(
    "wrong", [{"ghosts_per_m2": 0.0}, {"confirm_evidence": -1.0}, {"confirm_evidence": 9.0}, {"least_evidence": 0.0}]
)
def test_bounds_of_the_evidence_that_contradict_each_other_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        TrackerSettings(**wrong)


def test_a_missed_car_coasts_and_is_forgotten_the_later_the_surer_it_was() -> None:
    lasted = {}
    for score in (0.3, 0.6, 1.0):
        tracker = Tracker()
        for k in range(10):
            tracker.update(percept(0.1 * k, [[1.0 * k, 0.0]], score=score), 0.1 * k)
        for k in range(10, 40):
            tracks = tracker.update(percept(0.1 * k, np.zeros((0, 2))), 0.1 * k)
            if len(tracks) == 0:
                break
            assert tracks.unseen_s[0] == pytest.approx(0.1 * (k - 9))
            assert tracks.boxes.center[0, 0] == pytest.approx(1.0 * k, abs=0.3)
        lasted[score] = 0.1 * (k - 9)
    assert 0.5 < lasted[0.3] < lasted[0.6] < lasted[1.0] < 1.6


def test_duplicates_of_one_car_are_one_track() -> None:
    for k, tracks in enumerate(follow([percept(0.1 * k, [[0.0, 0.0], [0.7, 0.1]]) for k in range(10)])):
        assert len(tracks) == (k > 0)


def test_a_car_that_jumps_beyond_its_gate_keeps_one_track_and_its_number() -> None:
    tracker = Tracker()
    for k in range(15):
        tracker.update(percept(0.1 * k, [[0.0, 0.0]]), 0.1 * k)
    for k in range(15, 25):
        tracks = tracker.update(percept(0.1 * k, [[2.0, 0.0]]), 0.1 * k)
        assert [*tracks.boxes.object_id] == [0]
    assert tracks.boxes.center[0, 0] == pytest.approx(2.0, abs=0.3)


def test_a_false_box_beside_a_car_takes_neither_its_next_box_nor_its_number() -> None:
    """A car at 16 m/s; the false box lies nearer to its next box than where it is expected, and could move anyhow."""
    tracker = Tracker()
    for k in range(6):
        places = [[3.2 * k, 0.0]] if k != 4 else [[3.2 * k, 0.0], [3.2 * k + 2.5, -1.8]]
        tracker.update(percept(0.2 * k, places, score=0.4), 0.2 * k)
    tracks = tracker.update(percept(1.2, [[3.2 * 6 - 0.5, -0.4]], score=0.4), 1.2)
    assert [*tracks.boxes.object_id] == [0]
    assert tracks.velocity[0] == pytest.approx([16.0, 0.0], abs=1.5)


def test_a_pedestrian_beside_a_car_is_another_object() -> None:
    car, walker = percept(0.0, [[0.0, 0.0]]), percept(0.0, [[0.3, 0.0]], label="pedestrian")
    boxes = Boxes.from_array(np.concatenate([car.boxes.array, walker.boxes.array]), [0, CLASSES.index("pedestrian")])
    tracker = Tracker()
    for k in range(3):
        tracks = tracker.update(Percept(0.1 * k, boxes, np.full(2, 0.9), np.full((2, 2), np.nan)), 0.1 * k)
    assert sorted(tracks.boxes.label) == [0, CLASSES.index("pedestrian")]


def test_the_class_of_a_vehicle_is_that_of_most_of_its_scores() -> None:
    labels = ["truck", "car", "truck", "truck", "car"]
    after = follow([percept(0.1 * k, [[0.0, 0.0]], label=label) for k, label in enumerate(labels)])
    assert [CLASSES[row] for row in after[-1].boxes.label] == ["truck"]


def test_height_and_size_are_smoothed() -> None:
    after = follow([percept(0.1 * k, [[0.0, 0.0]]) for k in range(10)])
    assert after[-1].boxes.center[0, 2] == pytest.approx(CAR[0])
    assert after[-1].boxes.size[0] == pytest.approx(CAR[1:])


# Time


def test_the_age_of_a_percept_is_made_up_for() -> None:
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.update(percept(0.1 * k, [[2.0 * k, 0.0]]), 0.1 * k + 0.3)
    assert tracks.time_s == pytest.approx(2.2)
    assert tracks.boxes.center[0, 0] == pytest.approx(20.0 * 2.2, abs=0.2)
    assert tracks.unseen_s[0] == pytest.approx(0.3)


def test_looking_at_the_present_between_percepts_changes_nothing() -> None:
    percepts = [percept(0.1 * k, [[1.0 * k, 0.02 * k * k]], yaw=0.04 * k) for k in range(12)]
    often, seldom = Tracker(), Tracker()
    for each in percepts:
        expected = seldom.update(each, each.time_s)
        tracks = often.update(each, each.time_s)
        for later in (0.02, 0.02, 0.07):
            often.update(None, each.time_s + later)
        assert content(tracks) == content(expected)


def test_a_percept_that_arrives_late_is_filtered_in_its_place() -> None:
    rng = np.random.default_rng(3)
    percepts = [percept(0.1 * k, rng.normal([[1.0 * k, 0.0], [0.0, 9.0]], 0.2)) for k in range(12)]
    expected, shuffled = Tracker(), Tracker()
    for each in percepts:
        in_order = expected.update(each, 2.0)
    for k in [*range(8), 9, 8, 11, 10]:
        late = shuffled.update(percepts[k], 2.0)
    assert content(late) == content(in_order)


def test_a_percept_older_than_all_that_is_remembered_is_ignored() -> None:
    tracker = Tracker()
    for k in range(20):
        before = tracker.update(percept(0.1 * k, [[0.0, 0.0]]), 2.0)
    assert content(tracker.update(percept(0.95, [[1.0, 0.0]]), 2.0)) == content(before)


def test_a_late_percept_never_moves_a_number_to_another_object() -> None:
    tracker = Tracker()
    xy = {0.0: [[0.0, 0.0]], 0.1: [[0.0, 0.0], [30.0, 0.0]], 0.3: [[0.0, 0.0], [30.0, 0.0], [60.0, 0.0]]}
    for time_s, places in [*xy.items(), (0.4, xy[0.3]), (0.5, xy[0.3])]:
        before = tracker.update(percept(time_s, places), 0.6)
    after = tracker.update(percept(0.2, xy[0.3]), 0.6)
    assert before.boxes.object_id.tolist() == after.boxes.object_id.tolist() == [0, 1, 2]
    assert after.boxes.center[:, 0] == pytest.approx([0.0, 30.0, 60.0], abs=0.01)


def test_without_percepts_tracks_grow_uncertain_and_end() -> None:
    tracker = Tracker()
    for k in range(5):
        tracker.update(percept(0.1 * k, [[0.0, 0.0]]), 0.1 * k)
    deviation = [tracker.update(None, t).position_sd for t in (0.5, 1.0, 2.0, 3.0)]
    assert (np.diff(np.concatenate(deviation)) > 0.0).all()
    assert len(tracker.update(None, 3.5)) == 0


def test_equal_times_and_irregular_intervals_are_no_error() -> None:
    tracker = Tracker()
    for t in (0.0, 0.0, 0.03, 0.03, 0.4, 0.41, 1.3):
        tracks = tracker.update(percept(t, [[10.0 * t, 0.0]]), t)
    assert [*tracks.boxes.object_id] == [0]
    assert tracks.velocity[0] == pytest.approx([10.0, 0.0], abs=0.5)


def test_nothing_to_track_is_no_error() -> None:
    tracker = Tracker()
    assert len(tracker.update(None, 0.0)) == 0
    tracks = tracker.update(percept(0.0, np.zeros((0, 2))), 0.1)
    assert tracks.velocity.shape == (0, 2)
    assert tracks.position_sd.shape == (0,)


def test_hundreds_of_cars_are_hundreds_of_tracks() -> None:
    grid = np.stack(np.meshgrid(np.arange(20) * 8.0, np.arange(20) * 4.0), axis=-1).reshape(-1, 2)
    after = follow([percept(0.1 * k, grid + np.array([1.5 * k, 0.0])) for k in range(4)])
    assert after[-1].boxes.object_id.tolist() == list(range(400))


def test_what_cannot_be_is_refused() -> None:
    tracker = Tracker()
    tracker.update(None, 1.0)
    with pytest.raises(ValueError, match="must not decrease"):
        tracker.update(None, 0.9)
    with pytest.raises(ValueError, match="must not be later"):
        tracker.update(percept(1.2, [[0.0, 0.0]]), 1.1)
    with pytest.raises(ValueError, match="NaN"):
        tracker.update(percept(1.1, [[np.nan, 0.0]]), 1.1)
    with pytest.raises(ValueError, match=r"Percept.score must be in 0 to 1"):
        tracker.update(percept(1.1, [[0.0, 0.0]], score=1.2), 1.1)


# Symmetries


def drive(seed: int) -> list[Percept]:
    """Return percepts of cars, pedestrians and bicycles with noise, gaps, false boxes and missing velocities.

    A pedestrian is now and then taken for a bicycle, and the other way round.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    place, yaw = rng.uniform(-40.0, 40.0, (n, 2)), rng.uniform(-np.pi, np.pi, n)
    speed, rate = rng.uniform(0.0, 20.0, n), rng.normal(0.0, 0.2, n)
    label = rng.choice([0, 2, 5, 6], n)
    speed[label == 6] *= 0.1
    size = np.array([SIZES.get(CLASSES[row], CAR)[1:] for row in label])
    percepts, time_s = [], 0.0
    for _ in range(12):
        dt = float(rng.choice([0.05, 0.1, 0.2]))
        time_s += dt
        yaw = yaw + rate * dt
        place = place + dt * speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        seen, false = rng.random(n) < 0.85, int(rng.integers(0, 3))
        noisy = np.column_stack([place, np.zeros(n), size, yaw]) + rng.normal(0.0, 1.0, (n, 7)) * [
            *(0.15, 0.15, 0.1, 0.1, 0.05, 0.05, 0.05)
        ]
        others = np.column_stack(
            [rng.uniform(-40, 40, (false, 2)), np.tile(CAR, (false, 1)), rng.uniform(-3.0, 3.0, false)]
        )
        rows = np.concatenate([noisy[seen], others])
        velocity = np.full((len(rows), 2), np.nan)
        told = np.flatnonzero(rng.random(len(rows)) < 0.2)
        velocity[told] = rng.normal(0.0, 5.0, (len(told), 2))
        taken = np.where((label > 4) & (rng.random(n) < 0.3), 11 - label, label)
        boxes = Boxes.from_array(rows, np.concatenate([taken[seen], np.zeros(false, np.int64)]))
        percepts.append(Percept(time_s, boxes, rng.uniform(0.2, 1.0, len(rows)), velocity))
    return percepts


@given(st.integers(0, 10_000))
def test_the_order_of_the_boxes_changes_no_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    percepts = drive(seed)
    shuffled = []
    for each in percepts:
        order = rng.permutation(len(each.boxes))
        shuffled.append(Percept(each.time_s, each.boxes[order], each.score[order], each.velocity[order]))
    for before, after in zip(follow(percepts), follow(shuffled), strict=True):
        assert content(before) == content(after)


@given(st.integers(0, 10_000), st.floats(-np.pi, np.pi), st.floats(-500.0, 500.0), st.floats(-500.0, 500.0))
def test_a_turned_and_moved_world_has_turned_and_moved_tracks(seed: int, angle: float, x: float, y: float) -> None:
    matrix = pose_matrix([x, y, 0.0], yaw=angle)
    percepts = drive(seed)
    elsewhere = [
        replace(each, boxes=each.boxes.transform(matrix), velocity=each.velocity @ matrix[:2, :2].T)
        for each in percepts
    ]
    for here, there in zip(follow(percepts), follow(elsewhere), strict=True):
        expected = here.boxes.transform(matrix)
        assert there.boxes.object_id.tolist() == expected.object_id.tolist()
        assert there.boxes.center == pytest.approx(expected.center, abs=1e-5)
        assert wrap_angle(there.boxes.yaw - expected.yaw) == pytest.approx(np.zeros(len(expected)), abs=1e-5)
        assert there.velocity == pytest.approx(here.velocity @ matrix[:2, :2].T, abs=1e-4)
        assert there.position_sd == pytest.approx(here.position_sd, abs=1e-5)
        assert there.score == pytest.approx(here.score)
