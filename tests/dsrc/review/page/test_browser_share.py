"""What a page shares, in a real Chromium: a page that opens offline, a picture, a link."""

import base64
import io
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.cells import compare_address
from dsrc.review.page.offline.overlay import ROOMY_PX, overlay
from dsrc.review.page.offline.pages import LARGEST, picture_parts
from dsrc.review.page.output.export import picture, write_page
from dsrc.review.page.output.screenshot import BrowserPage, find_chromium, open_page
from dsrc.review.page.server import start_server
from dsrc.review.state import ReviewState
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.test_browser import PATIENCE_S, Opened, wait_for

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]

LINK = "frame=2&object=1005&gallery=1&score=0.7"
BUTTON = "[...document.querySelectorAll('button')].find(e=>e.innerText==='__NAME__')"
WORDS = """[...document.querySelectorAll('__WHERE__ svg text')].map(e=>e.textContent)
.filter(e=>e&&!/^(precision over recall|scores of hits)/.test(e)).sort().join('|')"""
"""Texts of the plots over time; those of scores are of the run, not of the selection."""
SENTENCES = "[...document.querySelectorAll('__WHERE__ a[title]')].map(e=>e.title)"


@pytest.fixture
def model() -> ReviewModel:
    return ReviewModel([FakeDrive(frames=tuple(range(12)))], FakeDetector())


@pytest.fixture
def opened(model: ReviewModel, tmp_path: Path) -> Iterator[Opened]:
    app = ReviewApp(model, start_server())
    try:
        with open_page(f"{app.url}/?fixedDpr=1&{LINK}", (1100, 700)) as page:
            page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
            yield Opened(app, page)
    finally:
        app.close()


def saved(opened: Opened, button: str, folder: Path, ending: str) -> Path:
    """File that the browser saves after a click on a button."""
    opened.click(BUTTON.replace("__NAME__", button))
    wait_for(lambda: list(folder.glob(f"*.{ending}")))
    (path,) = folder.glob(f"*.{ending}")
    return path


def words(page: BrowserPage, script: str) -> str:
    """Text of an element without what separates it."""
    return re.sub(r"[\s|]+", " ", page.evaluate(f"{script}.innerText")).strip()


def test_a_shared_page_opens_offline_with_the_numbers_of_the_live_one(opened: Opened, tmp_path: Path) -> None:
    live = opened.page
    opened.session.detect_all()
    wait_for(lambda: opened.session.report(opened.session.state).known == 12)
    # The live page reads the run and draws the gallery in the background.
    live.wait_for("document.body.innerText.includes('distance, m')", PATIENCE_S)
    live.wait_for(f"{SENTENCES.replace('__WHERE__', '')}.length>5", PATIENCE_S)
    time.sleep(3.0)
    card = words(live, "[...document.querySelectorAll('p')].find(e=>e.innerText.startsWith('car 1005')).parentElement")
    plots = live.evaluate(WORDS.replace("__WHERE__", ""))
    sentences = live.evaluate(SENTENCES.replace("__WHERE__", ""))
    counts = opened.session.wait_drawn().counts
    out = saved(opened, "Page", tmp_path, "html")
    assert out.name == "street_2.html" and out.stat().st_size <= LARGEST
    with open_page(f"{out.as_uri()}?fixedDpr=1", (1100, 700)) as page:
        page.wait_for("document.querySelector('[role=slider]')", PATIENCE_S)
        time.sleep(3.0)
        assert words(page, "document.getElementById('review-card')") == card and "missed" in card
        assert page.evaluate(WORDS.replace("__WHERE__", "#review-plots")) == plots
        assert page.evaluate(SENTENCES.replace("__WHERE__", "#review-side")) == sentences
        text = {
            name: page.evaluate(f"document.querySelector('[data-count={name}]').innerText")
            for name in ("true", "false", "missed")
        }
        assert text == {"true": str(counts.tp), "false": str(counts.fp), "missed": str(counts.fn)}
        assert page.evaluate("document.getElementById('review-summary').innerText").startswith("Frame 2 ·")
        place = "JSON.parse(window.__viserMutable.cameraControl.toJSON()).position"
        assert np.hypot(*np.subtract(page.evaluate(place), live.evaluate(place))[[0, 2]]) < 0.1


PANELS = """[...document.querySelectorAll('#review,#review-side')].map(e=>{
const r=e.getBoundingClientRect();return[r.left,r.top,r.right,r.bottom]})"""
READABLE = "[...document.querySelectorAll('[data-count=missed]')].filter(e=>e.checkVisibility()).map(e=>e.innerText)"


@pytest.mark.parametrize("width", [1100, 700, 400])
def test_legend_and_card_of_a_page_lie_apart_and_leave_a_narrow_one_to_the_scene(
    model: ReviewModel, tmp_path: Path, width: int
) -> None:
    out = write_page(model, LINK, tmp_path / "page.html", 2, ReviewState())
    with open_page(f"{out.as_uri()}?fixedDpr=1", (width, 700)) as page:
        page.wait_for(f"{READABLE}.length", PATIENCE_S)
        covered = sum((right - left) * (bottom - top) for left, top, right, bottom in page.evaluate(PANELS))
        assert covered < 0.2 * 700 * width or width >= ROOMY_PX
        folded = page.evaluate(READABLE)
        page.evaluate("document.querySelectorAll('#review,#review-side').forEach(e=>{e.open=true})")
        legend, card = page.evaluate(PANELS)
        assert legend[2] <= card[0] or legend[3] <= card[1]
        assert min(*legend, *card) >= 0 and max(legend[2], card[2]) <= width and max(legend[3], card[3]) <= 700
        assert page.evaluate(READABLE) == folded != []
        assert card[3] - card[1] > 100


def panels_of(image: np.ndarray) -> tuple[int, int, int]:
    """Pixels of the colours of hits and misses in the legend, and of white text on the card."""
    left, right = image[:330, :270].astype(int), image[14:330, -346:-16].astype(int)
    swatches = [np.count_nonzero(np.abs(left - rgb).max(axis=-1) <= 3) for rgb in (palette.TP, palette.FN)]
    dark = np.count_nonzero(right[:60].max(axis=-1) < 80)
    light = np.count_nonzero(right[:60].min(axis=-1) > 180)
    return min(swatches), light, dark


def test_a_picture_holds_the_scene_its_legend_and_the_card(opened: Opened, model: ReviewModel, tmp_path: Path) -> None:
    out = saved(opened, "Picture", tmp_path, "png")
    wait_for(lambda: out.stat().st_size > 10_000)
    assert out.name == "street_2.png"
    live = np.asarray(Image.open(out).convert("RGB"))
    written = picture(model, LINK, (1100, 700))
    assert live.shape == written.shape == (700, 1100, 3)
    for image in (live, written):
        swatches, light, dark = panels_of(image)
        assert swatches >= 20 and light >= 100 and dark >= 8000, (swatches, light, dark)
        scene = image[:, 350:750].astype(int)
        assert np.count_nonzero(np.abs(scene - palette.FN).max(axis=-1) <= 3) > 30


@pytest.mark.slow
def test_a_picture_holds_the_whole_of_a_long_card(opened: Opened) -> None:
    session = opened.session
    scene, _ = picture_parts(session.model, session.state, session.view, np.zeros((400, 600, 3), np.uint8))
    card = "".join(f"<p>line {number}</p>" for number in range(40)) + '<p style="color:#0f0">████</p>'
    body = overlay([{"card": card}], session.view.drive, [])
    url = opened.page.evaluate(f"reviewPicture({json.dumps(scene)},{json.dumps(body)})")
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"))
    assert np.count_nonzero((image == (0, 255, 0)).all(axis=-1)) > 50, "its last line"


@pytest.mark.slow
def test_the_copied_link_is_the_address_of_the_page(opened: Opened) -> None:
    page = opened.page
    page.send("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
    opened.click(BUTTON.replace("__NAME__", "Link"))
    wait_for(lambda: page.evaluate("navigator.clipboard.readText()"))
    copied = page.evaluate("navigator.clipboard.readText()")
    assert copied == page.evaluate("location.href").replace("fixedDpr=1&", "")
    assert "object=1005" in copied and "view=" in copied


def test_cells_are_shared_in_one_page_with_one_camera(model: ReviewModel, tmp_path: Path) -> None:
    app = ReviewApp(model, start_server())
    links = [f"frame={frame}&score={score}" for frame, score in ((2, 0.3), (2, 0.7), (2, 0.8), (2, 0.5))]
    try:
        with open_page(app.url + compare_address(*links), (900, 600)) as page:
            page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
            sessions = app.wait_session(4, PATIENCE_S)
            wait_for(lambda: all(one.pair is not None and one.view is not None for one in sessions))
            assert len(sessions[0].views()) == 4
            first = next(one for one in sessions if one.place == 0)
            next(one for one in first.panels if type(one).__name__ == "SharePanel")._save_page()
            wait_for(lambda: list(tmp_path.glob("*.html")))
            expected = [one.wait_drawn().counts.fn for one in sorted(sessions, key=lambda one: one.place)]
    finally:
        app.close()
    (out,) = tmp_path.glob("*.html")
    assert out.stat().st_size <= LARGEST
    cell = "document.getElementById('cell__N__')?.contentWindow"
    with open_page(f"{out.as_uri()}?fixedDpr=1", (900, 600)) as page:
        for number, fn in enumerate(expected):
            own = cell.replace("__N__", str(number))
            page.wait_for(
                f"{own}?.__viserMutable?.cameraControl&&{own}.document.querySelector('[role=slider]')", PATIENCE_S
            )
            assert page.evaluate(f"{own}.document.querySelector('[data-count=missed]').innerText") == str(fn)
        page.evaluate(f"{cell.replace('__N__', '3')}.__viserMutable.cameraControl.setPosition(5,6,7)")
        page.evaluate("document.getElementById('cell3').dispatchEvent(new Event('pointerenter'))")
        place = "JSON.parse(__CELL__.__viserMutable.cameraControl.toJSON()).position.map(Math.round).join()"
        page.wait_for(f"{place.replace('__CELL__', cell.replace('__N__', '0'))}==="
                      f"{place.replace('__CELL__', cell.replace('__N__', '3'))}", PATIENCE_S)  # fmt: skip


@pytest.mark.slow
def test_a_ruler_laid_by_two_clicks_is_as_long_as_the_ground_between_them(model: ReviewModel) -> None:
    app = ReviewApp(model, start_server())
    # From 100 m above, the camera's vertical field of 0.9 rad is 96.6 m high.
    link = "camera=free&view=0,0,100,0.5,0,0&off=labels"
    try:
        with open_page(f"{app.url}/?fixedDpr=1&{link}", (1100, 700)) as page:
            opened = Opened(app, page)
            opened.click("[...document.querySelectorAll('*')].filter(e=>e.innerText?.trim()==='Ruler').at(-1)")
            opened.click(BUTTON.replace("__NAME__", "Measure"))
            page.wait_for("document.body.innerText.includes('Click the first place')", PATIENCE_S)
            for y, ends in ((200, 2), (300, 4)):
                opened.press(400, y)
                wait_for(lambda ends=ends: len(opened.session.state.ruler) == ends)
            length = np.hypot(*np.subtract(opened.session.state.ruler[2:], opened.session.state.ruler[:2]))
            assert length == pytest.approx(100 * 2.0 * 100.0 * np.tan(0.45) / 700, rel=0.03)
            page.wait_for(f"document.body.innerText.includes('{length:.1f} m, ')", PATIENCE_S)
    finally:
        app.close()
