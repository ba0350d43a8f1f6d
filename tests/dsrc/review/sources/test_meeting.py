"""The meeting of an episode: its contact or nearest pass, and how the two came to it."""

import math
import re

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Outcome
from dsrc.review.model import ReviewModel
from dsrc.review.over_time.strips import over_time
from dsrc.review.sources.episodes import episode_source
from dsrc.review.sources.meeting import meeting_of
from dsrc.review.state import ReviewState
from dsrc.review.texts import moment_report
from sim.contact import Contact
from sim.errors import ScenarioError
from tests.dsrc.closed_loop.logged import EGO_ID, Mover, ahead, episode

HIT = Contact(
    time_s=2.9, other_id=EGO_ID + 1, other="conflict", ego_speed_mps=10.0, closing_mps=10.0, delta_v_mps=5.0,
    side="front", at_fault=True,
)  # fmt: skip


def crash() -> EpisodeLog:
    """An ego at 10 m/s that reaches a car that stands 36 m ahead, and another one far away."""
    movers = [
        Mover("ego", ahead(10.0)),
        Mover("conflict", lambda t: (35.0, 0.0), yaw=0.0),
        Mover("far", lambda t: (-40.0, 20.0), yaw=0.0),
    ]
    return episode(movers, 30, Outcome.CRASHED, contact=HIT, perception="sight")


def passing() -> EpisodeLog:
    """An ego that passes a parked car at its side, 3 m from centre to centre, after two seconds."""
    movers = [Mover("ego", ahead(10.0)), Mover("parked", lambda t: (20.0, 3.0), yaw=0.0)]
    return episode(movers, 40, Outcome.ARRIVED)


def test_a_crash_is_met_at_its_contact_and_opens_two_seconds_before() -> None:
    met = meeting_of(crash())
    assert (met.name, met.row, met.opens, met.other_id) == ("contact", 29, 9, EGO_ID + 1)
    gap = 35.0 - 4.0 - 1.0 * np.arange(30)
    np.testing.assert_allclose(met.gap_m, gap, atol=0.02)
    np.testing.assert_allclose(met.ttc_s, gap / 10.0, atol=0.02)


def test_without_a_contact_it_is_the_nearest_pass() -> None:
    met = meeting_of(passing())
    assert met.name == "nearest pass" and met.other_id == EGO_ID + 1
    assert met.gap_m[met.row] == pytest.approx(1.0, abs=0.01) == np.nanmin(met.gap_m)
    assert 16 <= met.row <= 24 and met.opens == max(met.row - 20, 0)
    assert np.isinf(met.ttc_s[30:]).all(), "what lies behind is not reached"


def test_an_ego_alone_meets_nobody() -> None:
    met = meeting_of(episode([Mover("ego", ahead(10.0))], 5))
    assert met.other_id is None and np.isnan(met.gap_m).all()


def test_the_first_steps_and_the_cause_are_found_once_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    log = crash()
    monkeypatch.setattr("dsrc.review.sources.meeting.sight_of", lambda log: lambda now, object_id: now.time_s > 1.55)
    met = meeting_of(log)
    assert met.marks == {"contact": 29} and not met.explained
    met.explain(log)
    assert met.explained and met.marks == {"first sight": 16, "contact": 29}
    assert met.why.startswith("missed: the car 1001 was in sight")


def test_a_log_without_its_world_says_so_and_is_shown_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(log: EpisodeLog) -> None:
        raise ScenarioError("by_hand: network: no such file")

    monkeypatch.setattr("dsrc.review.sources.meeting.sight_of", lost)
    log = crash()
    met = meeting_of(log)
    met.explain(log)
    assert met.explained and met.why == "the cause is unknown: by_hand: network: no such file"


def test_a_contact_is_told_with_the_other_by_its_class_and_number() -> None:
    source = episode_source(crash())
    text = moment_report(source.moment(29), source.timeline(), 29)
    assert f"<b>contact</b> with car {EGO_ID + 1} at 10.0 m/s" in text and "messages" not in text, "nobody sends any"


def test_the_plots_of_an_episode_have_the_gap_and_the_contact() -> None:
    model = ReviewModel([episode_source(crash())])
    state = ReviewState(**model.opening(0))
    assert (state.frame, state.object_id) == (9, EGO_ID + 1)
    svg = over_time(model, state, model.view(state))
    for text in (">gap, m<", ">time to collision, s<", "wanted 0.0", "real 0.0", ">contact<"):
        assert text in svg
    assert math.isclose(float(re.search(r"gap, m</tspan><tspan[^>]*>([\d.]+)<", svg)[1]), 22.0, abs_tol=0.1)
