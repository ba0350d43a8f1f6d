"""An object over time: what the judged detections and the frames say of it."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.evaluation.detection_table import join_tables, one_frame
from dsrc.ops.detections import Detections
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.model import ReviewModel
from dsrc.review.over_time.strips import box_strips, over_time
from dsrc.review.sources.base import DriveSource, Setup
from dsrc.review.sources.history import MOST, DriveHistory
from dsrc.review.state import ReviewState
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.review.conftest import FakeDrive, street_frame


def read_all(history: DriveHistory) -> None:
    for row in history.lacking():
        history.read(row)


def test_a_history_has_distance_points_and_visibility_of_every_frame(drive: FakeDrive) -> None:
    history = DriveHistory(DriveSource(drive))
    assert history.lacking() == list(range(12))
    read_all(history)
    assert history.lacking() == []
    seen = history.of(1003, 1000)
    for row in range(12):
        frame = street_frame(row)
        column = frame.truth.object_id.tolist().index(1003)
        away = frame.truth.center[column, :2] - frame.agents[0].world_from_body[:2, 3]
        assert seen.distance_m[row] == pytest.approx(np.hypot(*away))
        assert [seen.points[one][row] for one in (1000, 1002, -1)] == frame.points_on[:, column].tolist()
        assert [seen.visible[one][row] for one in (1000, 1002, -1)] == [0.25, 1.0, 0.5]


def test_an_object_that_is_nowhere_has_no_course(drive: FakeDrive) -> None:
    history = DriveHistory(DriveSource(drive))
    read_all(history)
    seen = history.of(-5, 1000)
    assert len(seen.rows) == 12 and np.isnan(seen.distance_m).all()


def test_long_drives_are_read_at_equal_distances() -> None:
    lacking = DriveHistory(DriveSource(FakeDrive(frames=tuple(range(1000))))).lacking()
    assert len(lacking) <= MOST and set(np.diff(lacking)) == {4}


def test_a_frame_that_cannot_be_read_is_a_gap(drive: FakeDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(row: int) -> Frame:
        if row == 3:
            raise DataError("frame 3 is damaged")
        return street_frame(row)

    monkeypatch.setattr(drive, "read", read)
    history = DriveHistory(DriveSource(drive))
    read_all(history)
    assert np.flatnonzero(np.isnan(history.of(1003, 1000).distance_m)).tolist() == [3]


def test_a_selected_object_has_score_iou_points_visibility_and_distance(model: ReviewModel) -> None:
    state = ReviewState(frame=4, object_id=1003, threshold=0.65)
    assert over_time(model, ReviewState(), model.view(ReviewState())) == "", "nothing is selected"
    read_all(model.histories[0])
    svg = over_time(model, state, model.view(state))
    for title in ("score", "IoU", "points", "visible, %", "distance, m"):
        assert f">{title}<" in svg
    assert "≥ 0.65" in svg and "frame 0" in svg and ">11<" in svg
    alone = over_time(model, state, model.view(state)).count("<path")
    assert alone > 7


def test_points_that_a_corruption_takes_are_a_line_of_their_own(
    model: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    state = ReviewState(frame=4, object_id=1003, corruption="fog")
    view = model.view(state)
    read_all(model.histories[0])
    assert "left 60<" in over_time(model, state, view)
    clean = ReviewState(frame=4, object_id=1003)
    assert "left" not in over_time(model, clean, model.view(clean))


def test_a_false_box_is_followed_over_the_frames_and_not_the_object_beside_it(model: ReviewModel) -> None:
    for row in range(12):
        model.view(ReviewState(frame=row))
    state = ReviewState(frame=4, threshold=0.2)
    state = replace(state, detection=model.view(state).detected - 1)
    view = model.view(state)
    assert view.details.verdict == "false"
    read_all(model.histories[0])
    run = model.run(0, "detector", model.setup(state))
    strips = box_strips(run, model.histories[0].lidars(1000), view.details.rank, state)
    score, iou, distance = (strip.lines[0] for strip in strips)
    assert score.rows.tolist() == list(range(12))
    np.testing.assert_allclose(score.values, 0.4)
    assert not iou.values.any()
    np.testing.assert_allclose(distance.values, np.hypot(10.0, 25.0), rtol=1e-6)
    svg = over_time(model, state, view)
    assert "score of this box" in svg and "visible" not in svg


def test_a_false_box_that_is_gone_for_a_second_has_ended() -> None:
    rows = [0, 1, 2, 3, 20]
    tables = [one_frame(row, row, 1, Detections(Boxes.from_array([[9.0, 0, 0, 4, 2, 2, 0]]), np.ones(1)), Boxes.zeros())
              for row in rows]  # fmt: skip
    nothing = Detections(Boxes.zeros(), np.zeros(0))
    tables[4:4] = [one_frame(row, row, 1, nothing, Boxes.zeros()) for row in range(4, 20)]
    run = JudgedRun("detector", Setup(), join_tables(tables))
    lidars = {row: np.eye(4) for row in range(21) if row != 2}
    score, *_ = box_strips(run, lidars, 0, ReviewState(frame=1))
    assert score.lines[0].rows.tolist() == [0, 1, 3], "frame 2 is not read, frame 20 is too late"
