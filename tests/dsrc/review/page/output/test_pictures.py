"""Pictures and animations of a view."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import viser
from PIL import Image

from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.output.export import export_pictures, write_animation, write_picture
from dsrc.review.page.output.screenshot import find_chromium
from dsrc.review.page.server import stop_server
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView
from sim.errors import DataError, SettingsError
from sim.files import check_output


def squares(count: int) -> Iterator[np.ndarray]:
    """Pictures of a red square that moves to the right over blue."""
    for number in range(count):
        image = np.tile(np.array([0, 0, 200], np.uint8), (40, 60, 1))
        image[10:20, 10 * number : 10 * number + 10] = 220, 0, 0
        yield image


def test_a_picture_is_written_as_it_is_and_may_be_written_again(tmp_path: Path) -> None:
    (image,) = squares(1)
    out = write_picture(image, tmp_path / "view.png")
    np.testing.assert_array_equal(np.asarray(Image.open(out)), image)
    check_output(out, "picture")


def test_an_animation_has_every_picture_at_its_pace(tmp_path: Path) -> None:
    out = write_animation(squares(5), tmp_path / "view.gif", 0.1)
    check_output(out, "animation")
    with Image.open(out) as gif:
        assert gif.n_frames == 5 and gif.info["duration"] == 100 and gif.info["loop"] == 0
        for number in range(5):
            gif.seek(number)
            frame = np.asarray(gif.convert("RGB")).astype(int)
            red = frame[15, :, 0] > 150
            assert np.flatnonzero(red).tolist() == list(range(10 * number, 10 * number + 10))


def test_thin_lines_keep_their_colours_above_a_ground_of_many_greens(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 120, (200, 300, 3)).astype(np.uint8)
    picture[..., [0, 2]] //= 4
    colours = np.array([palette.TP, palette.FP, palette.FN], np.uint8)
    for number, colour in enumerate(colours):
        picture[50 * (number + 1), 20:280] = colour
    with Image.open(write_animation([picture], tmp_path / "view.gif", 0.1)) as gif:
        read = np.asarray(gif.convert("RGB")).astype(int)
    for number, colour in enumerate(colours):
        assert np.abs(read[50 * (number + 1), 20:280] - colour).max() <= 24


def test_a_box_of_one_picture_keeps_its_colour_on_a_neutral_ground(tmp_path: Path) -> None:
    grey = np.random.default_rng(0).normal(200.0, 14.0, (120, 200, 1)).clip(0, 255).astype(np.uint8)
    pictures = [np.repeat(grey, 3, axis=2) for _ in range(5)]
    pictures[1][50:53, 20:60] = palette.FP
    with Image.open(write_animation(pictures, tmp_path / "view.gif", 0.1)) as gif:
        gif.seek(1)
        read = np.asarray(gif.convert("RGB")).astype(int)
    assert np.abs(read[50:53, 20:60] - palette.FP).max() <= 24


def test_a_wrong_link_is_told_before_a_browser_opens(model: ReviewModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.review.page.output.export.open_page", lambda *_: pytest.fail("a browser was opened"))
    with pytest.raises(SettingsError, match="link: frame: expected 0 to 11"):
        list(export_pictures(model, "frame=99"))


def test_a_picture_begins_from_what_it_is_given_and_the_link_comes_on_top(
    model: ReviewModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Opened(Exception):
        """A page with a start would be opened."""

    def app(_: ReviewModel, server: viser.ViserServer, state: ReviewState) -> None:
        stop_server(server)
        raise Opened(state)

    monkeypatch.setattr("dsrc.review.page.output.export.ReviewApp", app)
    with pytest.raises(Opened) as opened:
        next(export_pictures(model, "iou=0.7", start=ReviewState(frame=5, corruption="fog")))
    assert opened.value.args == (ReviewState(frame=5, corruption="fog", iou=0.7),)


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
def test_a_view_is_drawn_without_panels_at_any_size(model: ReviewModel) -> None:
    first, second = export_pictures(model, "camera=bev&score=0&off=labels,links", (500, 300), [0, 6])
    assert first.shape == second.shape == (300, 500, 3)
    for image in (first, second):
        assert (np.abs(image.astype(int) - palette.TP).max(axis=-1) <= 3).sum() > 15
    assert (first != second).any()


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
def test_a_frame_that_cannot_be_drawn_is_told_as_it_is(model: ReviewModel, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = model.view

    def view(state: ReviewState) -> FrameView:
        if state.frame == 3:
            raise DataError("cells/0.npz: cell: expected a whole one, found a damaged one")
        return drawn(state)

    monkeypatch.setattr(model, "view", view)
    pictures = export_pictures(model, "", (300, 200), [0, 3])
    assert next(pictures).shape == (200, 300, 3)
    with pytest.raises(DataError, match="a damaged one"):
        next(pictures)
