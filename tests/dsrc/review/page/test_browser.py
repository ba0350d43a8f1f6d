"""The page in a real Chromium: what only a browser can show."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.commands import COMMANDS, toggle_help
from dsrc.review.page.output.screenshot import BrowserPage, find_chromium, open_page
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]
SIZE = (1000, 600)
PATIENCE_S = 90.0
"""Longest time for which anything on the page is waited for, s: a browser that draws in software shares its cores."""
PLACE = """(()=>{const e=__SCRIPT__;if(!e)return null;
const seen=()=>{const r=e.getBoundingClientRect();return [r.x+r.width/2,r.y+r.height/2,r.width,r.height];};
let [x,y]=seen();
if(!e.contains(document.elementFromPoint(x,y))){e.scrollIntoView({block:'center'});[x,y]=seen();}
return e.contains(document.elementFromPoint(x,y))?seen():null;})()"""
"""Middle and size of an element on the screen, px; null while it is away or covered."""
HEAR = """window.heard='';addEventListener('click',e=>{const wanted=__SCRIPT__;
const met=document.elementFromPoint(e.clientX,e.clientY);
window.heard=wanted&&wanted.contains(met)?'it':met?met.outerHTML.slice(0,200):'nothing';},{capture:true,once:true})"""
"""Note what the next click meets, before the page acts on it."""
WORST = "[...document.querySelectorAll('a')].find(e=>e.getAttribute('href').includes('errors=missed'))"
"""First number of the overview that leads to missed objects."""
RUN = {command.label: command.run for command in COMMANDS}


def folder(title: str) -> str:
    """Script that finds the head of a folder, which opens it."""
    return f"[...document.querySelectorAll('*')].filter(e=>e.textContent.trim()==='{title}').pop()"


class Opened:
    """A page in a browser, with the session that it belongs to."""

    def __init__(self, app: ReviewApp, page: BrowserPage) -> None:
        self.app, self.page = app, page
        page.send("Emulation.setFocusEmulationEnabled", enabled=True)
        page.wait_for("document.querySelector('canvas') && window.__viserMutable", PATIENCE_S)
        self.session.wait_drawn(PATIENCE_S)

    @property
    def session(self) -> Session:
        """Session of the newest browser."""
        return self.app.wait_session(1, PATIENCE_S)[-1]

    def key(self, key: str, **more: Any) -> None:
        self.page.send("Input.dispatchKeyEvent", type="keyDown", key=key, **more)
        self.page.send("Input.dispatchKeyEvent", type="keyUp", key=key, **more)

    def press(self, x: float, y: float) -> None:
        """Press and release the mouse at a place on the screen, px."""
        for kind in ("mousePressed", "mouseReleased"):
            self.page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def click(self, script: str) -> None:
        """Click an element once it is there, rests and lies on top; again where the click met something else."""
        for _ in range(5):
            x, y = self.resting_place_of(script)
            self.page.evaluate(HEAR.replace("__SCRIPT__", script))
            self.press(x, y)
            wait_for(lambda: self.page.evaluate("window.heard"), otherwise=lambda: f"no click was heard: {script}")
            if self.page.evaluate("window.heard") == "it":
                return
        raise AssertionError(f"five clicks met something else, at last {self.page.evaluate('window.heard')}: {script}")

    def resting_place_of(self, script: str) -> tuple[float, float]:
        """Middle of an element on the screen, px, once nothing covers it and it has not moved for half a second."""
        self.page.wait_for(script, PATIENCE_S)
        end, place, since = time.monotonic() + PATIENCE_S, None, time.monotonic()
        while place is None or time.monotonic() < since + 0.5:
            now = self.page.evaluate(PLACE.replace("__SCRIPT__", script))
            if now is None or now != place:
                place, since = now, time.monotonic()
            assert time.monotonic() < end, f"it does not come to rest, or something covers it: {script}"
            time.sleep(0.1)
        return place[0], place[1]

    def text(self) -> str:
        return self.page.evaluate("document.body.innerText")

    def image(self) -> np.ndarray:
        render = {"height": SIZE[1], "width": SIZE[0], "transport_format": "png", "timeout": 60.0}
        self.session.client.get_render(**render)
        # The first picture can come before the browser has built all nodes.
        time.sleep(1.0)
        return self.session.client.get_render(**render)[..., :3].astype(int)


def wait_for(
    condition: Callable[[], object],
    timeout_s: float = PATIENCE_S,
    otherwise: Callable[[], str] = lambda: "nothing happened",
) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, otherwise()
        time.sleep(0.05)


@pytest.fixture(scope="module")
def opened(street: ReviewModel) -> Iterator[Opened]:
    app = ReviewApp(street, start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1", SIZE) as page:
            yield Opened(app, page)
    finally:
        app.close()


@pytest.fixture(autouse=True)
def afresh(opened: Opened) -> None:
    opened.session.update(**{field: getattr(ReviewState(), field) for field in ReviewState.__slots__})
    RUN["Camera: reset"](opened.session)
    opened.session.wait_drawn(PATIENCE_S)


def shown(image: np.ndarray, rgb: Sequence[int], tolerance: int = 3) -> int:
    """Pixels of exactly this colour, up to rounding."""
    return int(np.count_nonzero(np.abs(image - np.array(rgb)).max(axis=-1) <= tolerance))


def test_colours_are_shown_as_they_are_named_and_the_threshold_takes_detections_away(opened: Opened) -> None:
    session = opened.session
    quiet = frozenset({"bodies", "labels", "links", "world"})
    session.update(threshold=0.0, layers_off=quiet, hidden=frozenset({1000, 1002, -1}))
    session.wait_drawn(PATIENCE_S)
    image = opened.image()
    assert min(shown(image, rgb) for rgb in (palette.TP, palette.FP, palette.FN)) > 15
    session.update(threshold=1.0)
    session.wait_drawn(PATIENCE_S)
    image = opened.image()
    assert shown(image, palette.TP) == shown(image, palette.FP) == 0 and shown(image, palette.FN) > 50


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_an_agents_body_and_its_points_have_one_colour(opened: Opened, theme: str) -> None:
    session = opened.session
    session.update(
        theme=theme,
        color_by="agent",
        layers_off=frozenset({"truth", "detections", "labels", "world", "links"}),
        hidden=frozenset({1000, 1002, -1}),
    )
    session.place_camera("bev")
    session.wait_drawn(PATIENCE_S)
    bodies = opened.image()  # dark channels of lit roofs are up to nine steps brighter
    for row in (0, 1):
        assert shown(bodies, palette.AGENT_COLORS[row], 12) > 10, f"roof of agent {row}"


def test_the_address_bar_shows_the_link_and_a_reload_restores_the_page(opened: Opened) -> None:
    session = opened.session
    session.update(frame=5, iou=0.7)
    session.place_camera("chase")
    session.wait_drawn(PATIENCE_S)
    address = lambda: opened.page.evaluate("location.search")  # noqa: E731
    wait_for(lambda: "frame=5" in address() and "view=-34.00,0.00,21.00" in address(), otherwise=address)
    opened.page.send("Page.reload")
    wait_for(lambda: opened.session is not session and opened.session.view is not None, PATIENCE_S)
    again = opened.session
    assert again.wait_drawn(PATIENCE_S).index == 5
    assert (again.state.iou, again.state.camera) == (0.7, "chase")
    wait_for(lambda: np.allclose(again.client.camera.position, [-34.0, 0.0, 21.0], atol=0.02))


def test_a_lost_connection_comes_back_to_the_same_frame(opened: Opened) -> None:
    session = opened.session
    session.update(frame=4)
    session.wait_drawn(PATIENCE_S)
    wait_for(lambda: "frame=4" in opened.page.evaluate("location.search"))
    opened.app.server._websock_server.disconnect_all_clients()
    wait_for(lambda: opened.app.sessions and opened.session is not session, PATIENCE_S)
    assert opened.session.wait_drawn(PATIENCE_S).index == 4


def test_keys_work_after_a_choice_in_a_dropdown(opened: Opened) -> None:
    before = opened.session.state.frame
    option = "[...document.querySelectorAll('[role=option]')].find(e=>e.textContent==='fog')"
    shown = f"Boolean({option} && {option}.getBoundingClientRect().height)"

    def opens() -> Any:
        # A page that has just come back may take no click yet.
        if not opened.page.evaluate(shown):
            opened.click("[...document.querySelectorAll('input')].find(e=>e.value==='clean')")
            time.sleep(1.0)
        return opened.page.evaluate(shown)

    opened.click(folder("Corruption lab"))
    wait_for(opens)
    opened.click(option)
    wait_for(lambda: opened.session.state.corruption == "fog")
    time.sleep(0.3)
    opened.key("l", code="KeyL", text="l", windowsVirtualKeyCode=76)
    wait_for(lambda: opened.session.state.frame == before + 1)


def test_a_click_in_the_overview_opens_the_worst_of_a_cell_and_back_leads_out_again(opened: Opened) -> None:
    session = opened.session
    opened.page.evaluate("window.sameDocument = true")
    opened.click(WORST)
    wait_for(lambda: opened.app.sessions and opened.session is not session, PATIENCE_S)
    view = opened.session.wait_drawn(PATIENCE_S)
    assert view.details is not None and view.details.verdict == "missed"
    opened.page.wait_for(f"document.body.innerText.includes('car {view.details.object_id}')", PATIENCE_S)
    cause = "[...document.querySelectorAll('p')].find(e=>e.textContent.startsWith('missed, '))"
    lower = opened.page.evaluate(f"{cause}.getBoundingClientRect().bottom")
    assert 0.0 < lower < SIZE[1], "the cause is read without scrolling"
    wait_for(lambda: np.linalg.norm(np.array(opened.session.client.camera.look_at) - view.selected) < 0.1)
    assert opened.page.evaluate("window.sameDocument"), "the page was loaded again"
    worst = opened.session
    opened.page.evaluate("history.back()")
    wait_for(lambda: opened.app.sessions and opened.session is not worst, PATIENCE_S)
    assert opened.session.wait_drawn(PATIENCE_S).details is None


def test_a_click_is_not_lost_where_the_table_is_written_anew_under_the_pressed_mouse(opened: Opened) -> None:
    session = opened.session
    mouse = {"button": "left", "clickCount": 1}
    anew = f"""(()=>{{const pressed=({WORST}).matches(':active'),t=({WORST}).closest('table').parentElement;
    t.innerHTML=t.innerHTML;return pressed;}})()"""
    pressed = False
    while not pressed:  # what is written late moves the table from under the mouse
        x, y = opened.resting_place_of(WORST)
        opened.page.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **mouse)
        pressed = opened.page.evaluate(anew)
        opened.page.send("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, **mouse)
    wait_for(lambda: opened.app.sessions and opened.session is not session)
    details = opened.session.wait_drawn(PATIENCE_S).details
    assert details is not None and details.verdict == "missed"
    opened.page.wait_for(f"document.body.innerText.includes('car {details.object_id}')", PATIENCE_S)


def test_a_click_on_a_picture_of_the_gallery_opens_its_error_with_its_cause(opened: Opened) -> None:
    session = opened.session
    session.update(gallery=True)
    opened.click(folder("Errors by cause"))
    picture = (
        "[...document.querySelectorAll('a[href*=gallery]')].find(e=>e.querySelector('svg')&&e.title.includes('no box'))"
    )
    opened.click(picture)
    wait_for(lambda: opened.app.sessions and opened.session is not session, PATIENCE_S)
    details = opened.session.wait_drawn(PATIENCE_S).details
    assert details is not None and details.cause.startswith("no box")
    opened.page.wait_for("document.body.innerText.includes('no box overlaps it')", PATIENCE_S)
    assert opened.session.state.gallery


def test_help_opens_on_a_question_mark(opened: Opened) -> None:
    opened.key("?", code="Slash", text="?", modifiers=8)
    opened.page.wait_for("document.body.innerText.includes('Ten frames forward')", PATIENCE_S)
    toggle_help(opened.session)
    opened.page.wait_for("!document.body.innerText.includes('Ten frames forward')", PATIENCE_S)


@pytest.mark.parametrize(("layer", "field"), [("detections/fp", "detection"), ("truth/fn", "object_id")])
def test_a_click_on_a_box_opens_its_card(opened: Opened, layer: str, field: str) -> None:
    session = opened.session
    session.update(frame=1, threshold=0.0, layers_off=frozenset({"labels", "links"}))
    session.fly_to(session.wait_drawn(PATIENCE_S).layers[layer].center[0])
    session.wait_drawn(PATIENCE_S)
    opened.image()
    opened.press(SIZE[0] / 2, SIZE[1] / 2)
    wait_for(lambda: getattr(session.state, field) is not None)
    details = session.wait_drawn(PATIENCE_S).details
    words = f"score {details.score:.2f}, false" if field == "detection" else f"car {details.object_id}"
    opened.page.wait_for(f"document.body.innerText.includes('{words}')", PATIENCE_S)


def test_what_cannot_be_drawn_is_told_on_the_page_and_the_next_frame_is_drawn(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = opened.app.model.view

    def broken(state: ReviewState) -> FrameView:
        if state.frame == 3:
            raise KeyError("yaw of the bus")
        return view(state)

    monkeypatch.setattr(opened.app.model, "view", broken)
    opened.session.update(frame=3)
    opened.page.wait_for("document.body.innerText.includes('yaw of the bus')", PATIENCE_S)
    opened.session.update(frame=6)
    assert opened.session.wait_drawn(PATIENCE_S).index == 6
    opened.page.wait_for("!document.body.innerText.includes('yaw of the bus')", PATIENCE_S)


@pytest.mark.slow
def test_a_chasing_camera_is_within_a_metre_after_300_frames(opened: Opened) -> None:
    session = opened.session
    session.place_camera("chase")
    session.wait_drawn(PATIENCE_S)
    for frame in range(300):
        session.update(frame=frame)
        time.sleep(0.02)
    session.wait_drawn(PATIENCE_S)
    time.sleep(1.0)
    ego = session.view.ego.review_from_body[:3, 3]
    root = opened.page.evaluate("window.__viserMutable.nodePoseData['/drive0'].position")
    assert np.linalg.norm(ego) > 500.0
    away = np.linalg.norm(np.array(session.client.camera.position) - (ego + np.array(root)))
    assert away == pytest.approx(np.hypot(34.0, 21.0), abs=1.0)


def test_a_page_says_that_it_is_drawing_until_it_shows_a_frame(opened: Opened) -> None:
    text = "document.getElementById('review-drawing')"
    assert opened.page.evaluate(text) is None
    with opened.app._using_model, open_page(f"{opened.app.url}/?fixedDpr=1", (400, 300)) as page:
        page.wait_for(f"{text}?.innerText.startsWith('drawing') && document.querySelector('canvas')", PATIENCE_S)
        wait_for(lambda: len(opened.app.sessions) == 2, PATIENCE_S)
        opened.app._using_model.release()
        try:
            page.wait_for(f"!{text}", PATIENCE_S)
            assert opened.session.view is not None
        finally:
            opened.app._using_model.acquire()
    wait_for(lambda: len(opened.app.sessions) == 1)


def test_a_narrow_window_starts_with_the_legend_alone_and_moves_no_other_browser(opened: Opened) -> None:
    first = opened.session
    place = np.array(first.client.camera.position)
    with open_page(f"{opened.app.url}/?fixedDpr=1", (700, 500)) as page:
        wait_for(lambda: len(opened.app.sessions) == 2, PATIENCE_S)
        second = Opened(opened.app, page)
        assert second.session is not first
        second.session.update(frame=7)
        second.session.place_camera("bev")
        second.session.wait_drawn(PATIENCE_S)
        wait_for(lambda: "frame=7" in page.evaluate("location.search"))
        text = page.evaluate("document.body.innerText")
        assert "Corruption" not in text
        assert all(word in text for word in ("Frame 7", "this frame", "true box", "helper 1002"))
        time.sleep(1.0)
        assert first.state.frame == 0
        np.testing.assert_allclose(first.client.camera.position, place, atol=1e-3)
    wait_for(lambda: len(opened.app.sessions) == 1)


@pytest.mark.slow
def test_in_a_cell_of_half_a_narrow_window_the_sheet_of_panels_is_folded(opened: Opened) -> None:
    with open_page(f"{opened.app.url}/?fixedDpr=1", (365, 600)) as page:
        second = Opened(opened.app, page)
        page.wait_for(
            "document.body.innerText.includes('Review') && !document.body.innerText.includes('Play')", PATIENCE_S
        )
        second.click(folder("Review"))
        page.wait_for("document.body.innerText.includes('Play')", PATIENCE_S)
    wait_for(lambda: len(opened.app.sessions) == 1)


def test_type_is_legible_and_the_notice_of_software_goes_away(opened: Opened) -> None:
    with open_page(f"{opened.app.url}/?fixedDpr=1", (1440, 900)) as page:
        page.wait_for("document.body?.innerText.includes('Errors of the run')", PATIENCE_S)
        page.wait_for("!document.body.innerText.includes('Software WebGL')", PATIENCE_S)
        sizes = page.evaluate(
            "[...document.querySelectorAll('body *')].filter(e=>e.offsetParent&&[...e.childNodes].some("
            "n=>n.nodeType==3&&n.textContent.trim())).map(e=>[parseFloat(getComputedStyle(e).fontSize),e.innerText])"
        )
        assert len(sizes) > 20 and min(sizes)[0] >= 12.0, min(sizes)
    wait_for(lambda: len(opened.app.sessions) == 1, PATIENCE_S)
