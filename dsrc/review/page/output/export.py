"""Export of a drive as one self-contained animated HTML page, and of any view as a picture or an animation."""

import io
import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.options.fields import takes_fields
from dsrc.options.review import PageOptions
from dsrc.outputs import COMMENT
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.cameras import birds_eye, chase, overview
from dsrc.review.page.link import read_link
from dsrc.review.page.output.screenshot import PATIENCE_S, open_page
from dsrc.review.page.overlay import SHOWN, CameraButton, add_overlay, frame_texts
from dsrc.review.page.scene import (
    SceneWriter,
    backdrop,
    set_light,
    set_sky,
    set_start_camera,
)
from dsrc.review.page.server import start_server, stop_server
from dsrc.review.state import ReviewState
from dsrc.review.static import StaticPart
from sensors.corruptions import Condition
from sim.errors import SettingsError, UserError, complaint
from sim.files import signed_picture, write_file

log = logging.getLogger(__name__)

ROOT = "/drive"
"""Root frame of the scene; moving it lets the camera of an exported page follow the ego."""

MAX_POINTS = 44_000
"""Most points of one frame: enough to recognise rings and objects, few enough for a laptop."""
PAGE_POINTS = 40 * MAX_POINTS
"""Most points of a page: about 10 MB."""
SETTLE_S = 2.0
"""Time for which a browser builds the first picture, s."""
POINT_SIZE_M = 0.1
"""Side of a drawn point, m: thinned clouds need larger ones."""
VIVID = 60
"""Least difference between the channels of a colour that means something, of 255."""
POINT_STEP_M = 1.0 / 32.0
"""Rounding of points, m: the resolution of float16 beyond 32 m; saves a quarter of the page."""
# viser sends no pose that is zero, and a page that goes back to its start would keep the last one.
_NEARLY_ZERO = np.array([0.0, 0.0, 1e-6])
# Two frames of the browser's own.
_DRAWN = "new Promise(done=>requestAnimationFrame(()=>requestAnimationFrame(()=>done(true))))"


@takes_fields(PageOptions)
def export_html(options: PageOptions) -> Path:
    """Write one HTML file that plays a drive in any browser, without a server.

    Args:
        options: drives, page, detector, corruption, frames and drawing, see `PageOptions`; or these as arguments.

    Returns:
        The path of the page.

    Raises:
        DataError: there is no drive.
        SettingsError: the corruption or a number is wrong.
        CheckpointError: the checkpoint cannot be loaded.
    """
    Condition.of(options.corruption, options.severity, options.family, options.corrupted_agents).checked()
    model = open_model(options.data, options.checkpoint, options.drives, options.engine, options.height)
    if not 0 <= options.drive < len(model.drives):
        raise SettingsError(complaint("view", "drive", f"0 to {len(model.drives) - 1}", options.drive))
    rows = _rows(model, options.drive, options.frames)
    budget = min(MAX_POINTS, PAGE_POINTS // len(rows)) if options.max_points is None else options.max_points
    state = ReviewState(
        drive=options.drive,
        corruption=options.corruption,
        severity=options.severity,
        family=options.family,
        corrupted_agents=options.corrupted_agents,
        threshold=options.threshold,
        max_points=max(budget // len(model.readable_frame(options.drive).agents), 1),
        point_size_m=POINT_SIZE_M,
        color_by=options.color_by,
    )
    return export_states(model, [replace(state, frame=row) for row in rows], Path(options.out), options.follow)


def export_pictures(
    model: ReviewModel,
    link: str,
    size: tuple[int, int] = (1280, 720),
    frames: Sequence[int] | None = None,
    start: ReviewState | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Yield a (H, W, 3) picture of the scene without panels, drawn by Chromium, for each frame.

    Args:
        link: query of the page's address, which says what is shown.
        frames: rows of the frames; None for that of the link alone.
        start: what is shown where the link says nothing; None for the first frame as recorded.

    Raises:
        SettingsError: a part of the link is wrong, or no Chromium is installed.
        DataError: a frame or its detections are damaged.
    """
    state, _, complaints = read_link(link, model, start or ReviewState())
    if complaints:
        raise SettingsError(complaints[0])
    sky = np.repeat(backdrop(state.theme, size[1])[:, None], size[0], axis=1).astype(np.float64)
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
                image = session.client.get_render(**render).astype(np.float64)
                share = image[..., 3:] / 255.0
                yield np.round(image[..., :3] * share + sky * (1.0 - share)).astype(np.uint8)
    finally:
        app.close()


def write_picture(image: NDArray[np.uint8], out: Path) -> Path:
    """Write a (H, W, 3) picture as PNG, with the note by which it is known as ours."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "png", optimize=True)
    write_file(out, signed_picture(content.getvalue()))
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


def _rows(model: ReviewModel, drive: int, frames: slice | int) -> list[int]:
    count = model.frame_count(drive)
    if isinstance(frames, int) and frames < 1:
        raise SettingsError(complaint("view", "frames", "at least 1", frames))
    rows = list(range(count))[frames if isinstance(frames, slice) else slice(frames)]
    if not rows:
        raise SettingsError(complaint("view", "frames", f"some of the drive's {count}", str(frames)))
    return rows


def export_states(model: ReviewModel, states: list[ReviewState], out: Path, follow: bool = True) -> Path:
    """Write the page of a sequence of states of one drive; see `export_html`."""
    server = start_server()
    try:
        html = _record(server, model, states, follow)
    finally:
        stop_server(server)
    write_file(out, html)
    return out


def _record(server: viser.ViserServer, model: ReviewModel, states: list[ReviewState], follow: bool) -> str:
    drive, interval_s = states[0].drive, model.interval_s(states[0].drive)
    set_light(server.scene)
    set_sky(server.scene, states[0].theme)
    writer = SceneWriter(server.scene, ROOT, POINT_STEP_M)
    root = server.scene.add_frame(ROOT, show_axes=False, position=_NEARLY_ZERO)
    views = [model.view(state) for state in states]
    first = views[0]
    set_start_camera(server, overview(first))
    shown = server.scene.add_frame(SHOWN, show_axes=False, position=(1.0, 0.0, 0.0))
    # Every node of any frame is there from the start: what only a later frame brings would stay when one goes back.
    for view in (*views, first):
        writer.write(view)
    writer.place_world(_world(model, drive), states[0].theme)
    serializer = server.get_scene_serializer()
    # The player's end is its beginning: it goes from there to the first time without drawing the first frame.
    for number, view in [*enumerate(views[1:], start=2), (1, first)]:
        serializer.insert_sleep(interval_s)
        shown.position = (float(number), 0.0, 0.0)
        if follow:
            # The camera of the page is fixed: the world moves instead.
            root.position = first.ego.review_from_body[:3, 3] - view.ego.review_from_body[:3, 3] + _NEARLY_ZERO
        writer.write(view)
    html = serializer.as_html(dark_mode=states[0].theme == "dark")
    poses = [("overview", "1", overview), ("chase", "2", chase), ("bird's eye", "3", birds_eye)]
    cameras = [CameraButton(name, key, make(first)) for name, key, make in poses]
    texts = [frame_texts(view, _subtitle(model, state)) for view, state in zip(views, states, strict=True)]
    return add_overlay(html, texts, views, cameras)


def _world(model: ReviewModel, drive: int) -> list[StaticPart]:
    """Static world of a drive; empty where it cannot be rebuilt: the page is complete without it."""
    try:
        return model.static_parts(drive)
    except UserError as error:
        log.warning("%s", error)
        return []


def _subtitle(model: ReviewModel, state: ReviewState) -> str:
    weather = model.setup(state).condition.label
    labelled = model.labelled(state.drive)
    if not model.has_detector:
        return f"{weather} · ground truth" if labelled else weather
    return f"{weather} · score ≥ {state.threshold:g}" + (f" · IoU ≥ {state.iou:g}" if labelled else "")
