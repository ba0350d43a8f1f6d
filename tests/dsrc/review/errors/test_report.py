"""The errors of a whole run under a state: what is listed, against which run, where each is, and what is unknown."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from dsrc.review.errors import report as run
from dsrc.review.errors.filters import FN, FP
from dsrc.review.model import ReviewModel
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.state import ReviewState
from dsrc.review.worker import Worker
from sim.errors import SettingsError
from tests.dsrc.review.conftest import FakeDetector


class Blind(FakeDetector):
    """Finds nothing but the ghost."""

    def detect(self, sample: Sample) -> Detections:
        return super().detect(sample)[-1:]


@pytest.fixture
def filled(model: ReviewModel) -> ReviewModel:
    """All frames detected in, by a good method and a blind one."""
    source = model.sources[0]
    source.sets["blind"] = ComputedSet("blind", Blind())
    worker = Worker()
    for name in source.sets:
        worker.wait(worker.detect(model.stores[0], name, model.setup(ReviewState())), 60.0)
    worker.close()
    return model


STATE = ReviewState(threshold=0.3)


def test_a_report_holds_every_error_of_every_frame(filled: ReviewModel) -> None:
    report = run.run_report(filled, STATE)
    views = [filled.view(replace(STATE, frame=row)) for row in range(len(filled.sources[0]))]
    counts = report.counts["detector"]
    assert (counts.tp, counts.fp, counts.fn) == tuple(
        sum(getattr(v.counts, k) for v in views) for k in ("tp", "fp", "fn")
    )
    assert np.count_nonzero(report.errors.kind == FN) == counts.fn > 0
    assert np.count_nonzero(report.errors.kind == FP) == counts.fp > 0
    assert (report.known, report.total) == (12, 12)
    assert (np.diff(report.errors.loss) <= 0).all()


def test_the_ap_follows_the_filters(filled: ReviewModel) -> None:
    near = run.run_report(filled, replace(STATE, error_range="0-30"))
    everything = run.run_report(filled, STATE)
    assert near.counts["detector"].fn < everything.counts["detector"].fn
    assert near.curves["detector", 0.5].ap != everything.curves["detector", 0.5].ap
    assert (near.errors.distance_m <= 30.0).all() and len(near.errors) < len(everything.errors)


def test_an_error_is_where_the_view_has_its_box(filled: ReviewModel) -> None:
    report = run.run_report(filled, STATE)
    for kind in (FN, FP):
        row = int(np.flatnonzero(report.errors.kind == kind)[0])
        state = replace(STATE, **run.selection_of(report.errors, row))
        view = filled.view(state)
        np.testing.assert_allclose(run.place_of(filled, 0, report.errors, row), view.selected, atol=1e-3)
        assert run.shown_error(report.errors, state) == row
    assert run.shown_error(report.errors, STATE) == -1


def test_what_a_method_breaks_the_other_fixes(filled: ReviewModel) -> None:
    good, blind = (replace(STATE, methods=(name,)) for name in ("detector", "blind"))
    broken = run.listed_errors(filled, replace(blind, versus=f"{run.METHOD}detector", listed="broken"))
    fixed = run.listed_errors(filled, replace(good, versus=f"{run.METHOD}blind", listed="fixed"))
    assert len(broken) == len(fixed) == run.run_report(filled, good).counts["detector"].tp
    pairs = [set(zip(e.row.tolist(), e.object_id.tolist(), strict=True)) for e in (broken, fixed)]
    assert pairs[0] == pairs[1]
    assert len(run.listed_errors(filled, replace(good, versus=f"{run.METHOD}blind", listed="broken"))) == 0


def test_corrupted_sweeps_are_compared_with_clean_ones_unless_told_otherwise(filled: ReviewModel) -> None:
    assert run.other_run(STATE) is None
    assert run.other_run(replace(STATE, corruption="fog")) == STATE
    assert run.other_run(replace(STATE, versus="alone")) == replace(STATE, cooperative=False)
    with pytest.raises(SettingsError, match="against"):
        run.listed_errors(filled, replace(STATE, listed="broken"))


def test_frames_that_are_not_known_yet_are_named(model: ReviewModel) -> None:
    assert run.to_detect(model, STATE) == [("detector", model.setup(STATE))]
    model.view(STATE), model.view(replace(STATE, frame=1))
    assert run.first_unknown(model, STATE, 1) == 2
    assert run.first_unknown(model, replace(STATE, frame=1), -1) is None
    report = run.run_report(model, STATE)
    assert (report.known, report.total) == (2, 12)


def test_reports_are_kept_until_more_frames_are_known(model: ReviewModel) -> None:
    model.view(STATE)
    reports = run.Reports(model)
    first = reports.of(STATE)
    assert reports.of(replace(STATE, frame=5, color_by="height")) is first
    model.view(replace(STATE, frame=1))
    assert reports.of(STATE, patience_s=60.0) is first
    assert reports.of(STATE).known == 2
    assert reports.of(replace(STATE, threshold=0.5)) is not first


def test_a_report_is_of_the_agents_whose_sweeps_are_corrupted(model: ReviewModel) -> None:
    reports, foggy = run.Reports(model), replace(STATE, corruption="beam_missing", severity=5)
    for who in ("all", "helpers"):
        model.view(replace(foggy, corrupted_agents=who))
    everyone, helpers = (reports.of(replace(foggy, corrupted_agents=who)) for who in ("all", "helpers"))
    assert everyone.errors.conditions == ("beam missing 5",)
    assert helpers.errors.conditions == ("beam missing 5, helpers",)


def test_a_curve_on_a_grid_ends_where_the_detector_does(filled: ReviewModel) -> None:
    curve = run.run_report(filled, replace(STATE, threshold=0.0)).curves["detector", 0.5]
    grid = np.linspace(0.0, 1.0, 101)
    precision = run.curve_on_grid(curve, grid)
    assert np.isnan(precision[grid > curve.recall[-1] + 1e-9]).all()
    assert (np.diff(precision[~np.isnan(precision)]) <= 1e-12).all()
