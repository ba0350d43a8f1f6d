"""The labs in a real Chromium: what they draw is seen, and their widgets are there."""

import time
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from dsrc.data.drives import open_drive
from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.output.screenshot import BrowserPage, find_chromium, open_page
from dsrc.review.page.panels.labs.sensor import SensorLabPanel
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from tests.dsrc.review.labs.drive import small_drive
from tests.dsrc.review.page.test_browser import PATIENCE_S, Opened, folder

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]
SIZE = (900, 600)
QUIET = frozenset({"truth", "bodies", "labels", "links", "world"})


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[BrowserPage, Session]]:
    """Page of a simulated drive in a browser, and the session that it belongs to."""
    app = ReviewApp(ReviewModel([open_drive(small_drive(tmp_path_factory.mktemp("data")))]), start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1", SIZE) as page:
            page.wait_for("document.querySelector('canvas') && window.__viserMutable", PATIENCE_S)
            (session,) = app.wait_session(1, PATIENCE_S)
            session.wait_drawn(PATIENCE_S)
            session.update(layers_off=QUIET)
            Opened(app, page).click(folder("Corruption lab"))
            yield page, session
    finally:
        app.close()


def image(session: Session) -> np.ndarray:
    render = {"height": SIZE[1], "width": SIZE[0], "transport_format": "png", "timeout": 60.0}
    session.client.get_render(**render)
    # The first picture can come before the browser has built all nodes.
    time.sleep(1.0)
    return session.client.get_render(**render)[..., :3].astype(int)


def shown(picture: np.ndarray, rgb: Sequence[int]) -> int:
    """Pixels of this colour, up to rounding."""
    return int(np.count_nonzero(np.abs(picture - np.array(rgb)).max(axis=-1) <= 3))


@pytest.mark.slow
def test_lost_points_are_seen_in_their_colour_and_parameters_have_sliders(opened: tuple[BrowserPage, Session]) -> None:
    page, session = opened
    session.update(corruption="point_dropping", parameters=(("share", 0.6),), color_by="fate", point_size_m=0.3)
    session.wait_drawn(PATIENCE_S)
    page.wait_for("document.body.innerText.includes('patch share')", PATIENCE_S)
    page.wait_for("[...document.querySelectorAll('th')].some(e=>e.textContent==='lost')", PATIENCE_S)
    assert shown(image(session), palette.LOST) > 50
    session.update(corruption="clean", color_by="agent")
    session.wait_drawn(PATIENCE_S)
    assert shown(image(session), palette.LOST) == 0


def test_the_points_of_a_cast_sensor_are_seen_in_their_colour(opened: tuple[BrowserPage, Session]) -> None:
    _, session = opened
    hidden = frozenset(agent.agent_id for agent in session.view.agents)
    session.update(sensor="vlp-16", carrier="pole", hidden=hidden, point_size_m=0.3)
    session.wait_drawn(PATIENCE_S)
    lab = next(panel for panel in session.panels if isinstance(panel, SensorLabPanel))
    end = time.monotonic() + PATIENCE_S
    while lab.cast is None and time.monotonic() < end:
        time.sleep(0.05)
    assert lab.cast is not None and len(lab.cast.sweep) > 500
    assert shown(image(session), palette.SENSOR) > 50
    session.update(sensor="")
    session.wait_drawn(PATIENCE_S)
    assert shown(image(session), palette.SENSOR) == 0
