"""Export of a drive as one self-contained animated HTML page, and of any view as a picture or an animation."""

import base64
import io
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.options.fields import takes_fields
from dsrc.options.review import PageOptions
from dsrc.outputs import COMMENT
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.app import ReviewApp, first_state
from dsrc.review.page.cells import CELL, links_of
from dsrc.review.page.link import linked_views
from dsrc.review.page.offline.overlay import page_html
from dsrc.review.page.offline.pages import over_sky, picture_parts, png_of, record, views_html
from dsrc.review.page.output.screenshot import PATIENCE_S, BrowserPage, open_page
from dsrc.review.page.server import start_server
from dsrc.review.state import ReviewState
from sensors.corruptions import Condition
from sim.errors import SettingsError, complaint
from sim.files import signed_picture, write_file

SETTLE_S = 2.0
"""Time for which a browser builds the first picture, s."""
VIVID = 60
"""Least difference between the channels of a colour that means something, of 255."""
# Two frames of the browser's own.
_DRAWN = "new Promise(done=>requestAnimationFrame(()=>requestAnimationFrame(()=>done(true))))"


@takes_fields(PageOptions)
def export_html(options: PageOptions) -> Path:
    """Write one HTML file that shows a view, or plays a drive, in any browser, without a server.

    Args:
        options: drives, page, detector, corruption, frames and link, see `PageOptions`; or these as arguments.

    Returns:
        The path of the page.

    Raises:
        DataError: there is no drive.
        SettingsError: the corruption, a part of the link or a number is wrong.
        CheckpointError: the checkpoint cannot be loaded.
    """
    Condition.of(options.corruption, options.severity, options.family, options.corrupted_agents).checked()
    model = open_model(options.data, options.checkpoint, options.drives, options.engine, options.height)
    start = first_state(model, options)
    return write_page(model, options.link, options.out, options.frames, start, options.max_points)


def write_page(
    model: ReviewModel,
    link: str,
    out: Path | str,
    frames: slice | int,
    start: ReviewState,
    max_points: int | None = None,
) -> Path:
    """Write a page of a link, or one that plays the drive of the start where the link is empty; see `views_html`."""
    views = linked_views(model, link, start)
    write_file(Path(out), views_html(model, views, frames, max_points, shared=bool(link)))
    return Path(out)


def picture(
    model: ReviewModel, link: str, size: tuple[int, int] = (1280, 720), start: ReviewState | None = None
) -> NDArray[np.uint8]:
    """(H, W, 3) picture of a view with legend and card; arguments and errors as of `export_pictures`."""
    from PIL import Image

    drawn: list[str] = []

    def draw_over(page: BrowserPage, state: ReviewState, image: NDArray[np.uint8]) -> None:
        parts = picture_parts(model, state, model.view(state), image)
        drawn.append(page.evaluate(f"reviewPicture({json.dumps(parts[0])},{json.dumps(parts[1])})"))

    list(export_pictures(model, link, size, start=start, seen=draw_over))
    content = base64.b64decode(drawn[0].partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def export_pictures(
    model: ReviewModel,
    link: str,
    size: tuple[int, int] = (1280, 720),
    frames: Sequence[int] | None = None,
    start: ReviewState | None = None,
    seen: Callable[[BrowserPage, ReviewState, NDArray[np.uint8]], None] = lambda *_: None,
) -> Iterator[NDArray[np.uint8]]:
    """Yield a (H, W, 3) picture of the scene without panels, drawn by Chromium, for each frame.

    Args:
        link: query of the page's address, which says what is shown.
        frames: rows of the frames; None for that of the link alone.
        start: what is shown where the link says nothing; None for the first frame as recorded.
        seen: called with the open page, the state and the picture of each.

    Raises:
        SettingsError: a part of the link is wrong, or no Chromium is installed.
        DataError: a frame or its detections are damaged.
    """
    views, links = linked_views(model, link, start), links_of(link)
    if len(links) > 1:
        raise SettingsError(complaint("link", CELL, "one view in a picture", f"{len(links)} cells"))
    (state, _), (link,) = views[0], links
    app = ReviewApp(model, start_server(), state)
    try:
        with open_page(f"{app.url}/?fixedDpr=1&{link}", size) as page:
            page.wait_for("document.querySelector('canvas') && window.__viserMutable", 60.0)
            (session,) = app.wait_session(1, 60.0)
            for number, row in enumerate([state.frame] if frames is None else frames):
                with session.using_model:
                    model.view(replace(state, frame=row))  # raises what the page would tell
                session.update(frame=row)
                session.wait_drawn(PATIENCE_S)
                render: dict[str, Any] = {
                    "height": size[1],
                    "width": size[0],
                    "transport_format": "png",
                    "timeout": PATIENCE_S,
                }
                if number == 0:
                    # The first picture can come before the browser has built all nodes, cities and cameras among them.
                    session.client.get_render(**render)
                    time.sleep(SETTLE_S)
                else:
                    # New points are tiny until the page itself has drawn them: an answer says that they have come.
                    session.client.get_render(**{**render, "height": 16, "width": 16})
                    page.evaluate(_DRAWN)
                image = over_sky(session.client.get_render(**render), state.theme)
                seen(page, session.state, image)
                yield image
    finally:
        app.close()


def write_picture(image: NDArray[np.uint8], out: Path) -> Path:
    """Write a (H, W, 3) picture as PNG, with the note by which it is known as ours."""
    write_file(out, signed_picture(png_of(image)))
    return out


def write_animation(images: Iterable[NDArray[np.uint8]], out: Path, interval_s: float) -> Path:
    """Write (H, W, 3) pictures as an endless GIF of one palette, with the comment by which it is known as ours.

    Args:
        images: at least one.
        interval_s: time between two of them, s; browsers show none faster than 0.02.
    """
    from PIL import Image

    arrays = list(images)
    # One palette for all: with one for each the colours of what stands still flicker. Half of its pixels are the vivid
    # ones of all pictures, those of boxes: the near neutral ground would take all colours, and a box may come late.
    pixels = np.concatenate([one.reshape(-1, 3) for one in (arrays[0], arrays[len(arrays) // 2], arrays[-1])])
    vivid = np.concatenate([one[np.ptp(one, axis=-1) > VIVID] for one in arrays])
    sample = pixels if not len(vivid) else np.concatenate([pixels, np.resize(vivid, pixels.shape)])
    colors = Image.fromarray(sample[None]).quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=2)
    frames = [Image.fromarray(one).quantize(palette=colors, dither=Image.Dither.NONE) for one in arrays]
    content = io.BytesIO()
    pause_ms = max(round(1e3 * interval_s), 20)
    frames[0].save(
        content, "gif", save_all=True, append_images=frames[1:], duration=pause_ms, loop=0, optimize=True,
        comment=COMMENT,
    )  # fmt: skip
    write_file(out, content.getvalue())
    return out


def export_states(model: ReviewModel, states: list[ReviewState], out: Path) -> Path:
    """Write a page that plays a sequence of states of one drive."""
    page, body = record(model, states)
    write_file(out, page_html(page, body, model.names[states[0].drive]))
    return out
