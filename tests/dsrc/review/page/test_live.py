"""A page on frames that are still being made."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dsrc.cli.drive import Drive
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.truth import TruthPerception
from dsrc.review.page.app import LivePage
from dsrc.review.page.commands import COMMANDS
from dsrc.review.page.panels.episode import EpisodePanel
from dsrc.review.sources.episodes import EpisodeSource
from dsrc.review.sources.live import LiveSource
from sim.errors import SettingsError
from tests.dsrc.closed_loop.logged import EGO_ID
from tests.dsrc.closed_loop.test_log import full_log
from tests.dsrc.review.conftest import street_frame
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.test_session import handle, wait_for


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(LiveSource("street")) as page:
        yield page


def test_a_page_opened_before_the_first_frame_shows_it_when_it_comes(
    page: LivePage, connect_browser: type[SocketBrowser]
) -> None:
    session = connect_browser(page.app).session
    wait_for(lambda: "first frame to come" in session._notice.content)
    page.source.put(street_frame(0))
    wait_for(lambda: session.view is not None and session.view.index == 0)
    wait_for(lambda: not session._notice.visible)


def test_play_before_the_first_frame_waits_for_it(page: LivePage, connect_browser: type[SocketBrowser]) -> None:
    session = connect_browser(page.app).session
    wait_for(lambda: "first frame to come" in session._notice.content)
    session.toggle_play()
    time.sleep(0.3)
    session.toggle_play()
    page.source.put(street_frame(0))
    wait_for(lambda: session.view is not None and session.view.index == 0)


def test_first_and_last_are_the_ends_of_what_is_kept(connect_browser: type[SocketBrowser]) -> None:
    run = {command.label: command.run for command in COMMANDS}
    with LivePage(LiveSource("street", kept=3)) as page:
        for index in range(6):
            page.source.put(street_frame(index))
        page.source.end()
        session = connect_browser(page.app, "frame=5").session
        session.wait_drawn()
        run["First frame"](session)
        assert session.wait_drawn().index == 3 and not session._notice.visible
        run["Last frame"](session)
        assert session.wait_drawn().index == 5
        session.step(1, wrap=True)
        assert session.wait_drawn().index == 3
        session.step(-2)
        assert session.state.frame == 3


def test_the_newest_frame_is_followed_and_an_earlier_one_is_not_left(
    page: LivePage, connect_browser: type[SocketBrowser]
) -> None:
    page.source.put(street_frame(0))
    session = connect_browser(page.app).session
    for index in range(1, 5):
        page.source.put(street_frame(index))
        wait_for(lambda index=index: session.view is not None and session.view.index == index)
    wait_for(lambda: handle(session, "frame").max == 4)
    session.update(frame=1)
    session.wait_drawn()
    page.source.put(street_frame(5))
    wait_for(lambda: handle(session, "frame").max == 5)
    assert session.state.frame == 1
    session.step(100)
    page.source.put(street_frame(6))
    wait_for(lambda: session.view.index == 6)


def test_a_browser_that_comes_later_follows_the_newest_frame_unless_its_link_names_one(
    page: LivePage, connect_browser: type[SocketBrowser]
) -> None:
    for index in range(6):
        page.source.put(street_frame(index))
    late, stays = (connect_browser(page.app, link).session for link in ("", "frame=2"))
    assert (late.wait_drawn().index, stays.wait_drawn().index) == (5, 2)
    page.source.put(street_frame(6))
    wait_for(lambda: late.view.index == 6 and handle(stays, "frame").max == 6)
    assert stays.state.frame == 2


@pytest.mark.parametrize("link", ["", "frame=0"])
def test_a_browser_starts_at_no_frame_that_is_no_longer_kept(connect_browser: type[SocketBrowser], link: str) -> None:
    with LivePage(LiveSource("street", kept=2)) as page:
        for index in range(6):
            page.source.put(street_frame(index))
        page.source.end()
        assert connect_browser(page.app, link).session.wait_drawn().index == 4


def test_a_selected_detection_is_left_with_its_frame_and_a_selected_object_is_not(
    page: LivePage, connect_browser: type[SocketBrowser]
) -> None:
    page.source.put(street_frame(0))
    session = connect_browser(page.app).session
    session.wait_drawn()
    # A place in the order of the scores is another box in the next frame.
    session.update(detection=1)
    page.source.put(street_frame(1))
    wait_for(lambda: session.view.index == 1)
    assert session.state.detection is None
    session.update(object_id=1003)
    page.source.put(street_frame(2))
    wait_for(lambda: session.view.index == 2)
    assert session.state.object_id == 1003


def test_whoever_makes_frames_never_waits_for_the_page(page: LivePage, connect_browser: type[SocketBrowser]) -> None:
    connect_browser(page.app)
    frame = street_frame(0)
    started = time.perf_counter()
    for _ in range(200):
        page.source.put(frame)
    assert (time.perf_counter() - started) / 200 < 0.005


def test_generate_hands_every_frame_to_who_watches(tmp_path: Path) -> None:
    from dsrc.data.write import generate

    seen = []
    drive = generate(scenario="four_way", out=tmp_path, frames=2, seed=3, visibility=False, watch=seen.append)
    assert [frame.index for frame in seen] == [0, 1] and drive.is_dir()
    again = []
    generate(scenario="four_way", out=tmp_path, frames=2, seed=3, visibility=False, watch=again.append)
    assert again == [], "what is on disk is not made again"


def test_an_episode_that_is_driven_is_followed_with_its_plan(connect_browser: type[SocketBrowser]) -> None:
    log = full_log()
    source = EpisodeSource("episode")
    with LivePage(source) as page:
        session = connect_browser(page.app).session
        for row, tick in enumerate(log.ticks):
            source.put(tick, EGO_ID)
            wait_for(lambda row=row: session.view is not None and session.view.index == row)
        assert session.view.moment is not None and session.view.counts is not None
        text = next(panel for panel in session.panels if isinstance(panel, EpisodePanel)).text
        assert "outcome: running" in text.content
        source.end(str(log.outcome), log.message)
        wait_for(lambda: f"outcome: {log.outcome}" in text.content)


def test_the_loop_shows_every_step_to_who_watches() -> None:
    seen = []
    loop = ClosedLoop("four_way", TruthPerception(), settings=LoopSettings(duration_s=1.0))
    loop.run(1, lambda running: seen.append(running.tick))
    assert seen == loop.ticks and len(seen) > 5


def test_one_episode_alone_is_shown_while_it_is_driven() -> None:
    for options, told in (({"seed": (0, 1)}, "--view shows one episode"), ({"critical": "severity"}, "--view")):
        with pytest.raises(SettingsError, match=f"drive: .*{told}"):
            Drive(what="four_way", view=True, **options).run()
