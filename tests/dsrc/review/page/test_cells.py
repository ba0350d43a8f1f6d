"""Two cells show one moment from one camera, and differ in what is compared."""

import time
import urllib.request
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.browser import OPEN_KEY
from dsrc.review.page.cells import CellPair, cells_of, compare_address
from dsrc.review.page.commands import COMMANDS
from dsrc.review.page.link import write_link
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.sources.episodes import episode_source
from dsrc.review.state import ReviewState
from tests.dsrc.closed_loop.logged import Mover, ahead, episode
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.errors.test_report import Blind
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.test_session import wait_for

RUN = {command.label: command.run for command in COMMANDS}


@pytest.fixture
def model(drive: FakeDrive, detector: FakeDetector) -> ReviewModel:
    model = ReviewModel([drive], detector)
    model.sources[0].sets["blind"] = ComputedSet("blind", Blind())
    return model


def pose(browser: SocketBrowser) -> np.ndarray:
    return np.array(browser.session.client.camera.position)


@pytest.fixture
def cells(
    app: ReviewApp, connect_browser: type[SocketBrowser], fake_fog: list[tuple[int, str, int]]
) -> tuple[SocketBrowser, SocketBrowser]:
    left, right = connect_browser(app, "pair=a"), connect_browser(app, "pair=a&corruption=fog")
    for cell in (left, right):
        cell.session.wait_drawn()
    wait_for(lambda: left.session.pair is right.session.pair is not None and len(left.session.pair.cells) == 2)
    return left, right


def test_what_is_compared_is_methods_then_sweeps(model: ReviewModel) -> None:
    state = ReviewState(frame=3)
    assert [one.methods for one in cells_of(model, state)] == [("detector",), ("blind",)]
    both = replace(state, methods=("blind", "detector"))
    assert [one.methods for one in cells_of(model, both)] == [("blind",), ("detector",)]
    foggy = replace(state, corruption="fog")
    assert [one.corruption for one in cells_of(model, foggy)] == ["clean", "fog"]
    tuned = replace(foggy, parameters=(("extinction", 0.1),))
    assert [one.parameters for one in cells_of(model, tuned)] == [(), tuned.parameters], "clean sweeps have none"
    del model.sources[0].sets["blind"]
    assert [one.corruption for one in cells_of(model, state, "rain")] == ["clean", "rain"]
    four = cells_of(model, replace(both, corruption="fog"))
    expected = [(corruption, name) for corruption in ("clean", "fog") for name in ("blind", "detector")]
    assert [(one.corruption, *one.methods) for one in four] == expected, "two methods on clean and on corrupted sweeps"


def test_frames_threshold_and_selection_go_along_and_sweeps_do_not(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = (cell.session for cell in cells)
    left.update(frame=7, threshold=0.6, object_id=1003, methods=("blind",))
    wait_for(lambda: (right.state.frame, right.state.threshold, right.state.object_id) == (7, 0.6, 1003))
    assert (right.state.corruption, left.state.corruption, right.state.methods) == ("fog", "clean", ())
    right.step(-2)
    wait_for(lambda: left.state.frame == 5)


def arrive(*cells: SocketBrowser) -> None:
    """Report the poses that the browsers were given, until none is on its way."""

    def reported() -> bool:
        for cell in cells:
            given = cell.session.camera._given
            if given is not None:
                cell.look_from(given[0].position.tolist(), given[0].look_at.tolist())
                time.sleep(0.05)
        return all(cell.session.camera._given is None for cell in cells)

    wait_for(reported)


def test_a_camera_moves_the_other_and_no_echo_comes_back(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = cells
    arrive(left, right)
    left.look_from((5.0, 6.0, 7.0), (1.0, 2.0, 0.0))
    wait_for(lambda: np.allclose(pose(right), [5.0, 6.0, 7.0]))
    # What the other browser reports late is no motion of its user, nor is the arrival of what it was given.
    right.look_from((5.0, 6.0, 6.0), (1.0, 2.0, 0.0))
    right.look_from((5.0, 6.0, 7.0), (1.0, 2.0, 0.0))
    wait_for(lambda: right.session.camera._given is None)
    np.testing.assert_allclose(pose(left), [5.0, 6.0, 7.0])
    right.look_from((0.0, 6.0, 9.0), (1.0, 2.0, 0.0))
    wait_for(lambda: np.allclose(pose(left), [0.0, 6.0, 9.0]))


def test_a_fast_drag_ends_in_both_cells_at_one_pose(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = cells
    arrive(left, right)
    before = pose(right).tolist()
    for _ in range(5):
        for step in range(60):
            left.look_from((5.0, 6.0, 7.0 + step), (1.0, 2.0, 0.1 * step))
            right.look_from(before, (0.0, 0.0, 0.0))
        wait_for(lambda: np.allclose(right.camera["position"], [5.0, 6.0, 66.0]))
        wait_for(lambda: np.allclose(right.camera["look_at"], [1.0, 2.0, 5.9]))


def test_a_drag_before_the_browser_has_reported_its_place_moves_the_other_too(
    cells: tuple[SocketBrowser, SocketBrowser], monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right = cells
    arrive(right)
    monkeypatch.setattr("dsrc.review.page.cameras.LATE_S", 0.5)
    left.session.camera.reset()
    left.session.update(threshold=0.6)
    left.session.wait_drawn()
    left.look_from((5.0, 6.0, 7.0), (1.0, 2.0, 0.0))
    wait_for(lambda: np.allclose(pose(right), [5.0, 6.0, 7.0]))


def test_a_pose_that_a_slow_browser_was_given_long_ago_moves_no_other(
    cells: tuple[SocketBrowser, SocketBrowser], monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right = cells
    arrive(left, right)
    monkeypatch.setattr("dsrc.review.page.cameras.LATE_S", -1.0)
    for height in (7.0, 8.0, 9.0):
        left.look_from((5.0, 6.0, height), (1.0, 2.0, 0.0))
        wait_for(lambda height=height: np.allclose(pose(right), [5.0, 6.0, height]))
    for height in (7.0, 8.0, 9.0):
        right.look_from((5.0, 6.0, height), (1.0, 2.0, 0.0))
    wait_for(lambda: right.session.camera._given is None)
    np.testing.assert_allclose(pose(left), [5.0, 6.0, 9.0])
    right.look_from((5.0, 6.0, 7.0), (1.0, 2.0, 0.0))
    wait_for(lambda: np.allclose(pose(left), [5.0, 6.0, 7.0]))


def test_where_a_browser_looked_before_it_was_placed_moves_no_other(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = cells
    arrive(left, right)
    left.session.place_camera("chase")
    left.session.wait_drawn()
    wait_for(lambda: right.session.state.camera == "chase")
    right.session.wait_drawn()
    placed = pose(right).copy()
    left.look_from((3.0, 3.0, 3.0), (0.0, 0.0, 0.0))
    time.sleep(0.2)
    np.testing.assert_allclose(pose(right), placed)


def test_playing_takes_the_other_along(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = (cell.session for cell in cells)
    left.update(speed=4.0)
    left.toggle_play()
    wait_for(lambda: right.state.frame > 3)
    left.toggle_play()
    wait_for(lambda: right.state.frame == left.state.frame)


def test_pages_of_their_own_and_other_pairs_stay(
    app: ReviewApp, cells: tuple[SocketBrowser, SocketBrowser], connect_browser: type[SocketBrowser]
) -> None:
    alone, other = connect_browser(app), connect_browser(app, "pair=b")
    cells[0].session.update(frame=4)
    wait_for(lambda: cells[1].session.state.frame == 4)
    assert (alone.session.state.frame, other.session.state.frame) == (0, 0)


def test_a_cell_that_is_closed_leaves_its_pair(app: ReviewApp, cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = cells
    right.close()
    wait_for(lambda: len(app.sessions) == 1)
    wait_for(lambda: left.session.pair.cells == [left.session])
    left.session.update(frame=2)
    assert left.session.wait_drawn().index == 2


def test_a_key_opens_the_cells_and_another_press_leaves_them(
    session: Session, cells: tuple[SocketBrowser, SocketBrowser], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    for one in (session, cells[1].session):
        monkeypatch.setattr(one.client.local_storage, "set_item", lambda key, value: opened.append((key, value)))
    session.update(frame=3, corruption="fog")
    session.wait_drawn()
    RUN["Side by side, or one page"](session)
    RUN["Side by side, or one page"](cells[1].session)
    (_, address), (_, back) = [one for one in opened if one[0] == OPEN_KEY]
    assert address.startswith("/compare?cell=frame%3D3") and "corruption%3Dfog" in address.split("&cell=")[1]
    assert "corruption" not in address.split("&cell=")[0] and back.startswith("/?corruption=fog")


def test_the_page_of_the_cells_is_served(app: ReviewApp) -> None:
    with urllib.request.urlopen(app.url + compare_address("frame=1", "frame=1&corruption=fog"), timeout=10) as answer:
        assert answer.status == 200 and b"side by side" in answer.read()


def test_a_way_back_is_followed_too(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = (cell.session for cell in cells)
    for frame in (1, 0, 1):
        right.update(frame=frame)
        right.wait_drawn()
        wait_for(lambda frame=frame: left.state.frame == frame)
        left.wait_drawn()
    for object_id in (1003, None, 1003):
        left.update(object_id=object_id)
        left.wait_drawn()
        wait_for(lambda object_id=object_id: right.state.object_id == object_id)
        right.wait_drawn()


def test_what_is_broken_in_one_cell_is_no_list_of_the_other(cells: tuple[SocketBrowser, SocketBrowser]) -> None:
    left, right = (cell.session for cell in cells)
    right.update(listed="broken", error_class="truck")
    wait_for(lambda: left.state.error_class == "truck")
    left.wait_drawn(), right.wait_drawn()
    assert (left.state.listed, right.state.listed) == ("all", "broken")


class DrawnAtOnce:
    """Cell that tells its pair of each state."""

    def __init__(self, pair: CellPair, **changes: Any) -> None:
        self.state, self.pair, self.looks = ReviewState(**changes), pair, 0
        pair.add(self)

    def update(self, **changes: Any) -> None:
        self.looks += 1
        state = replace(self.state, **changes)
        if state != self.state:
            self.state = state
            self.pair.state_changed(self, state)


def test_a_cell_that_is_only_drawn_again_moves_no_other() -> None:
    pair = CellPair()
    left, right = DrawnAtOnce(pair), DrawnAtOnce(pair, corruption="fog")
    right.update(frame=1)
    before = left.looks
    right.update(severity=5)
    assert (left.state.frame, left.looks) == (1, before)
    left.update(frame=0)
    assert (left.state.frame, right.state.frame) == (0, 0)


def test_a_state_that_was_given_and_is_drawn_late_is_no_users() -> None:
    class Late:
        def __init__(self) -> None:
            self.state = ReviewState()

        def update(self, **changes: Any) -> None:
            self.state = replace(self.state, **changes)

    pair, ahead, late = CellPair(), Late(), Late()
    pair.add(ahead), pair.add(late)
    given = []
    for frame in (1, 2, 3):
        ahead.update(frame=frame)
        pair.state_changed(ahead, ahead.state)
        given.append(late.state)
    for state in given:
        pair.state_changed(late, state)
        assert ahead.state.frame == 3
    late.update(frame=2)
    pair.state_changed(late, late.state)
    assert ahead.state.frame == 2, "the user's own way back"


def test_a_cell_takes_what_a_later_one_lacks() -> None:
    class Cell:
        def __init__(self, **changes: Any) -> None:
            self.state = ReviewState(**changes)

        def update(self, **changes: Any) -> None:
            self.state = replace(self.state, **changes)

    pair, first, late = CellPair(), Cell(frame=9, corruption="fog"), Cell(corruption="rain")
    pair.add(first), pair.add(late)
    assert (late.state.frame, late.state.corruption) == (9, "rain")
    pair.state_changed(late, late.state)
    first.update(frame=12)
    pair.state_changed(late, late.state)
    assert first.state.frame == 12, "an echo does not set it back"


def test_all_methods_lie_over_each_other_at_a_key(session: Session) -> None:
    RUN["Methods over each other"](session)
    assert session.state.methods == ("detector", "blind")
    RUN["Methods over each other"](session)
    assert session.state.methods == ("detector",)


def test_one_episode_with_other_eyes_runs_in_step_and_the_shorter_waits_at_its_end(
    connect_browser: type[SocketBrowser],
) -> None:
    movers = [Mover("ego", ahead(10.0)), Mover("parked", lambda t: (20.0, 3.0), yaw=0.0)]
    logs = [episode(movers, steps, perception=eyes, seed=4) for steps, eyes in ((30, "sight"), (40, "truth"))]
    model = ReviewModel([*map(episode_source, logs), episode_source(episode(movers, 30, seed=5))])
    assert [model.twins(drive) for drive in range(3)] == [[1], [0], []]
    cells = cells_of(model, ReviewState(drive=1))
    assert [one.drive for one in cells] == [1, 0]
    names = [dict(parse_qsl(write_link(model, one)))["drive"] for one in cells]
    assert [name.rpartition(", ")[0].rpartition(", ")[2] for name in names] == ["truth", "sight"]
    app = ReviewApp(model, start_server())
    try:
        left, right = (connect_browser(app, f"pair=e&drive={drive}").session for drive in (0, 1))
        for cell in (left, right):
            cell.wait_drawn()
        wait_for(lambda: left.pair is right.pair is not None and len(left.pair.cells) == 2)
        for frame, there in ((12, 12), (35, 29), (36, 29), (20, 20)):
            right.update(frame=frame)
            wait_for(lambda there=there: left.state.frame == there)
            assert (left.state.drive, right.state.drive, right.state.frame) == (0, 1, frame)
    finally:
        app.close()
