"""Session: page of one browser, with its own state, camera, selection and playing."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.review.errors.gallery import Gallery, Picture
from dsrc.review.errors.index import ErrorTable
from dsrc.review.errors.overview import Overview, Overviews
from dsrc.review.errors.report import Reports, RunReport, place_of, selection_of, to_detect
from dsrc.review.model import ReviewModel
from dsrc.review.over_time.strips import over_time
from dsrc.review.page.browser import AddressBar
from dsrc.review.page.cameras import BrowserCamera, CameraPose
from dsrc.review.page.cells import OPEN_KEY, CellPair, cells_of, compare_address
from dsrc.review.page.commands import COMMANDS, Command, keys_table
from dsrc.review.page.link import no_detection, no_object, write_link
from dsrc.review.page.panels import PANELS
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.protocol import GoesOn, Shown
from dsrc.review.page.scene import Clicked
from dsrc.review.page.stage import Stage, root_of
from dsrc.review.sources.base import Source
from dsrc.review.state import Camera, ReviewState, with_changes
from dsrc.review.static import StaticPart
from dsrc.review.texts import quoted
from dsrc.review.view import FrameView
from dsrc.review.worker import JobProgress, Latest, Worker
from sensors.corruptions import CLEAN
from sim.errors import UserError

log = logging.getLogger(__name__)

REFRESH_S = 0.5
"""Time between two looks at what goes on in the background, s."""

GROW_S = 0.1
"""Time between two looks at whether a running simulation has a new frame, s."""

AHEAD = 4
"""Frames that are read ahead of a playing drive."""

MOVING_POINTS = 70_000
"""Most points of all agents of a frame while frames change, 0.63 MB: the rest is sent once the view rests."""

REST_S = 0.3
"""Time without another frame after which the view rests, s."""

NARROW_PX = 800
"""Width of a window in which the panel starts collapsed."""

CELL_PX = 650
"""Width of a window below which the legend does too: it would cover half of a cell."""


class Session:
    """Page of one browser.

    Callbacks of viser run in a pool of threads and only replace the state. One worker thread draws the newest state
    and skips older ones.

    Attributes:
        model: drives, detector and caches.
        using_model: to be held while the model is asked.
        worker: detects over whole runs in the background.
        notes: on the errors, None where they cannot be kept.
        client: the browser; a server does in its place.
        gui, scene: its controls and nodes.
        camera, stage, address: of this browser; the address shows what is drawn.
        state: newest settings.
        view: last drawn frame, None before the first.
        last_corruption: last corruption other than `clean`, "" before the first.
        last_parameters: its parameters that differed from those of the severity.
        panels: parts of its controls.
        pair: cells side by side that this one belongs to, None for a page of its own.
        place: of this cell among them, from the upper left.
    """

    def __init__(
        self,
        model: ReviewModel,
        using_model: threading.Lock,
        worker: Worker,
        client: viser.ClientHandle,
        loop: asyncio.AbstractEventLoop,
        state: ReviewState,
        pose: CameraPose | None = None,
        notice: str = "",
        world_of: Callable[[int], tuple[Sequence[StaticPart], str]] = lambda _: ((), ""),
        before_detecting: Callable[[viser.ClientHandle], None] = lambda _: None,
    ) -> None:
        """Build the page and start drawing; `close` ends it.

        Args:
            model: drives, detector and caches, shared by all browsers.
            worker: detects over whole runs in the background, for all browsers.
            loop: event loop of the server.
            pose: camera of the start, in the scene; None for that of the state.
            notice: text above the controls at the start.
            world_of: function from the row of a drive to its static world, and why that is not drawn.
            before_detecting: called with the browser before the first detections are computed.
        """
        self.model, self.client, self.gui, self.scene = model, client, client.gui, client.scene
        self.state = state
        self.view: FrameView | None = None
        self.last_corruption = "" if state.corruption == CLEAN else state.corruption
        self.last_parameters = state.parameters
        self.using_model, self.worker, self.notes = using_model, worker, model.notes
        self._reports, self._overviews, self._gallery = Reports(model), Overviews(model), Gallery(model)
        # A link that says what is selected and not from where it is seen looks at it.
        self._explaining = Latest(0.0)
        self._looks = pose is None and model.sources[state.drive].meeting is None and state.selects
        self.pair: CellPair | None = None
        self.place = 0
        self._refresh_at, self._busy, self._version = 0.0, False, 0
        self._seen_frames = len(model.sources[state.drive])
        self._world_of, self._placed, self._before_detecting = world_of, -1, before_detecting
        self._changed = threading.Condition()
        self._wanted, self._drawn = 1, 0
        # What the drawn points are of, and when the view rests where some of them are left out.
        self._points_of: object = None
        self._rest_at: float | None = None
        self._closed = False
        self._search: Callable[[GoesOn], None] | None = None
        self._playing = False
        self._next_at = 0.0
        self.camera, self.address = BrowserCamera(client, loop, pose, self._take_along), AddressBar(client)
        self._on_close: list[Callable[[], None]] = []
        self._help: Any = None
        self._failed, self._told, self._told_of = False, notice, (state.drive, state.frame)
        self._interval_s = 0.1
        self._build(notice)
        self._thread = threading.Thread(target=self._work, name="review-session", daemon=True)
        self._thread.start()

    def _build(self, notice: str) -> None:
        self.stage = Stage(self.client, len(self.model.sources), on_click=self._select)
        self.stage.set_look(self.state.theme, self.state.cut)
        self._notice = self.gui.add_markdown(_quoted(notice), visible=bool(notice))
        self.panels = [make(self) for make in PANELS]
        with self.gui.add_folder("Help", expand_by_default=False):
            self.gui.add_button("Keys", hint="key ? or H").on_click(lambda _: self.toggle_help())
        for command in COMMANDS:
            modifier = "shift" if command.shift else None
            handle = self.gui.add_command(command.label, hotkey=command.key, modifier=modifier)  # type: ignore[arg-type]
            handle.on_trigger(self._trigger(command))
        self.client.camera.on_update(self._camera_moved)
        width = self.client.camera.image_width
        if 0 < width <= NARROW_PX and not notice:
            self.gui.main_panel.minimize()
        if 0 < width < CELL_PX:
            next(panel for panel in self.panels if isinstance(panel, LegendPanel)).window.minimize()

    def _trigger(self, command: Command) -> Callable[[Any], None]:
        def run(_: object) -> None:
            try:
                command.run(self)
            except Exception as error:
                self._tell_error(command.label, error)

        return run

    def update(self, **changes: object) -> None:
        """Replace fields of the state and draw it, if any of them changed."""
        with self._changed:
            state = with_changes(self.state, self.model.methods, **changes)
            if state == self.state:
                return
            if state.corruption != CLEAN:
                self.last_corruption, self.last_parameters = state.corruption, state.parameters
            if state.camera != self.state.camera:
                self.camera.place(state.camera)
            if state.drive != self.state.drive:
                self._seen_frames = len(self.model.sources[state.drive])
                state = replace(state, **(self.model.opening(state.drive) | changes))  # type: ignore[arg-type]
            self.state = state
            self._draw_soon()

    @property
    def source(self) -> Source:
        """Source that is shown."""
        return self.model.sources[self.state.drive]

    @property
    def shown(self) -> Shown:
        """What controls and panels are set from now."""
        return Shown(self.model, self.state, self.view)

    def link(self, state: ReviewState, pose: CameraPose | None = None) -> str:
        """Query of a state and a camera, see `write_link`."""
        return write_link(self.model, state, pose)

    @property
    def root(self) -> str:
        """Node of the scene below which the shown drive is drawn, in the review frame."""
        return root_of(self.state.drive)

    def step(self, frames: int, wrap: bool = False) -> None:
        """Step by a number of frames, backward if negative; stop at the ends of what is kept, or wrap around.

        Without any frame, as before the first of a running simulation, this does nothing.
        """
        with self._changed:
            # First before count: a frame may come in between.
            first, count = self.source.first, len(self.source)
            if count == 0:
                return
            past = max(self.state.frame, first) + frames - first
            self.update(frame=first + (past % (count - first) if wrap else min(max(past, 0), count - first - 1)))

    @property
    def playing(self) -> bool:
        """Whether the drive is playing."""
        return self._playing

    def toggle_play(self) -> None:
        """Play or pause."""
        with self._changed:
            self._playing = not self._playing
            self._next_at = time.monotonic()
            self._draw_soon()

    def report(self, state: ReviewState, patience_s: float = 0.0) -> RunReport:
        """Report of the run under a state, see `Reports.of`."""
        with self.using_model:
            return self._reports.of(state, patience_s)

    def overview(self, state: ReviewState) -> Overview:
        """Overview of the run under a state, as far as it is computed."""
        with self.using_model:
            found = self._overviews.of(state)
        self._busy |= not found.whole
        return found

    def gallery(self, state: ReviewState) -> list[Picture]:
        """Pictures of the worst listed errors, as far as they are made."""
        report = self.report(state, 2.0)
        with self.using_model:
            made, whole = self._gallery.of(state, report)
        self._busy |= not whole
        return list(made)

    def why_crashed(self, source: Source) -> str:
        """Cause of the crash of an episode, looked for in the background; "" without a crash."""
        met = source.meeting
        if met is None:
            return ""
        if not met.explained:
            self._busy = True
            if not self._explaining.running:
                self._explaining.submit(source.explain)
        return met.why if met.explained else "Looking for the cause …"

    def over_time(self, state: ReviewState, view: FrameView) -> str:
        """SVG of the plots over time of what is selected, as far as it is known; "" without any."""
        history, number, source = self.model.histories[state.drive], state.object_id, self.model.sources[state.drive]
        if state.selects and history.lacking():
            self.worker.read_over(history)
            self._busy = True
        elif number is not None and source.ended and history.lacks(number):
            self._let_go(no_object(self.model, state))
        with self.using_model:
            return over_time(self.model, state, view)

    def _let_go(self, why: str) -> None:
        """Tell that what is selected does not exist, and select nothing."""
        self.tell("\n".join(filter(None, (self._told, why))))
        self.gui.main_panel.expand()
        self.update(object_id=None, detection=None)

    def detect_all(self) -> None:
        """Detect in the background, in all frames, what the report of the state lacks."""
        state = self.state
        with self.using_model:
            wanted = to_detect(self.model, state)
        for method, setup in wanted:
            self.worker.detect(self.model.stores[state.drive], method, setup, state.frame)
        # A short one may end between two looks at it.
        self._busy = True
        with self._changed:
            self._changed.notify_all()

    def cancel(self) -> None:
        """End the detections over the whole drive."""
        for job in self.detecting():
            self.worker.cancel(job.number)

    def detecting(self) -> list[JobProgress]:
        """Detections over the whole drive that have not ended."""
        store = self.model.stores[self.state.drive]
        return [job for job in self.worker.jobs() if not job.ended and job.store is store]

    def search(self, look: Callable[[GoesOn], None]) -> None:
        """Run a search of this browser, or let the one that runs make way for it and return at once.

        Callbacks of all browsers share a few threads: those of a held key must not wait in them.
        """
        with self._changed:
            running, self._search = self._search is not None, look
            self._changed.notify_all()
        while not running:
            try:
                look(partial(self._goes_on, look))
            except Exception as error:
                self._tell_error("the search", error)
            with self._changed:
                if self._search is look or self._closed:
                    self._search = None
                    return
                look = self._search

    def _goes_on(self, look: Callable[[GoesOn], None], wait_s: float) -> bool:
        with self._changed:
            return not self._changed.wait_for(lambda: self._closed or self._search is not look, wait_s)

    def show_error(self, errors: ErrorTable, row: int) -> None:
        """Go to an error: its frame, its box selected, the camera near it."""
        with self.using_model:
            place = place_of(self.model, self.state.drive, errors, row)
        with self._changed:
            self.update(**selection_of(errors, row))
            self.fly_to(place)

    def download(self, name: str, content: str) -> None:
        """Give the browser a text file."""
        self.client.send_file_download(name, content.encode(), save_immediately=True)

    def place_camera(self, camera: Camera) -> None:
        """Place the camera as a preset has it and let it move with what the preset follows."""
        with self._changed:
            self.state = replace(self.state, camera=camera)
            self.camera.place(camera)
            self._draw_soon()

    def reset_camera(self) -> None:
        """Restore the camera of the start."""
        with self._changed:
            self.state = replace(self.state, camera="free")
            self.camera.reset()
            self._draw_soon()

    def fly_to(self, target: NDArray[np.float64]) -> None:
        """Move the camera near a point (3,) of the review frame, m."""
        if self.camera.fly_to(target):
            with self._changed:
                self.state = replace(self.state, camera="free")
                self._draw_soon()

    def tell(self, text: str) -> None:
        """Show a text above the controls; "" hides it."""
        self._failed, self._told, self._told_of = False, text, (self.state.drive, self.state.frame)
        self._notice.content = _quoted(text)
        self._notice.visible = bool(text)

    def toggle_help(self) -> None:
        """Open or close the list of keys."""
        if self._help is not None:
            self._help.close()
            self._help = None
            return
        self._help = self.gui.add_modal("Keys")
        with self._help:
            self.gui.add_markdown(f"{keys_table()}\n\nW A S D Q E and the arrows move the camera.")
            self.gui.add_button("Close").on_click(lambda _: self.toggle_help())

    def wait_drawn(self, timeout_s: float = 30.0, rested: bool = True) -> FrameView:
        """Wait until the newest state is drawn, or told why it cannot be, and return the last drawn frame.

        Args:
            rested: with all of its points.
        """
        drawn = lambda: self._drawn == self._wanted and not (rested and self._rest_at is not None)  # noqa: E731
        with self._changed:
            if not self._changed.wait_for(lambda: drawn() or self._closed, timeout_s):
                raise TimeoutError("the page was not drawn in time")
        if self.view is None:
            raise TimeoutError("the page was closed before it was drawn")
        return self.view

    def on_close(self, run: Callable[[], None]) -> None:
        """Run a function once the browser is gone."""
        self._on_close.append(run)

    def close(self) -> None:
        """Stop drawing, and what panels do in the background."""
        for run in self._on_close:
            run()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout=10.0)

    def _draw_soon(self) -> None:
        self._wanted += 1
        self._changed.notify_all()

    def _select(self, clicked: Clicked) -> None:
        self.update(object_id=clicked.object_id, detection=clicked.detection)

    def _work(self) -> None:
        while (work := self._next_work()) is not None:
            state, number = work
            if number != self._drawn:
                if self.pair is not None:
                    self.pair.state_changed(self, state)
                self._draw(state)
            elif self._rest_at is not None and not self._playing and time.monotonic() >= self._rest_at:
                self._draw(state)
            else:
                self._refresh()
            with self._changed:
                self._drawn = number
                self._changed.notify_all()
            self.address.write(lambda: self.link(self.state, self.camera.pose))

    def _refresh(self) -> None:
        """Follow a drive that grows, and set the panels again while something goes on, and once after it."""
        if time.monotonic() < self._refresh_at:
            return
        was, self._busy = self._busy, bool(self.detecting()) or not self.source.ended
        if self._seen_frames != (frames := len(self.source)):
            before, self._seen_frames = self._seen_frames, frames
            with self._changed:
                # Whoever looks at an earlier frame stays there, as long as it is kept.
                newest = self.view is None or self.state.frame >= before - 1
                oldest = self.source.first
                self.update(frame=frames - 1 if newest else max(self.state.frame, oldest))
                # A frame that stays is drawn again, too: its timeline is longer.
                self._draw_soon()
        elif self._version != self.source.version:
            with self._changed:
                self._draw_soon()
        elif self._busy or was:
            self._show_panels()
        self._refresh_at = time.monotonic() + (GROW_S if not self.source.ended else REFRESH_S)

    def _next_work(self) -> tuple[ReviewState, int] | None:
        """Newest state and its number, once there is something to do; None when the page is closed.

        A slow frame is waited for, not skipped: the next one of a playing drive comes after it.
        """
        with self._changed:
            while not self._closed:
                now = time.monotonic()
                due = [self._next_at] if self._playing else []
                due += [self.address.due] if self.address.due is not None else []
                due += [self._rest_at] if self._rest_at is not None and not self._playing else []
                due += [self._refresh_at] if self._busy or self.detecting() or not self.source.ended else []
                if self._drawn != self._wanted:
                    return self.state, self._wanted
                if self._playing and now >= self._next_at:
                    self._next_at = now + min(self._interval_s / self.state.speed, 2.0)
                    self.step(1, wrap=True)
                    if self._drawn == self._wanted:
                        self._draw_soon()
                    continue
                if due and now >= min(due):
                    return self.state, self._wanted
                self._changed.wait(max(min(due) - now, 0.0) if due else None)
            return None

    def _draw(self, state: ReviewState) -> None:
        """Draw a state, or tell why that cannot be: the next one is drawn all the same."""
        try:
            self.stage.set_look(state.theme, state.cut)
            self._version = self.model.sources[state.drive].version
            shown, first = self._moving(state), self.view is None
            if first:
                # The browser shows it while the rest is computed and sent.
                with self.using_model:
                    sketch = self.model.sketch(shown)
                self.stage.draw(sketch, state.drive, lambda: self.camera.follow(sketch, state))
                if self.model.computes(state):
                    self._place_world(state.drive)
                    self._before_detecting(self.client)
            with self.using_model:
                view = self.model.view(shown)
                self._interval_s = self.model.interval_s(state.drive)
            self.stage.draw(view, state.drive, lambda: self.camera.follow(view, state))
            self.view = view
            thin = (one for one in view.agents if len(one.points) < min(one.total, state.max_points) and one.visible)
            # A rested view may hold a few points fewer than it could, and is not drawn again for them.
            self._rest_at = time.monotonic() + REST_S if shown is not state and any(thin) else None
            if self._looks and view.selected is not None:
                self.fly_to(view.selected)
            self._looks = False
            if self._failed or self._told_of != (state.drive, state.frame):
                self.tell("")
            # After the first points: rebuilding a city takes longer than drawing.
            self._place_world(state.drive)
            if first and state.detection is not None and view.details is None and not view.notice:
                self._let_go(no_detection(state, view))
            self._read_ahead(state)
        except Exception as error:
            self._rest_at = None
            self._tell_error(f"frame {state.frame} of {self.model.names[state.drive]}", error)
        self.address.fall_behind()
        self._show_panels()

    def _place_world(self, drive: int) -> None:
        """Draw the static world of a drive once its first frame is drawn, or tell why it is not drawn."""
        if self._placed == drive:
            return
        self._placed = drive
        parts, note = self._world_of(drive)
        self.stage.place_world(parts)
        if note:
            self.tell("\n".join(filter(None, (self._told, note))))

    def _moving(self, state: ReviewState) -> ReviewState:
        """State with fewer points where its frame is another one than the last, until the view rests."""
        points_of = state.drive, state.frame, self._version, self.model.setup(state)
        rested = self._rest_at is None or time.monotonic() >= self._rest_at
        rests = points_of == self._points_of and rested and not self._playing
        self._points_of = points_of
        if rests:
            return state
        with self.using_model:
            agents = self.model.stores[state.drive].recorded(state.frame).agents
        seen = sum(agent.agent_id not in state.hidden for agent in agents)
        return replace(state, max_points=min(state.max_points, MOVING_POINTS // max(seen, 1)))

    def _read_ahead(self, state: ReviewState) -> None:
        """Let the worker read the frames that come next; it corrupts them while the drive is playing."""
        store, setup = self.model.stores[state.drive], self.model.setup(state)
        if self._playing:
            rows = range(state.frame + 1, state.frame + 1 + AHEAD)
            self.worker.prefetch(store, rows, setup.condition, setup.ego_id)
        else:
            self.worker.prefetch(store, (state.frame + 1, state.frame - 1))

    def _tell_error(self, what: str, error: Exception) -> None:
        if not isinstance(error, UserError):
            log.error("%s", what, exc_info=error)
        text = str(error) if isinstance(error, UserError) else f"{what}: {type(error).__name__}: {error}"
        self.tell(f"Error: {text}")
        self._failed = True

    def _show_panels(self) -> None:
        shown = self.shown
        for panel in self.panels:
            try:
                panel.show(shown)
            except Exception as error:
                self._tell_error("the panels", error)

    def look(self, pose: CameraPose) -> None:
        """Set the camera, in the event loop, to a pose in the scene, that of another cell."""
        self.camera.set(pose, own=False)

    def views(self) -> list[tuple[ReviewState, CameraPose | None]]:
        """States and cameras of the cells, from the upper left, or of this one page."""
        cells = sorted(self.pair.cells, key=lambda cell: cell.place) if self.pair is not None else [self]
        return [(cell.state, cell.camera.pose) for cell in cells]

    def side_by_side(self) -> None:
        """Open cells with linked cameras, or go back to one page from there."""
        pose = self.camera.pose
        if self.pair is not None:
            address = f"/?{self.link(self.state, pose)}"
        else:
            with self.using_model:
                cells = cells_of(self.model, self.state, self.last_corruption)
            address = compare_address(*(self.link(one, pose) for one in cells))
        self.client.local_storage.set_item(OPEN_KEY, address)

    def _camera_moved(self, _: object) -> None:
        with self._changed:
            self.address.fall_behind()
            self._changed.notify_all()

    def _take_along(self, pose: CameraPose) -> None:
        if self.pair is not None:
            self.pair.camera_moved(self, pose)


def _quoted(text: str) -> str:
    """Markdown that shows the lines of a text as they are, in bold."""
    return "\n\n".join(f"**{quoted(line)}**" for line in text.splitlines() if line)
