"""Who helped, in a real Chromium: boxes in the colours of the agents, the legend, the card and the way back."""

import numpy as np
import pytest

from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.output.screenshot import find_chromium, open_page
from dsrc.review.page.server import start_server
from dsrc.review.sources.results import SharedSource
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.test_browser import PATIENCE_S, SIZE, Opened, shown
from tests.dsrc.review.shared import shared_street

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]


@pytest.mark.slow
def test_boxes_have_the_colour_of_who_helped_until_the_verdict_is_asked_for() -> None:
    app = ReviewApp(ReviewModel([SharedSource(FakeDrive(), shared_street())], FakeDetector()), start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1&object=1004&off=bodies,labels,links,world", SIZE) as page:
            opened = Opened(app, page)
            session = opened.session
            session.update(hidden=frozenset({1000, 1002, -1}))
            session.wait_drawn(PATIENCE_S)
            image = opened.image()
            for row in range(3):
                assert shown(image, palette.AGENT_COLORS[row]) > 15, f"box of agent {row}"
            assert shown(image, palette.FP) > 5 and shown(image, palette.FN) > 15  # harmed, missed
            assert shown(image, palette.TP) == 0
            for text in ("coloured by who helped most", "who helped", "ego alone"):
                page.wait_for(f"document.body.innerText.includes('{text}')", PATIENCE_S)
            session.update(boxes_by="verdict")
            session.wait_drawn(PATIENCE_S)
            page.wait_for("location.search.includes('boxes=verdict')", PATIENCE_S)
            judged = opened.image()
            assert shown(judged, palette.TP) > 15
            colors = np.array([palette.AGENT_COLORS[row] for row in range(3)])
            assert all(shown(judged, rgb) == 0 for rgb in colors)
    finally:
        app.close()
