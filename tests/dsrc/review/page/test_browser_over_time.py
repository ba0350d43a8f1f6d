"""Plots over time in a real Chromium: a click goes to its instant."""

import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.output.screenshot import find_chromium, open_page
from dsrc.review.page.server import start_server
from tests.dsrc.review.page.test_browser import Opened, wait_for

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]

PLOT = "document.querySelector('svg[data-ends]')"


def test_a_click_on_a_plot_goes_to_its_instant_again_and_again(model: ReviewModel) -> None:
    app = ReviewApp(model, start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1&object=1003", (1000, 900)) as page:
            opened = Opened(app, page)
            opened.page.wait_for(f"{PLOT}?.textContent.includes('distance, m')", 30.0)
            for share, row in ((0.5, 6), (0.99, 11), (0.5, 6)):
                opened.resting_place_of(PLOT)
                x, y, width = page.evaluate(
                    f"(()=>{{const r={PLOT}.getBoundingClientRect();return [r.x,r.y,r.width]}})()"
                )
                opened.press(x + share * width, y + 30.0)
                wait_for(lambda row=row: opened.session.state.frame == row)
                opened.session.update(frame=1)
                opened.session.wait_drawn()
    finally:
        app.close()


@pytest.mark.slow
def test_a_click_on_a_bar_of_the_scores_selects_what_lies_there(model: ReviewModel) -> None:
    app = ReviewApp(model, start_server())
    bars = "[...document.querySelectorAll('svg[data-ends]')].find(e=>e.textContent.startsWith('scores of hits'))"
    folder = "[...document.querySelectorAll('*')].filter(e=>e.innerText?.trim()==='Errors of the run').at(-1)"
    try:
        with open_page(f"{app.url}/?fixedDpr=1&frame=2", (1000, 900)) as page:
            opened = Opened(app, page)
            opened.click(folder)
            opened.resting_place_of(bars)
            x, y, width = page.evaluate(f"(()=>{{const r={bars}.getBoundingClientRect();return [r.x,r.y,r.width]}})()")
            opened.press(x + (8.0 + 0.425 * 264.0) / 280.0 * width, y + 50.0)
            wait_for(lambda: opened.session.state.detection is not None)
            details = opened.session.wait_drawn().details
            assert details.verdict == "false" and details.score == pytest.approx(0.4)
    finally:
        app.close()
