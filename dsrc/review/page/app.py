"""Live review page: one state, one worker thread, the latest state is drawn."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from dsrc.options.fields import takes_fields
from dsrc.options.review import ServeOptions
from dsrc.review.matching import Counts
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page import cameras
from dsrc.review.page.cameras import CameraPose
from dsrc.review.page.panels import Panels
from dsrc.review.page.scene import SceneWriter, set_start_camera
from dsrc.review.page.server import LOOPBACK, address, check_port, start_server, stop_server
from dsrc.review.state import Camera, ReviewState
from dsrc.review.view import FrameView
from sensors.corruptions import CLEAN, require_corruption
from sim.errors import UserError

log = logging.getLogger(__name__)


class ReviewApp:
    """Live review page.

    Callbacks of viser run in a pool of threads and only replace the state. One worker thread draws the newest state
    and skips older ones.

    Attributes:
        state: newest settings.
        view: last drawn frame, None before the first.
        last_corruption: last corruption other than `clean`, "" before the first.
        url: address of the page.
    """

    def __init__(self, model: ReviewModel, server: viser.ViserServer, state: ReviewState | None = None) -> None:
        """Build the page and start drawing; `close` ends it."""
        self.model, self.server = model, server
        self.state = state or ReviewState()
        self.view: FrameView | None = None
        self.url = address(server)
        self.last_corruption = "" if self.state.corruption == CLEAN else self.state.corruption
        self._camera: Camera = "free"
        # Shared by the worker and the search for the next error.
        self._using_model = threading.Lock()
        self._playing_speed: float | None = None
        self._changed = threading.Condition()
        self._wanted = 1
        self._drawn = 0
        self._closed = False
        self._writer = SceneWriter(server, on_object=lambda object_id: self.update(object_id=object_id))
        self._panels = Panels(self)
        self._threads = [
            threading.Thread(target=self._work, name="review-worker", daemon=True),
            threading.Thread(target=self._tick, name="review-player", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def update(self, **changes: Any) -> None:
        """Replace fields of the state and draw it, if any of them changed."""
        with self._changed:
            state = replace(self.state, **changes)
            if state.drive != self.state.drive:
                state = replace(state, frame=0, ego_id=None, hidden=frozenset(), object_id=None)
            if state == self.state:
                return
            if state.corruption != CLEAN:
                self.last_corruption = state.corruption
            self.state = state
            self._wanted += 1
            self._changed.notify_all()

    def step(self, frames: int, wrap: bool = False) -> None:
        """Step by a number of frames, backward if negative; stop at the ends or wrap around."""
        with self._changed:
            count = self.model.frame_count(self.state.drive)
            frame = self.state.frame + frames
            self.update(frame=frame % count if wrap else min(max(frame, 0), count - 1))

    @property
    def playing(self) -> bool:
        """Whether the drive is playing."""
        return self._playing_speed is not None

    def play(self, speed: float | None) -> None:
        """Play at a multiple of real time; None pauses."""
        with self._changed:
            self._playing_speed = speed
            self._changed.notify_all()
        self._panels.show_playing(speed is not None)

    def toggle_play(self) -> None:
        """Play or pause."""
        self.play(None if self.playing else self._panels.selected_speed)

    def counts(self, state: ReviewState) -> Counts | None:
        """Counts of TP, FP and FN under another state, not drawn; None without a detector."""
        with self._using_model:
            return self.model.counts(state)

    def set_camera(self, camera: Camera) -> None:
        """Select a camera preset; chase and bird's eye follow the ego, free stays."""
        self._camera = camera
        view = self.view
        if view is None or camera == "free":
            return
        pose = cameras.chase(view) if camera == "chase" else cameras.birds_eye(view)
        self._move_cameras(pose)

    def reset_camera(self) -> None:
        """Restore the camera of the start."""
        self._camera = "free"
        if self.view is not None:
            self._move_cameras(cameras.overview(self.view))

    def wait_drawn(self, timeout_s: float = 30.0) -> FrameView:
        """Wait until the newest state is drawn and return it."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._drawn == self._wanted or self._closed, timeout_s):
                raise TimeoutError("the page was not drawn in time")
        if self.view is None:
            raise TimeoutError("the page was closed before it was drawn")
        return self.view

    def wait(self) -> None:
        """Serve until the page is closed or the process interrupted."""
        with self._changed:
            while not self._closed:
                self._changed.wait(1.0)

    def close(self) -> None:
        """Stop the threads and the server."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(timeout=10.0)
        stop_server(self.server)

    def _work(self) -> None:
        placed = -1
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._drawn != self._wanted or self._closed)
                if self._closed:
                    return
                state, number = self.state, self._wanted
            if state.drive != placed:
                self._writer.clear()
            self._draw(state)
            if state.drive != placed:
                # After the first frame: rebuilding a city takes longer than drawing.
                self._place_world(state.drive)
                placed = state.drive
            with self._changed:
                self._drawn = number
                self._changed.notify_all()

    def _draw(self, state: ReviewState) -> None:
        try:
            with self._using_model:
                view = self.model.view(state)
        except UserError as error:
            self._panels.show_error(str(error))
            return
        except Exception:
            log.exception("frame %d cannot be drawn", state.frame)
            self._panels.show_error(f"frame {state.frame} cannot be drawn; see the log")
            return
        before, self.view = self.view, view
        with self.server.atomic():
            self._writer.write(view)
        self._panels.show(view, state)
        if before is None or before.drive != view.drive:
            start = cameras.overview(view)
            set_start_camera(self.server, start)
            self._move_cameras(start)
        elif self._camera != "free":
            self._follow(before, view)

    def _place_world(self, drive: int) -> None:
        try:
            with self._using_model:
                parts = self.model.static_parts(drive)
        except UserError as error:
            self._panels.show_error(str(error))
            parts = []
        with self.server.atomic():
            self._writer.place_static(parts)

    def _move_cameras(self, pose: CameraPose) -> None:
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = pose.up
                client.camera.position = pose.position
                client.camera.look_at = pose.look_at

    def _follow(self, before: FrameView, after: FrameView) -> None:
        turn = self._camera == "chase"
        for client in self.server.get_clients().values():
            position = cameras.followed(client.camera.position, before, after, turn)
            look_at = cameras.followed(client.camera.look_at, before, after, turn)
            with client.atomic():
                client.camera.position = position
                client.camera.look_at = look_at

    def _tick(self) -> None:
        """Advance the frame while playing; slow frames are waited for, not skipped."""
        while True:
            with self._changed:
                ready = self._changed.wait_for(
                    lambda: self._closed or (self.playing and self._drawn == self._wanted), timeout=1.0
                )
                if self._closed:
                    return
                speed = self._playing_speed
            if not ready or speed is None:
                continue
            started = time.monotonic()
            self.step(1, wrap=True)
            pause = self.model.interval_s(self.state.drive) / speed - (time.monotonic() - started)
            if pause > 0.0:
                time.sleep(min(pause, 2.0))


@takes_fields(ServeOptions)
def serve(
    options: ServeOptions,
    host: str = LOOPBACK,
    block: bool = True,
    announce: Callable[[str], None] | None = None,
) -> ReviewApp:
    """Serve a review page of drives.

    Args:
        options: drives, detector, first corruption and port, see `ServeOptions`; or these as arguments.
        host: address to listen on; default: the loopback.
        block: serve until interrupted; otherwise return the running page.
        announce: called with the address of the page once it answers.

    Returns:
        The page; `url` is its address, `close` ends it.

    Raises:
        DataError: there is no drive.
        SettingsError: the corruption is unknown, or the port taken.
        CheckpointError: the checkpoint cannot be loaded.
    """
    require_corruption(options.corruption, options.severity, options.family)
    if options.port is not None:
        check_port(host, options.port)
    model = open_model(options.data, options.checkpoint)
    state = ReviewState(corruption=options.corruption, severity=options.severity, family=options.family)
    app = ReviewApp(model, start_server(host, options.port), state)
    log.info("review page: %s", app.url)
    if announce is not None:
        announce(app.url)
    if not block:
        return app
    try:
        app.wait()
    except KeyboardInterrupt:
        log.info("review page closed")
    finally:
        app.close()
    return app
