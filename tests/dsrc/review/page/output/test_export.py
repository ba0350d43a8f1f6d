import base64
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.link import linked_views
from dsrc.review.page.offline.overlay import STOP
from dsrc.review.page.output.export import export_html, export_pictures, export_states
from dsrc.review.page.output.screenshot import BrowserPage, find_chromium, open_page
from dsrc.review.sources.results import SharedSource
from dsrc.review.state import ReviewState
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.session import counted
from tests.dsrc.review.shared import shared_street


def recording(html: str) -> dict:
    """The messages that an exported page plays."""
    import zstandard

    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', html)[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    return msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])


@pytest.fixture
def page(model: ReviewModel, tmp_path: Path) -> Path:
    return export_states(model, [ReviewState(frame=i, max_points=500) for i in range(4)], tmp_path / "a" / "page.html")


def test_an_exported_page_plays_all_frames_with_named_nodes(page: Path) -> None:
    recorded = recording(page.read_text())
    assert recorded["durationSeconds"] == pytest.approx(0.4)
    names = {m[1].get("name") for m in recorded["messages"]}
    for name in ("agents/ego_vehicle_1000/lidar/points", "truth/fn/edges", "detections/tp/edges", "bodies/car"):
        assert f"/drive/{name}" in names
    times = {m[0] for m in recorded["messages"] if m[1].get("name", "").endswith("1000/lidar/points")}
    assert len(times) == 4 + 1, "its end is its beginning"


def test_an_exported_page_needs_nothing_else(page: Path) -> None:
    html = page.read_text()
    # Whatever is loaded would stand in an element's src or href, or in a style's url().
    assert not re.findall(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=[\"']?(?:https?:)?//", html)
    assert not re.findall(r"url\(\s*[\"']?https?:", html)
    assert not list(page.parent.glob("*.tmp"))
    assert 0.5e6 < page.stat().st_size < 4e6


def test_the_legend_holds_the_counts_of_every_frame(page: Path, model: ReviewModel) -> None:
    data = json.loads(re.search(r"__REVIEW__=(\{.*?\});", page.read_text())[1])
    assert len(data["frames"]) == 4
    counts = model.view(ReviewState(frame=2)).counts
    said = counted(data["frames"][2]["summary"])
    assert (said["true"], said["false"], said["missed"]) == (counts.tp, counts.fp, counts.fn)
    assert len(data["cameras"]) == 3


def without_labels(frame: Frame) -> Frame:
    none = np.zeros(len(frame.truth), bool)
    return replace(
        frame, truth=frame.truth[none], velocity=frame.velocity[none], points_on=frame.points_on[:, none],
        acceleration=frame.acceleration[none], signals=frame.signals[none], lane=(),
        visible_fraction=frame.visible_fraction[:, none], tilt=frame.tilt[none],
    )  # fmt: skip


class FindsAll:
    """Detector that finds every object."""

    settings = FakeDetector().settings

    def detect(self, sample: Sample) -> Detections:
        return Detections(sample.boxes, np.linspace(0.9, 0.6, len(sample.boxes)).astype(np.float32))


class Finds:
    """Detector that finds a box in each sample."""

    settings = FakeDetector().settings

    def detect(self, sample: Sample) -> Detections:
        return Detections(Boxes.from_array([[12.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.3]]), np.array([0.9], np.float32))


def test_detections_without_labels_are_called_so_and_counted(
    drive: FakeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = type(drive).read
    monkeypatch.setattr(type(drive), "read", lambda self, i: without_labels(read(self, i)))
    html = export_states(ReviewModel([drive], Finds()), [ReviewState()], tmp_path / "page.html").read_text()
    data = json.loads(re.search(r"__REVIEW__=(\{.*?\});", html)[1])
    assert "detection, not judged" in html and counted(data["frames"][0]["summary"]) == {"detected": 1}
    assert not any(word in html for word in ("ground truth", "false box", "IoU ≥"))


def test_boxes_by_who_helped_are_explained_and_counted(drive: FakeDrive, tmp_path: Path) -> None:
    model = ReviewModel([SharedSource(drive, shared_street())], FakeDetector())
    html = export_states(model, [ReviewState()], tmp_path / "page.html").read_text()
    counts = counted(json.loads(re.search(r"__REVIEW__=(\{.*?\});", html)[1])["frames"][0]["summary"])
    assert "red cross: an agent lowers the score" in html and "true box" not in html
    assert [counts[name] for name in ("found", "made", "harmed", "missed")] == [3, 1, 1, 1]
    judged = export_states(model, [ReviewState(boxes_by="verdict")], tmp_path / "page.html").read_text()
    assert "true box" in judged and "red cross" not in judged


def test_what_colours_of_points_mean_is_explained_where_they_show_it(truth_model: ReviewModel, tmp_path: Path) -> None:
    words = {"fate": ("made by the corruption", "lost to the corruption"), "height": ("above the road", "8 m"),
             "intensity": ("¼ intensity",), "ring": ("top ring", "lowest"), "agent": ()}  # fmt: skip
    for color_by in words:
        html = export_states(truth_model, [ReviewState(color_by=color_by)], tmp_path / "page.html").read_text()
        for other, texts in words.items():
            assert all((text in html) is (other == color_by) for text in texts), color_by


def test_a_drives_name_cannot_break_the_page(truth_model: ReviewModel, tmp_path: Path) -> None:
    truth_model.names[0] = "</script><script>alert(1)</script>"
    html = export_states(truth_model, [ReviewState()], tmp_path / "page.html").read_text()
    assert "alert(1)</script>" not in html


def test_the_ego_stays_where_it_starts(page: Path) -> None:
    recorded = recording(page.read_text())
    moves = [m[1]["position"] for m in recorded["messages"] if m[1].get("name") == "/drive" and "position" in m[1]]
    assert np.asarray(moves[-2]) == pytest.approx([-6.0, 0.0, 0.0], abs=1e-5)
    assert np.asarray(moves[-1]) == pytest.approx([0.0, 0.0, 0.0], abs=1e-5), "its end is its beginning"


def test_export_takes_a_folder_and_a_slice(tmp_path: Path, frame: Frame) -> None:
    for index in range(3):
        write_frame(tmp_path / "data" / "drive", replace(frame, index=index, time_s=0.1 * index))
    page = export_html(tmp_path / "data", tmp_path / "page.html", frames=slice(1, 3), max_points=300)
    assert recording(page.read_text())["durationSeconds"] == pytest.approx(0.2)
    for frames in (0, -3, slice(5, 9)):
        with pytest.raises(SettingsError, match="frames"):
            export_html(tmp_path / "data", tmp_path / "other.html", frames=frames)
    with pytest.raises(SettingsError, match="link: drive: expected drive, found 3"):
        export_html(tmp_path / "data", tmp_path / "other.html", link="drive=3")
    with pytest.raises(SettingsError, match="unknown corruption"):
        export_html(tmp_path / "data", tmp_path / "other.html", corruption="fogg")
    with pytest.raises(DataError):
        export_html(tmp_path / "nothing", tmp_path / "other.html")
    assert not (tmp_path / "other.html").exists()


@pytest.mark.parametrize(
    ("link", "said"), [("nonsense=3", "link: nonsense"), ("frame", "link: frame"), ("frame=x", "link: frame")]
)
def test_a_link_that_says_nothing_known_is_one_line(model: ReviewModel, link: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        linked_views(model, link)


@pytest.mark.parametrize("exists", ["object=1003", "detection=4", "frame=11&object=1000"])
def test_a_selection_that_does_not_exist_is_refused_where_nothing_could_be_told(
    model: ReviewModel, exists: str
) -> None:
    ((state, _),) = linked_views(model, exists)
    assert state.selects
    with pytest.raises(SettingsError, match="link: object: expected one of the objects of street, found 77"):
        linked_views(model, "object=77")
    with pytest.raises(SettingsError, match=r"link: detection: expected 0 to 4, with .* in frame 0"):
        linked_views(model, "detection=5&object=1003")


def test_an_address_is_a_link_and_that_of_cells_has_no_one_picture(model: ReviewModel) -> None:
    address = "http://localhost:8080/compare?cell=frame%3D1&cell=frame%3D2%26pair%3Da.1"
    assert [state.frame for state, _ in linked_views(model, address)] == [1, 2]
    with pytest.raises(SettingsError, match="link: cell: expected one view in a picture, found 2 cells"):
        next(export_pictures(model, address))


def test_without_a_browser_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SettingsError, match="no browser found"), open_page("about:blank"):
        pass


def shown(page: Path, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) picture of an exported page, stopped at its first frame: software draws more slowly than it plays."""
    with open_page(f"{page.resolve().as_uri()}?fixedDpr=1&darkMode", size) as opened:
        opened.wait_for("document.querySelector('canvas') && document.querySelector('[role=slider]')", 90.0)
        opened.evaluate(STOP)
        opened.evaluate("new Promise(done=>setTimeout(done,3000))")
        return np.asarray(Image.open(io.BytesIO(opened.png())).convert("RGB"))


def near(image: np.ndarray, rgb: palette.Rgb) -> int:
    """Pixels of about this colour, whatever their brightness."""
    pixels = image[..., :3].reshape(-1, 3).astype(np.float64)
    bright = pixels[pixels.max(axis=1) > 90]
    unit = bright / np.linalg.norm(bright, axis=1, keepdims=True)
    return int(np.count_nonzero(unit @ (np.array(rgb) / np.linalg.norm(rgb)) > 0.985))


@pytest.mark.browser
@pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
def test_an_exported_page_shows_the_scene_and_its_legend(page: Path) -> None:
    image = shown(page, (640, 400))
    assert image.shape[:2] == (400, 640)
    assert near(image[:, 340:], palette.TP) > 15


KEY = """document.querySelector('[role=slider]').dispatchEvent(
 new KeyboardEvent('keydown',{key:'__KEY__',bubbles:true,cancelable:true}))"""


def missed_pixels(page: BrowserPage, tmp_path: Path) -> int:
    """Pixels of missed objects beside the legend."""
    (tmp_path / "now.png").write_bytes(page.png())
    image = np.asarray(Image.open(tmp_path / "now.png").convert("RGB"))
    return near(image[:360, 350:], palette.FN)


@pytest.mark.browser
@pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
def test_a_page_and_its_picture_show_the_frame_that_their_text_names(drive: FakeDrive, tmp_path: Path) -> None:
    # Nothing is missed in the first frame, everything in the others: their boxes come into being after the start.
    states = [ReviewState(frame=row, threshold=0.3 if row == 0 else 1.0, max_points=500) for row in range(4)]
    model = ReviewModel([drive], FindsAll())
    out = export_states(model, states, tmp_path / "page.html")
    picture = shown(out, (900, 400))
    assert near(picture[:360, 350:], palette.FN) == 0 and near(picture[:360, 300:], palette.TP) > 15
    with open_page(f"{out.resolve().as_uri()}?fixedDpr=1", (900, 400)) as opened:
        opened.wait_for("document.querySelector('[role=slider]')", 60.0)
        opened.evaluate("new Promise(done=>setTimeout(done,500))")
        for keys in (("End",), ("End", "Home"), ("middle",)):
            for key in keys:
                if key == "middle":
                    for kind in ("mousePressed", "mouseReleased"):
                        opened.send("Input.dispatchMouseEvent", type=kind, x=500, y=385, button="left", clickCount=1)
                    # A key that a script presses may overtake the mouse, a user's cannot.
                    opened.wait_for("document.getElementById('review-summary').innerText.startsWith('Frame 2')", 60.0)
                else:
                    opened.evaluate(KEY.replace("__KEY__", key))
            opened.evaluate("new Promise(done=>setTimeout(done,1500))")
            summary, subtitle = (
                opened.evaluate(f"document.getElementById('review-{name}').innerText")
                for name in ("summary", "subtitle")
            )
            missed = opened.evaluate("document.querySelector('[data-count=missed]').innerText")
            later = keys[-1] == "middle"
            assert summary.startswith("Frame 2" if later else "Frame 0"), keys
            threshold = subtitle.split(" · ")[1]
            assert (missed, threshold) == (("5", "score ≥ 1") if later else ("0", "score ≥ 0.3"))
            assert (missed_pixels(opened, tmp_path) > 50) is later, keys
            moved = opened.evaluate("window.__viserMutable.nodePoseData['/drive'].position")
            expected = [-4.0, 0.0, 0.0] if later else [0.0, 0.0, 0.0]
            np.testing.assert_allclose(moved, expected, atol=1e-5, err_msg=f"the world is elsewhere after {keys}")


def test_pictures_leave_no_browser_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A browser that ends at once must be an error and not a wait of a minute.
    fake = tmp_path / "chromium"
    fake.write_text("#!/bin/sh\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SettingsError, match="the browser ended with code 3"), open_page("about:blank"):
        pass
