"""Page and Shown: what controls, commands and panels ask, and what they are set from."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.review.errors.gallery import Picture
from dsrc.review.errors.index import ErrorTable
from dsrc.review.errors.notes import NoteBook
from dsrc.review.errors.overview import Overview
from dsrc.review.errors.report import RunReport
from dsrc.review.model import ReviewModel
from dsrc.review.page.cameras import BrowserCamera, CameraPose
from dsrc.review.sources.base import Source
from dsrc.review.state import Camera, ReviewState
from dsrc.review.view import FrameView
from dsrc.review.worker import JobProgress, Worker
from sensors.corruptions import Changes

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


class Page(Protocol):
    """Page of one browser as its controls use it.

    Attributes:
        model: drives, detector and caches.
        gui: controls of this browser.
        scene: nodes of this browser.
        state: newest settings.
        view: last drawn frame, None before the first.
        last_corruption: last corruption other than `clean`, "" before the first.
        last_parameters: its parameters that differed from those of the severity.
        using_model: to be held while the model is asked.
        worker: detects over whole runs in the background.
        notes: on the errors, None where they cannot be kept.
        client: the browser.
        camera: of the browser.
        place: of this cell among those side by side, from the upper left.
    """

    model: ReviewModel
    using_model: threading.Lock
    worker: Worker
    notes: NoteBook | None
    client: viser.ClientHandle
    camera: BrowserCamera
    place: int
    gui: viser.GuiApi
    scene: viser.SceneApi
    state: ReviewState
    view: FrameView | None
    last_corruption: str
    last_parameters: Changes

    def update(self, **changes: object) -> None:
        """Replace fields of the state and draw it."""

    @property
    def source(self) -> Source:
        """Source that is shown."""

    @property
    def shown(self) -> Shown:
        """What controls and panels are set from now."""

    def link(self, state: ReviewState, pose: CameraPose | None = None) -> str:
        """Query of a state and a camera, see `write_link`."""

    @property
    def root(self) -> str:
        """Node of the scene below which the shown drive is drawn, in the review frame."""

    def step(self, frames: int, wrap: bool = False) -> None:
        """Step by a number of frames, backward if negative."""

    @property
    def playing(self) -> bool:
        """Whether the drive is playing."""

    def toggle_play(self) -> None:
        """Play or pause."""

    def report(self, state: ReviewState, patience_s: float = 0.0) -> RunReport:
        """Report of the run under a state, see `Reports.of`."""

    def overview(self, state: ReviewState) -> Overview:
        """Overview of the run under a state, as far as it is computed."""

    def gallery(self, state: ReviewState) -> list[Picture]:
        """Pictures of the worst listed errors, as far as they are made."""

    def why_crashed(self, source: Source) -> str:
        """Cause of the crash of an episode, looked for in the background; "" without a crash."""

    def over_time(self, state: ReviewState, view: FrameView) -> str:
        """SVG of the plots over time of what is selected, as far as it is known; "" without any."""

    def detect_all(self) -> None:
        """Detect in the background, in all frames, what the report of the state lacks."""

    def detecting(self) -> list[JobProgress]:
        """Detections over the whole drive that have not ended."""

    def cancel(self) -> None:
        """End these detections."""

    def search(self, look: Callable[[GoesOn], None]) -> None:
        """Run a search of this browser, or let the one that runs make way for it and return at once."""

    def show_error(self, errors: ErrorTable, row: int) -> None:
        """Go to an error: its frame, its box selected, the camera near it."""

    def download(self, name: str, content: str) -> None:
        """Give the browser a text file."""

    def place_camera(self, camera: Camera) -> None:
        """Place the camera as a preset has it and let it move with what the preset follows."""

    def reset_camera(self) -> None:
        """Restore the camera of the start."""

    def fly_to(self, target: NDArray[np.float64]) -> None:
        """Move the camera near a point (3,) of the review frame, m."""

    def look(self, pose: CameraPose) -> None:
        """Set the camera, in the event loop, to a pose in the scene, that of another cell."""

    def views(self) -> list[tuple[ReviewState, CameraPose | None]]:
        """States and cameras of the cells, from the upper left, or of this one page."""

    def side_by_side(self) -> None:
        """Open cells with linked cameras, or go back to one page from there."""

    def on_close(self, run: Callable[[], None]) -> None:
        """Run a function once the browser is gone."""

    def tell(self, text: str) -> None:
        """Show a text above the controls; "" hides it."""

    def toggle_help(self) -> None:
        """Open or close the list of keys."""
