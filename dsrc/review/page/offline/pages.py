"""Shared views: pages that open without a server, and pictures with legend and card."""

import base64
import io
import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from html import escape

import numpy as np
from numpy.typing import NDArray

from dsrc.review.errors.gallery import Picture, gallery_html, pictures_of
from dsrc.review.errors.report import run_report
from dsrc.review.model import ReviewModel
from dsrc.review.over_time.strips import over_time
from dsrc.review.page import cameras
from dsrc.review.page.cameras import CameraPose, overview
from dsrc.review.page.offline.overlay import (
    SHOWN,
    CameraButton,
    cells_html,
    overlay,
    overlay_script,
    page_html,
)
from dsrc.review.page.scene import SceneWriter, backdrop, place_frame, set_light, set_sky, set_start_camera
from dsrc.review.page.server import start_server, stop_server
from dsrc.review.state import ReviewState, Theme
from dsrc.review.static import AROUND_M, cut_around
from dsrc.review.texts import counts_line, moment_report, selection_report, summary
from dsrc.review.view import FrameView
from sim.errors import SettingsError, complaint
from sim.geometry import pose_matrix

log = logging.getLogger(__name__)

UNSHARED: AbstractContextManager[object] = nullcontext()
"""What is held of a model that no other thread asks."""
ROOT = "/drive"
"""Root frame of the scene; moving it lets the camera of an exported page follow the ego."""

SHARED_FRAMES = 20
"""Frames of a shared page."""
LARGEST = 8_000_000
"""Size of a page above which its points are halved, and the distance to which its world reaches, bytes."""
LEAST_POINTS = 2000
"""Points of a frame below which they are not halved: the rest of the page is what makes it large."""
MAX_POINTS = 44_000
"""Most points of one frame: enough to recognise rings and objects, few enough for a laptop."""
PAGE_POINTS = 1_100_000
"""Most points of a page, about 7 MB."""
POINT_SIZE_M = 0.1
"""Side of a drawn point, m: thinned clouds need larger ones."""
POINT_STEP_M = 1.0 / 32.0
"""Rounding of points, m: the resolution of float16 beyond 32 m; saves a quarter of the page."""
# viser sends no pose that is zero, and a page that goes back to its start would keep the last one.
_NEARLY = np.asarray(pose_matrix([0.0, 0.0, 1e-6], 1e-6), np.float64)


def views_html(
    model: ReviewModel,
    views: Sequence[tuple[ReviewState, CameraPose | None]],
    frames: slice | int = SHARED_FRAMES,
    max_points: int | None = None,
    shared: bool = True,
    using_model: AbstractContextManager[object] = UNSHARED,
) -> str:
    """HTML page of one to four views side by side, each with its next frames.

    Args:
        views: states and cameras in the scene, None for that of the state.
        frames: number of frames from that of the state on, or a slice of those of the drive.
        max_points: points of a frame, all agents together; None for as many as make a page of `LARGEST` bytes.
        shared: stand at the first frame, with card, plots over time and gallery; else play, the ego where it starts.
        using_model: held while the model is asked.

    Raises:
        SettingsError: there are no such frames.
        UserError: a frame cannot be read.
    """
    rows = [_rows(model, state, frames) for state, _ in views]
    points, reach_m = max_points or min(MAX_POINTS, PAGE_POINTS // sum(map(len, rows))), AROUND_M
    while True:
        pages = []
        for (state, pose), own in zip(views, rows, strict=True):
            with using_model:
                agents = len(model.readable_frame(state.drive).agents)
            most = min(state.max_points, max(points // (agents * len(views)), 1))
            state = replace(state, max_points=most, point_size_m=max(state.point_size_m, POINT_SIZE_M))
            states = [replace(state, frame=row) for row in own]
            # A detection is known by its place in the list of one frame.
            states[1:] = [replace(one, detection=None) for one in states[1:]]
            pages.append(record(model, states, pose, shared, using_model, reach_m))
        html = page_html(*pages[0], model.names[views[0][0].drive]) if len(pages) == 1 else cells_html(pages)
        if max_points is not None or len(html) <= LARGEST or points < LEAST_POINTS:
            return html
        points, reach_m = points // 2, 0.5 * reach_m


def picture_parts(model: ReviewModel, state: ReviewState, view: FrameView, image: NDArray[np.uint8]) -> tuple[str, str]:
    """Data URL of a picture of the scene, and HTML of its legend and card; the script of a page makes one of both."""
    url = f"data:image/png;base64,{base64.b64encode(png_of(image)).decode()}"
    return url, overlay([_texts(model, state, view, shared=True)], view.drive, [])


def over_sky(image: NDArray[np.uint8], theme: Theme) -> NDArray[np.uint8]:
    """(H, W, 3) picture of a rendered (H, W, 4) one before the sky of a theme."""
    share = image[..., 3:] / 255.0
    mixed = image[..., :3] * share + backdrop(theme, len(image))[:, None] * (1.0 - share)
    return np.round(mixed).astype(np.uint8)


def png_of(image: NDArray[np.uint8]) -> bytes:
    """PNG of a (H, W, 3) picture."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "png", optimize=True)
    return content.getvalue()


def _rows(model: ReviewModel, state: ReviewState, frames: slice | int) -> list[int]:
    count = len(model.sources[state.drive])
    if isinstance(frames, int) and frames < 1:
        raise SettingsError(complaint("view", "frames", "at least 1", frames))
    rows = list(range(count))[frames if isinstance(frames, slice) else slice(state.frame, state.frame + frames)]
    if not rows:
        raise SettingsError(complaint("view", "frames", f"some of the drive's {count}", str(frames)))
    return rows


def record(
    model: ReviewModel,
    states: Sequence[ReviewState],
    pose: CameraPose | None = None,
    shared: bool = False,
    using_model: AbstractContextManager[object] = UNSHARED,
    reach_m: float = AROUND_M,
) -> tuple[str, str]:
    """Page of a player and its overlay; arguments as of `views_html`.

    Args:
        reach_m: distance from the first frame's ego to which the world is drawn.
    """
    server = start_server()
    try:
        drive, interval_s, theme = states[0].drive, model.interval_s(states[0].drive), states[0].theme
        set_light(server.scene)
        set_sky(server.scene, theme)
        writer = SceneWriter(server.scene, ROOT, POINT_STEP_M)
        root = server.scene.add_frame(ROOT, show_axes=False, position=_NEARLY[:3, 3])
        views, texts = [], []
        with using_model:
            _explain(model, drive)
        for state in states:
            with using_model:
                views.append(model.view(state))
                texts.append(_texts(model, state, views[-1], shared))
        first = views[0]
        # The camera of the page is fixed: the world moves instead.
        follows = states[0].camera if shared else "bev"
        scene = [cameras.scene_from_review(follows, view, states[0].follow) for view in views]
        if pose is None:
            pose = cameras.PRESETS.get(follows, overview)(first, states[0].follow) if shared else overview(first)
            if shared and first.selected is not None and first.moment is None:
                pose = cameras.close_to(first.selected, pose)
            pose = pose.moved(scene[0])
        set_start_camera(server, pose)
        shown = server.scene.add_frame(SHOWN, show_axes=False, position=(1.0, 0.0, 0.0))
        # Every node of any frame is there from the start: what only a later frame brings would stay when one goes back.
        for view in (*views, first):
            writer.write(view)
        place_frame(root, scene[0] @ _NEARLY)
        with using_model:
            world, note = model.world(drive)
        if note:  # the page is complete without it
            log.warning("%s", note)
        if reach_m < AROUND_M:
            world = cut_around(world, first.ego.review_from_body[:2, 3], reach_m)
        writer.place_world(world, theme, states[0].cut)
        serializer = server.get_scene_serializer()
        # The player's end is its beginning: it goes from there to the first time without drawing the first frame.
        for number in [*range(1, len(views)), 0]:
            serializer.insert_sleep(interval_s)
            shown.position = (float(number + 1), 0.0, 0.0)
            place_frame(root, scene[number] @ _NEARLY)
            writer.write(views[number])
        html = serializer.as_html(dark_mode=theme == "dark")
        poses = [("overview", "1", overview), ("chase", "2", cameras.chase), ("bird's eye", "3", cameras.birds_eye)]
        buttons = [CameraButton(name, key, make(first).moved(scene[0])) for name, key, make in poses]
        pictures = _gallery(model, states[0], using_model) if shared else ""
        return html, overlay(texts, first.drive, buttons, pictures) + overlay_script(texts, buttons, stop=shared)
    finally:
        stop_server(server)


def _gallery(model: ReviewModel, state: ReviewState, using_model: AbstractContextManager[object]) -> str:
    """Pictures of the worst errors that the page lists, by cause; "" where nothing is judged."""
    if not model.method(state) or not model.sources[state.drive].labelled:
        return ""
    with using_model:
        more, made = pictures_of(model, state, run_report(model, state).errors), list[Picture]()
    while True:
        with using_model:
            if (one := next(more, None)) is None:
                break
        made.append(one)
    return gallery_html(made, [""] * len(made)) if made else ""


def _explain(model: ReviewModel, drive: int) -> None:
    """Let a log of an episode find its cause and cast its sweeps, which the page does behind its first picture."""
    met = model.sources[drive].meeting
    if met is not None and not met.explained:
        model.sources[drive].explain()


def _texts(model: ReviewModel, state: ReviewState, view: FrameView, shared: bool) -> dict[str, str]:
    """Texts of a frame; of a shared one card and plots, too."""
    texts = {"subtitle": _subtitle(model, state), "counts": counts_line(view), "summary": summary(view)}
    if not shared:
        return texts
    source = model.sources[state.drive]
    card, line, met = "", source.timeline(), source.meeting
    if view.moment is not None and line is not None:
        card = moment_report(view.moment, line, view.index, "" if met is None else met.why)
    if view.details is not None:
        card += selection_report(view.details)
        for row in (history := model.histories[state.drive]).lacking():
            history.read(row)
    return texts | {"card": card, "plots": over_time(model, state, view)}


def _subtitle(model: ReviewModel, state: ReviewState) -> str:
    weather = model.setup(state).condition.label
    labelled = model.sources[state.drive].labelled
    if not model.has_detector:
        return f"{weather} · ground truth" if labelled else weather
    method = f" · {escape(model.method(state))}" if len(model.methods(state.drive)) > 1 else ""
    return f"{weather}{method} · score ≥ {state.threshold:g}" + (f" · IoU ≥ {state.iou:g}" if labelled else "")
