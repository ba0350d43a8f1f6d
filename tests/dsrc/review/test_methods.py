"""Several methods in one page: recorded or computed, judged or drawn over each other, listed and compared."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.evaluation.detection_table import one_frame
from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.review.errors.filters import FN
from dsrc.review.errors.judgements import DETECTOR
from dsrc.review.model import ReviewModel
from dsrc.review.sources.base import MemorySet, Setup
from dsrc.review.sources.episodes import episode_source
from dsrc.review.sources.live import LiveSource
from dsrc.review.state import ReviewState
from dsrc.review.view import DETECTED_TRUTH, FALSE_NEGATIVES, TRUE_POSITIVES
from sim.errors import SettingsError
from tests.dsrc.closed_loop.test_log import full_log
from tests.dsrc.review.conftest import street_frame

STATE = ReviewState(threshold=0.0)
FOG = replace(STATE, corruption="fog")


@pytest.fixture
def two(model: ReviewModel) -> ReviewModel:
    """The detector, and a recorded method that finds the first object of frames 0 to 3 alone."""
    weak = MemorySet("weak")
    for row in range(4):
        model.view(replace(STATE, frame=row))
        table = model.sources[0].sets[DETECTOR].get(row, Setup())
        (result,) = table.results()
        truth, points = result.truth, table.points
        weak.put(row, one_frame(row, row, 1000, result.detections[:1], truth, points))
    model.sources[0].sets["weak"] = weak
    return model


def test_the_first_method_is_judged_and_others_are_drawn_over_it(two: ReviewModel) -> None:
    alone = two.view(STATE)
    both = two.view(replace(STATE, methods=(DETECTOR, "weak")))
    assert (alone.method, alone.compared) == (DETECTOR, ()) and two.methods(0) == [DETECTOR, "weak"]
    (weak,) = both.compared
    assert both.counts == alone.counts and weak.name == "weak"
    assert (len(weak.hits), len(weak.false)) == (1, 0) and weak.counts.tp == 1 < both.counts.tp
    assert len(weak.missed) == weak.counts.fn
    other = two.view(replace(STATE, methods=("weak", DETECTOR)))
    assert other.method == "weak" and other.counts == weak.counts
    np.testing.assert_allclose(other.layers[TRUE_POSITIVES].center, weak.hits.center)
    np.testing.assert_allclose(
        np.sort(other.layers[FALSE_NEGATIVES].center, axis=0), np.sort(weak.missed.center, axis=0), atol=1e-4
    )


def test_missing_recorded_detections_are_said_and_nothing_is_judged(
    two: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    missing = two.view(replace(STATE, frame=9, methods=("weak",)))
    assert missing.counts is None and "weak has no detections in this frame" in missing.notice
    assert len(missing.layers[DETECTED_TRUTH]) == 5
    foggy = two.view(replace(FOG, methods=("weak",)))
    assert foggy.notice == "weak has no detections in fog 3; it has them in clean."
    assert two.view(STATE).notice == "" and two.view(replace(STATE, frame=9, methods=("weak",))).counts is None


def test_an_unknown_method_is_one_line(two: ReviewModel) -> None:
    with pytest.raises(SettingsError, match="street: methods: expected a set of detections, found weka; did you mean"):
        two.view(replace(STATE, methods=("weka",)))


def test_the_index_is_of_the_known_frames_and_grows_with_them(two: ReviewModel) -> None:
    index = two.index(replace(STATE, methods=(DETECTOR, "weak")))
    assert [len(run.table) for run in index.runs.values()] == [4, 4]
    errors = index.errors(0.0, 0.5)
    missed = {
        name: np.count_nonzero((errors.kind == FN) & (errors.method == row)) for row, name in enumerate(index.runs)
    }
    assert missed == {
        name: sum(two.view(replace(STATE, frame=row, methods=(name,))).counts.fn for row in range(4))
        for name in index.runs
    }
    two.view(replace(STATE, frame=7))
    assert len(two.index(STATE).runs[DETECTOR].table) == 5
    curve = two.index(STATE).curves(0.5)[DETECTOR]
    results = two.sources[0].sets[DETECTOR].run(Setup()).results()
    assert all(isinstance(one, FrameResult) for one in results)
    assert curve.ap == evaluate(results).curves["bev", 0.5].ap


def test_recorded_detections_have_their_own_cooperation(two: ReviewModel) -> None:
    alone = two.index(replace(STATE, methods=(DETECTOR, "weak"), cooperative=False)).runs
    assert {name: run.setup.cooperative for name, run in alone.items()} == {DETECTOR: False, "weak": True}


def test_changes_are_those_between_methods_and_conditions(
    two: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    weak = replace(STATE, methods=("weak",))
    broken, fixed = two.changes(weak, STATE)
    assert fixed and not broken
    for row in range(4):
        two.view(replace(FOG, frame=row))
    assert {row for some in two.changes(STATE, FOG) for row, _ in some} <= {0, 1, 2, 3}
    with pytest.raises(SettingsError, match="expected a set of detections, found none"):
        ReviewModel([two.sources[0].drive]).changes(STATE, FOG)


def test_an_episode_is_drawn_with_what_its_ego_believed() -> None:
    log = full_log()
    source = episode_source(log)
    model = ReviewModel([source])
    state = ReviewState(frame=4, methods=("percepts", "tracks"), threshold=0.0)
    view = model.view(state)
    assert view.method == "percepts" and [one.name for one in view.compared] == ["tracks"]
    origin = model.origin(0)
    np.testing.assert_allclose(view.moment.tracks.center, source.moment(4).tracks.center - origin)
    np.testing.assert_allclose(view.moment.route, source.moment(4).route - origin[:2])
    assert model.sources[0].timeline().outcome == str(log.outcome) and view.labelled
    assert ReviewModel([source]).view(ReviewState()).moment.time_s == log.ticks[0].ego.time_s


def test_a_live_source_grows_under_the_page() -> None:
    live = LiveSource("live", kept=3)
    live.put(street_frame(0))
    model = ReviewModel([live])
    assert len(model.sources[0]) == 1 and len(model.view(ReviewState()).truth) == 6
    for row in range(1, 6):
        live.put(street_frame(row))
    assert (len(model.sources[0]), model.sources[0].first) == (6, 3)
    assert model.view(ReviewState(frame=5)).index == 5
    assert model.interval_s(0) == pytest.approx(0.1)
    assert model.sources[0].timeline() is None and model.view(ReviewState(frame=4)).moment is None
