"""An episode on the page: plan, tracks, links, claims and contact are drawn, and the course of the episode is told."""

from html import escape

import numpy as np
import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.commands import COMMANDS
from dsrc.review.page.panels.episode import EpisodePanel
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.panels.over_time import OverTimePanel
from dsrc.review.page.session import Session
from dsrc.review.sources.episodes import episode_source
from tests.dsrc.closed_loop.test_log import full_log
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.test_session import node, panel, wait_for


@pytest.fixture
def model() -> ReviewModel:
    return ReviewModel([episode_source(full_log())])


def lines(session: Session, name: str) -> int:
    handle = node(session, name)
    return 0 if handle is None or not handle.visible else len(handle.points)


def test_every_step_is_drawn_as_the_log_has_it(session: Session) -> None:
    ticks = full_log().ticks
    for row, tick in enumerate(ticks):
        session.update(frame=row)
        session.wait_drawn()
        drawn = {name: lines(session, f"/tracks/{name}") for name in ("boxes", "decisive", "second_ahead")}
        assert drawn["boxes"] + drawn["decisive"] == 13 * len(tick.tracks)
        assert drawn["second_ahead"] == len(tick.tracks)
        assert lines(session, "/claims/boxes") == 15 * sum(map(len, tick.claims.values()))
        links = session.view.moment.links
        placed = np.isfinite(links.line).all(axis=(1, 2))
        assert lines(session, "/links/received") == np.count_nonzero(placed & links.received)
        assert (lines(session, "/links/lost") > 0) == (placed & ~links.received).any()
        assert (lines(session, "/plan/contact") > 0) == (tick.contact is not None)


def test_a_world_that_cannot_be_rebuilt_is_told_on_the_first_frame(
    app: ReviewApp, connect_browser: type[SocketBrowser]
) -> None:
    session = connect_browser(app).session
    session.wait_drawn()
    told = session._notice
    assert told.visible and "roads and buildings are not drawn: " in told.content and "network" in told.content
    assert session.client.scene.get_handle_by_name("/drive0/world/grid") is not None
    session.update(frame=1)
    session.wait_drawn()
    assert not told.visible


def test_layers_of_an_episode_can_be_switched_off(session: Session) -> None:
    for name in ("plan", "tracks", "claims"):
        session.update(layers_off=frozenset({name}))
        session.wait_drawn()
        assert not node(session, f"/{name}").visible


def test_the_panel_says_why_the_driver_brakes_and_how_it_ends(session: Session) -> None:
    episode = panel(session, EpisodePanel)
    log = full_log()
    for row in (0, len(log) - 1):
        session.update(frame=row)
        session.wait_drawn()
        reason = log.ticks[row].decision.reason
        wait_for(lambda reason=reason: reason in episode.text.content)
        assert f"outcome: {log.outcome}" in episode.text.content
    assert episode.folder.visible


def test_a_drive_has_no_episode(
    model: ReviewModel, detector: FakeDetector, drive: FakeDrive, connect_browser: type[SocketBrowser]
) -> None:
    from dsrc.review.page.app import ReviewApp
    from dsrc.review.page.server import start_server

    app = ReviewApp(ReviewModel([drive]), start_server())
    try:
        session = connect_browser(app).session
        session.wait_drawn()
        assert not panel(session, EpisodePanel).folder.visible
        assert not node(session, "/plan").visible
    finally:
        app.close()


def test_missing_detections_are_explained(session: Session) -> None:
    session.update(corruption="fog")
    view = session.wait_drawn()
    report = panel(session, LegendPanel)
    assert "percepts has no detections in fog 3" in view.notice
    wait_for(lambda: escape(view.notice) in report.text.content)


def test_the_course_is_plotted_from_the_first_second_to_the_last(session: Session) -> None:
    course, log = panel(session, OverTimePanel), full_log()
    session.wait_drawn()
    for time_s in (log.ticks[0].ego.time_s, log.ticks[-1].ego.time_s):
        wait_for(lambda time_s=time_s: f">{time_s:.1f} s<" in course.plots.content)


def test_an_episode_opens_before_its_contact_and_a_key_goes_there(session: Session) -> None:
    run = {command.label: command.run for command in COMMANDS}
    met = session.model.sources[0].meeting
    assert met is not None
    session.update(frame=0)
    run["Episode: contact"](session)
    assert (session.state.frame, session.state.object_id) == (met.row, met.other_id)
    wait_for(lambda: met.explained)
    run["Episode: first sight"](session)
    told = panel(session, EpisodePanel)
    wait_for(lambda: "the cause is unknown" in told.text.content)
    assert "No first sight in this episode" in session._notice.content
