"""Page and Shown: what controls, commands and panels ask of the page of one browser, and what they are set from."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.review.errors.gallery import Picture, pictures_of
from dsrc.review.errors.index import ErrorTable
from dsrc.review.errors.overview import Overview, Overviews
from dsrc.review.errors.report import Reports, RunReport, place_of, selection_of, to_detect
from dsrc.review.frames import Pieces
from dsrc.review.model import ReviewModel
from dsrc.review.over_time.strips import over_time
from dsrc.review.page.cameras import BrowserCamera, CameraPose
from dsrc.review.sources.base import Source
from dsrc.review.state import Camera, ReviewState, with_changes
from dsrc.review.texts import quoted
from dsrc.review.view import FrameView
from dsrc.review.worker import Job, Latest, Worker
from sensors.corruptions import CLEAN
from sim.errors import UserError

log = logging.getLogger(__name__)

PATIENCE_S = 2.0
"""Age up to which a report may lack frames that became known since, while the page plays or detects, s."""

GoesOn = Callable[[float], bool]
"""Waits for some seconds, or less, and says whether a search goes on."""


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What controls and panels are set from.

    Attributes:
        model: drives, detector and caches.
        state: newest settings.
        view: last drawn frame, None before the first.
    """

    model: ReviewModel
    state: ReviewState
    view: FrameView | None = None

    @property
    def source(self) -> Source:
        """Source that is shown."""
        return self.model.sources[self.state.drive]

    @property
    def judged(self) -> bool:
        """Whether the drive has detections and labels."""
        return bool(self.source.sets) and self.source.labelled


GALLERY_S = 0.3
"""Time for which pictures of errors are made at once, s."""


class Page:
    """Page of one browser: its state, what is asked of its model, and what it does in the background.

    Callbacks of viser run in a pool of threads and only replace the state; a `Session` draws it.

    Attributes:
        model: drives, detector and caches.
        using_model: to be held while the model is asked.
        worker: detects over whole runs in the background.
        notes: on the errors, None where they cannot be kept.
        client: the browser; a server does in its place.
        gui, scene: its controls and nodes.
        camera: of this browser.
        link: function to the query of a state, or of a state and a pose of the camera.
        state: newest settings.
        view: last drawn frame, None before the first.
        playing: whether the drive is playing.
        last_corruption: last corruption other than `clean`, "" before the first.
        last_parameters: its parameters that differed from those of the severity.
        cells: pages side by side, this one among them; none for a page of its own.
        place: of this cell among them, from the upper left.
        help: open list of the keys, None where it is closed.
    """

    def __init__(
        self,
        model: ReviewModel,
        using_model: threading.Lock,
        worker: Worker,
        client: viser.ClientHandle,
        camera: BrowserCamera,
        state: ReviewState,
        link: Callable[..., str],
        notice: str = "",
    ) -> None:
        """Show nothing but a notice yet.

        Args:
            link: function to the query of a state and, if given, a pose of the camera, see `write_link`.
            notice: text above the controls at the start.
        """
        self.model, self.client, self.gui, self.scene = model, client, client.gui, client.scene
        self.using_model, self.worker, self.notes, self.camera = using_model, worker, model.notes, camera
        self.state, self.link = state, link
        self.view: FrameView | None = None
        self.playing = False
        self.last_corruption = "" if state.corruption == CLEAN else state.corruption
        self.last_parameters = state.parameters
        self.cells: list[Page] = []
        self.place = 0
        self.help: Any = None
        self._reports, self._overviews, self._pictures = Reports(model), Overviews(model), Pieces[Picture]()
        self._explaining = Latest(0.0)
        self._started: list[Job] = []
        self._changed = threading.Condition()
        self._wanted, self._drawn = 1, 0
        self._closed, self._busy = False, False
        self._next_at = 0.0
        self._search: Callable[[GoesOn], None] | None = None
        self._on_close: list[Callable[[], None]] = []
        self._failed, self._told, self._told_of = False, notice, (state.drive, state.frame)
        self._notice = self.gui.add_markdown(_quoted(notice), visible=bool(notice))

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

    def toggle_play(self) -> None:
        """Play or pause."""
        with self._changed:
            self.playing = not self.playing
            self._next_at = time.monotonic()
            self._draw_soon()

    def report(self, state: ReviewState, newest: bool = False) -> RunReport:
        """Report of the run under a state, see `Reports.of`.

        Args:
            newest: of all frames that are known; else it may be `PATIENCE_S` old while the page plays or detects.
        """
        patient = not newest and (self.playing or bool(self.detecting()))
        with self.using_model:
            return self._reports.of(state, PATIENCE_S if patient else 0.0)

    def overview(self, state: ReviewState) -> Overview:
        """Overview of the run under a state, as far as it is computed."""
        with self.using_model:
            found = self._overviews.of(state)
        self._busy |= not found.whole
        return found

    def gallery(self, state: ReviewState) -> list[Picture]:
        """Pictures of the worst listed errors, as far as they are made."""
        report = self.report(state)
        with self.using_model:
            made, whole = self._pictures.of(report, partial(pictures_of, self.model, state, report.errors), GALLERY_S)
        self._busy |= not whole
        return made

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
        history = self.model.histories[state.drive]
        if state.selects and history.lacking():
            self.worker.read_over(history)
            self._busy = True
        with self.using_model:
            return over_time(self.model, state, view)

    def detect_all(self) -> None:
        """Detect in the background, in all frames, what the report of the state lacks."""
        state = self.state
        with self.using_model:
            wanted = to_detect(self.model, state)
        store = self.model.stores[state.drive]
        self._started += [self.worker.detect(store, method, setup, state.frame) for method, setup in wanted]
        # A short one may end between two looks at it.
        self._busy = True
        with self._changed:
            self._changed.notify_all()

    def cancel(self) -> None:
        """End the detections over the whole drive."""
        for job in self.detecting():
            self.worker.cancel(job)

    def detecting(self) -> list[Job]:
        """Detections over the whole drive that have not ended."""
        store = self.model.stores[self.state.drive]
        return [job for job in self.worker.jobs() if job.store is store]

    def _tell_ended(self) -> None:
        """Tell what went wrong in jobs of this page that have ended."""
        for job in [job for job in self._started if job.ended]:
            self._started.remove(job)
            if job.skipped:
                (row, why), more = job.skipped[0], len(job.skipped) - 1
                self.tell(f"Not detected in frame {row}{f' and {more} more' if more else ''}: {why}")
            if job.error:
                self.tell(f"Error: detecting has ended. {job.error}")

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

    def views(self) -> list[tuple[ReviewState, CameraPose | None]]:
        """States and cameras of the cells, from the upper left, or of this one page."""
        cells = sorted(self.cells, key=lambda cell: cell.place) or [self]
        return [(cell.state, cell.camera.pose) for cell in cells]

    def tell(self, text: str) -> None:
        """Show a text above the controls; "" hides it."""
        self._failed, self._told, self._told_of = False, text, (self.state.drive, self.state.frame)
        self._notice.content = _quoted(text)
        self._notice.visible = bool(text)

    def on_close(self, run: Callable[[], None]) -> None:
        """Run a function once the browser is gone."""
        self._on_close.append(run)

    def _draw_soon(self) -> None:
        self._wanted += 1
        self._changed.notify_all()

    def _tell_error(self, what: str, error: Exception) -> None:
        if not isinstance(error, UserError):
            log.error("%s", what, exc_info=error)
        text = str(error) if isinstance(error, UserError) else f"{what}: {type(error).__name__}: {error}"
        self.tell(f"Error: {text}")
        self._failed = True


def _quoted(text: str) -> str:
    """Markdown that shows the lines of a text as they are, in bold."""
    return "\n\n".join(f"**{quoted(line)}**" for line in text.splitlines() if line)
