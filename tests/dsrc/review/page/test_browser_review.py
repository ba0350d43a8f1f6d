"""Errors, cells and live frames in a real Chromium."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from dsrc.review.errors.report import shown_error
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.app import LivePage, ReviewApp
from dsrc.review.page.cameras import LATE_S
from dsrc.review.page.cells import compare_address
from dsrc.review.page.commands import side_by_side
from dsrc.review.page.output.screenshot import find_chromium, open_page
from dsrc.review.page.server import start_server
from dsrc.review.sources.live import LiveSource
from tests.dsrc.review.conftest import FakeDetector, FakeDrive, street_frame
from tests.dsrc.review.page.test_browser import PATIENCE_S, SIZE, Opened, wait_for

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]


def press_n(opened: Opened, shift: bool = False) -> None:
    opened.key("N" if shift else "n", code="KeyN", text="n", windowsVirtualKeyCode=78, modifiers=8 if shift else 0)


@pytest.mark.slow
def test_n_flies_to_the_next_missed_object_and_says_when_there_is_none(model: ReviewModel) -> None:
    app = ReviewApp(model, start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1", SIZE) as page:
            opened = Opened(app, page)
            session = opened.session
            page.wait_for("document.body.innerText.includes('Errors of the run')", PATIENCE_S)
            press_n(opened)
            wait_for(lambda: session.state.object_id is not None)
            view = session.wait_drawn(PATIENCE_S)
            assert view.details.verdict == "missed"
            page.wait_for(f"document.body.innerText.includes('car {view.details.object_id}')", PATIENCE_S)
            # The camera's position and its point of view arrive one after the other.
            camera = session.client.camera
            wait_for(
                lambda: (
                    np.allclose(camera.look_at, view.selected, atol=0.05)
                    and abs(np.linalg.norm(np.array(camera.position) - view.selected) - 24.0) <= 1.0
                ),
                otherwise=lambda: f"camera at {camera.position}, looks at {camera.look_at}, asked for {view.selected}",
            )
            session.update(frame=11, object_id=None)
            session.wait_drawn(PATIENCE_S)
            press_n(opened)
            wait_for(lambda: session.state.object_id is not None)
            press_n(opened)
            page.wait_for("document.body.innerText.includes('No missed object after this one')", PATIENCE_S)
            press_n(opened, shift=True)
            wait_for(lambda: session.state.frame == 10)
            errors = session.report(session.state).errors
            assert shown_error(errors, session.state) >= 0
    finally:
        app.close()


def test_two_cells_have_one_camera_after_a_drag(model: ReviewModel, fake_fog: list[tuple[int, str, int]]) -> None:
    app = ReviewApp(model, start_server())
    try:
        with open_page(app.url + compare_address("frame=2", "frame=2&corruption=fog"), (1200, 600)) as page:
            left, right = app.wait_session(2, PATIENCE_S)
            if left.state.corruption == "fog":
                left, right = right, left
            wait_for(lambda: left.pair is right.pair is not None and left.view is not None and right.view is not None)
            assert (left.state.corruption, right.state.corruption) == ("clean", "fog")
            for cell in (left, right):
                cell.wait_drawn(PATIENCE_S)
            # A drag before a browser has taken the pose that it was given is undone by it; later than that none waits.
            given = [cell.camera for cell in (left, right)]
            wait_for(lambda: all(c._given is None or time.monotonic() > c._given_at + LATE_S for c in given))
            before = np.array(left.client.camera.position)
            move = {"button": "left", "buttons": 1, "clickCount": 1}
            page.send("Input.dispatchMouseEvent", type="mousePressed", x=300, y=300, **move)
            for x in range(310, 420, 10):
                page.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=300, **move)
            page.send("Input.dispatchMouseEvent", type="mouseReleased", x=420, y=300, **move)
            wait_for(lambda: np.linalg.norm(np.array(left.client.camera.position) - before) > 2.0)

            def same(name: str) -> bool:
                one, other = (np.array(getattr(cell.client.camera, name)) for cell in (left, right))
                return bool(np.allclose(one, other, rtol=0.0, atol=0.01))

            wait_for(lambda: same("position") and same("look_at"), PATIENCE_S)
            left.update(frame=6)
            wait_for(lambda: right.view.index == 6)
            wait_for(lambda: "frame%3D6" in page.evaluate("location.search"))
            assert page.evaluate("[...document.querySelectorAll('h1')].map(e=>e.textContent)") == ["clean", "fog 3"]
    finally:
        app.close()


def test_four_cells_show_one_frame_each_with_its_own_counts(
    model: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    links = ("frame=2", "frame=2&cooperative=0", "frame=2&corruption=fog", "frame=2&corruption=fog&cooperative=0")
    app = ReviewApp(model, start_server())
    try:
        with open_page(app.url + compare_address(*links), (1400, 1000)) as page:
            cells = app.wait_session(4, PATIENCE_S)
            for cell in cells:
                cell.wait_drawn(PATIENCE_S)
            found = {(cell.state.corruption, cell.state.cooperative) for cell in cells}
            assert found == {(kind, together) for kind in ("clean", "fog") for together in (True, False)}
            cells[0].update(frame=5)
            wait_for(lambda: all(cell.view.index == 5 for cell in cells))
            every = "[...document.querySelectorAll('iframe')].map(e=>e.contentDocument.body.innerText)"
            page.wait_for(f"{every}.every(text=>text.includes('Frame 5')&&text.includes('recall'))", PATIENCE_S)
            titles = page.evaluate("[...document.querySelectorAll('h1')].map(e=>e.textContent)")
            assert len(set(titles)) == 4 and sum("fog 3" in title for title in titles) == 2
    finally:
        app.close()


def test_a_folder_of_kitti_shows_its_points_and_its_labels(tmp_path: Path) -> None:
    write_frame(tmp_path / "drive", street_frame(0))
    convert(data=tmp_path / "drive", out=tmp_path / "kitti", to="kitti", view="around")
    app = ReviewApp(open_model(tmp_path / "kitti"), start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1", SIZE) as page:
            opened = Opened(app, page)
            view = opened.session.wait_drawn(PATIENCE_S)
            assert len(view.ego.points) > 100 and len(view.truth) > 0
            page.wait_for("document.body.innerText.includes('No detector')", PATIENCE_S)
            digits = "document.body.innerText.replace(/\\s/g,'')"
            page.wait_for(f"{digits}.includes('{len(view.ego.points)}points')", PATIENCE_S)
    finally:
        app.close()


def test_the_first_picture_does_not_wait_for_the_detector(drive: FakeDrive) -> None:
    waits, asked = threading.Event(), []

    class Slow(FakeDetector):
        def detect(self, sample: Sample) -> Detections:
            asked.append(app.pictured.is_set())
            waits.wait(PATIENCE_S)
            return super().detect(sample)

    app = ReviewApp(ReviewModel([drive], Slow()), start_server())
    app.pictured.clear()
    try:
        with open_page(f"{app.url}/?fixedDpr=1", SIZE) as page:
            (session,) = app.wait_session(1, PATIENCE_S)
            nodes = "Object.entries(window.__viserMutable?.nodeRefFromName||{})"
            page.wait_for(f"{nodes}.some(([name,node])=>name.endsWith('/points')&&node)", PATIENCE_S)
            wait_for(lambda: asked)
            assert session.view is None
            waits.set()
            assert session.wait_drawn(PATIENCE_S).counts is not None
            assert all(asked)
    finally:
        app.close()


@pytest.mark.parametrize(
    ("link", "line", "frame"),
    [
        pytest.param("frame=40", "link: frame: expected 0 to 11, found 40", 11, marks=pytest.mark.slow),
        ("frame=4&object=77", "link: object: expected one of the objects of street, found 77", 4),
        pytest.param(
            "frame=4&ego=5", "link: ego: expected agents of frame 4, 1000, 1002, -1, found 5", 4, marks=pytest.mark.slow
        ),
        ("drive=gone&frame=4&object=1003", "link: drive: expected street, found gone", 0),
        pytest.param("frame=4&corruption=gone", "link: corruption: expected clean, ", 4, marks=pytest.mark.slow),
    ],
)
def test_a_link_to_what_is_gone_is_told_in_a_line_and_the_nearest_is_shown(
    model: ReviewModel, link: str, line: str, frame: int
) -> None:
    app = ReviewApp(model, start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1&{link}", (700, 600)) as page:
            opened = Opened(app, page)
            page.wait_for(f"document.body.innerText.includes({line!r})", PATIENCE_S)
            assert opened.text().count("link: ") == 1
            page.wait_for(f"document.body.innerText.includes('Frame {frame} ')", PATIENCE_S)
            wait_for(lambda: opened.session.state.object_id is None)
            assert opened.session.view.index == frame and opened.session.view.counts is not None
    finally:
        app.close()


def test_a_page_of_a_running_simulation_grows() -> None:
    with LivePage(LiveSource("street")) as live, open_page(f"{live.url}/?fixedDpr=1", SIZE) as page:
        (session,) = live.app.wait_session(1, PATIENCE_S)
        page.wait_for("document.body.innerText.includes('first frame to come')", PATIENCE_S)
        for index in range(4):
            live.source.put(street_frame(index))
            wait_for(lambda index=index: session.view is not None and session.view.index == index)
        page.wait_for("document.body.innerText.includes('Frame 3')", PATIENCE_S)
        page.wait_for("!document.body.innerText.includes('first frame to come')", PATIENCE_S)


PREFIX = b"/user/me/proxy/1"


@contextlib.contextmanager
def proxy(port: int) -> Iterator[str]:
    """Serve a port of this machine below a path of another one, as JupyterHub does; yields that address."""
    server = socket.create_server(("127.0.0.1", 0))
    opened = [server]

    def pipe(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while some := source.recv(1 << 16):
                sink.sendall(some)
            sink.shutdown(socket.SHUT_WR)

    def forward(browser: socket.socket, page: socket.socket) -> None:
        with contextlib.suppress(OSError):
            page.sendall(browser.recv(1 << 16).replace(b"GET " + PREFIX, b"GET ", 1))
            pipe(browser, page)

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                browser, page = server.accept()[0], socket.create_connection(("127.0.0.1", port))
                opened.extend((browser, page))
                for run, ends in ((forward, (browser, page)), (pipe, (page, browser))):
                    threads.append(threading.Thread(target=run, args=ends))
                    threads[-1].start()

    threads = [threading.Thread(target=serve)]
    threads[0].start()
    try:
        yield f"http://127.0.0.1:{server.getsockname()[1]}{PREFIX.decode()}"
    finally:
        for one in opened:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join(5.0)
        for one in opened:
            one.close()


@pytest.mark.slow
def test_the_page_and_its_cells_work_below_a_path_of_a_proxy(model: ReviewModel) -> None:
    app = ReviewApp(model, start_server())
    try:
        with proxy(app.server.get_port()) as address, open_page(f"{address}/?fixedDpr=1&frame=2", SIZE) as page:
            opened = Opened(app, page)
            assert opened.session.view.index == 2
            page.wait_for("location.search.includes('view=')", PATIENCE_S)
            side_by_side(opened.session)
            page.wait_for("location.pathname.endsWith('/compare')", PATIENCE_S)
            assert page.evaluate("location.pathname") == f"{PREFIX.decode()}/compare"
            wait_for(lambda: len(app.sessions) == 2)
            for session in app.wait_session(2, PATIENCE_S):
                assert session.wait_drawn(PATIENCE_S).index == 2
    finally:
        app.close()
