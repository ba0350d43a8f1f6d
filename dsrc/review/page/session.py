"""Session: page of one browser, drawn by a thread of its own, with panels, commands and address."""

import asyncio
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from dsrc.review.model import ReviewModel
from dsrc.review.page.browser import AddressBar
from dsrc.review.page.cameras import BrowserCamera, CameraPose
from dsrc.review.page.cells import CellPair
from dsrc.review.page.commands import COMMANDS, Command, toggle_help
from dsrc.review.page.link import no_detection, no_object, write_link
from dsrc.review.page.page import Page
from dsrc.review.page.panels import PANELS
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.scene import Clicked
from dsrc.review.page.stage import Stage
from dsrc.review.state import ReviewState
from dsrc.review.static import StaticPart
from dsrc.review.view import FrameView
from dsrc.review.worker import Worker

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


class Session(Page):
    """Page of one browser, whose one thread draws the newest state and skips older ones.

    Attributes: those of `Page`, and
        stage, address: of this browser; the address shows what is drawn.
        panels: parts of its controls.
        pair: what takes its state and camera to the cells beside it, None for a page of its own.
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
        self.pair: CellPair | None = None
        camera = BrowserCamera(client, loop, pose, self._take_along)
        super().__init__(model, using_model, worker, client, camera, state, partial(write_link, model), notice)
        # A link that says what is selected and not from where it is seen looks at it.
        self._looks = pose is None and self.source.meeting is None and state.selects
        self._refresh_at, self._version = 0.0, 0
        self._counted = state.drive, len(self.source)
        self._world_of, self._placed, self._before_detecting = world_of, -1, before_detecting
        # What the drawn points are of, and when the view rests where some of them are left out.
        self._points_of: object = None
        self._rest_at: float | None = None
        self._interval_s = 0.1
        self.address = AddressBar(client)
        self._build(notice)
        self._thread = threading.Thread(target=self._work, name="review-session", daemon=True)
        self._thread.start()

    def _build(self, notice: str) -> None:
        self.stage = Stage(self.client, len(self.model.sources), on_click=self._select)
        self.stage.set_look(self.state.theme, self.state.cut)
        self.panels = [make(self) for make in PANELS]
        with self.gui.add_folder("Help", expand_by_default=False):
            self.gui.add_button("Keys", hint="key ? or H").on_click(lambda _: toggle_help(self))
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

    def close(self, patience_s: float = 10.0) -> bool:
        """Stop drawing, and what panels do in the background; return whether it has stopped in this time."""
        for run in self._on_close:
            run()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout=patience_s)
        return not self._thread.is_alive()

    def _let_go(self, why: str) -> None:
        """Tell that what is selected does not exist, and select nothing."""
        self.tell("\n".join(filter(None, (self._told, why))))
        self.gui.main_panel.expand()
        self.update(object_id=None, detection=None)

    def _select(self, clicked: Clicked) -> None:
        self.update(object_id=clicked.object_id, detection=clicked.detection)

    def _work(self) -> None:
        while (work := self._next_work()) is not None:
            state, number = work
            if number != self._drawn:
                if self.pair is not None:
                    self.pair.state_changed(self, state)
                self._draw(state)
            elif self._rest_at is not None and not self.playing and time.monotonic() >= self._rest_at:
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
        self._tell_ended()
        drive, before = self._counted
        self._counted = self.state.drive, (frames := len(self.source))
        if drive == self.state.drive and before != frames:
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
                due = [self._next_at] if self.playing else []
                due += [self.address.due] if self.address.due is not None else []
                due += [self._rest_at] if self._rest_at is not None and not self.playing else []
                due += [self._refresh_at] if self._busy or self.detecting() or not self.source.ended else []
                if self._drawn != self._wanted:
                    return self.state, self._wanted
                if self.playing and now >= self._next_at:
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
        rests = points_of == self._points_of and rested and not self.playing
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
        if self.playing:
            rows = range(state.frame + 1, state.frame + 1 + AHEAD)
            self.worker.prefetch(store, rows, setup.condition, setup.ego_id)
        else:
            self.worker.prefetch(store, (state.frame + 1, state.frame - 1))

    def _show_panels(self) -> None:
        shown = self.shown
        source, number, history = shown.source, shown.state.object_id, self.model.histories[shown.state.drive]
        if number is not None and source.ended and history.lacks(number):
            self._let_go(no_object(self.model, shown.state))
        for panel in self.panels:
            try:
                panel.show(shown)
            except Exception as error:
                self._tell_error("the panels", error)

    def _camera_moved(self, _: object) -> None:
        with self._changed:
            self.address.fall_behind()
            self._changed.notify_all()

    def _take_along(self, pose: CameraPose) -> None:
        if self.pair is not None:
            self.pair.camera_moved(self, pose)
