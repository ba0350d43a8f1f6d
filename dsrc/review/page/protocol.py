"""Page and Panel: protocols of a browser's page for its controls, commands and panels."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.review.matching import Counts
from dsrc.review.labs.parameters import Changes
from dsrc.review.model import ReviewModel
from dsrc.review.state import Camera, ReviewState
from dsrc.review.view import FrameView


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


class Page(Protocol):
    """Page of one browser as its controls use it.

    Attributes:
        model: drives, detector and caches.
        gui: controls of this browser.
        state: newest settings.
        view: last drawn frame, None before the first.
        last_corruption: last corruption other than `clean`, "" before the first.
        last_parameters: its parameters that differed from those of the severity.
    """

    model: ReviewModel
    gui: viser.GuiApi
    state: ReviewState
    view: FrameView | None
    last_corruption: str
    last_parameters: Changes

    def update(self, **changes: Any) -> None:
        """Replace fields of the state and draw it."""

    def step(self, frames: int, wrap: bool = False) -> None:
        """Step by a number of frames, backward if negative."""

    @property
    def playing(self) -> bool:
        """Whether the drive is playing."""

    def toggle_play(self) -> None:
        """Play or pause."""

    def counts(self, state: ReviewState) -> Counts | None:
        """Counts of TP, FP and FN under another state; None without a detector or labels."""

    def place_camera(self, camera: Camera) -> None:
        """Place the camera as a preset has it and let it move with what the preset follows."""

    def reset_camera(self) -> None:
        """Restore the camera of the start."""

    def fly_to(self, target: NDArray[np.float64]) -> None:
        """Move the camera near a point (3,) of the review frame, m."""

    def tell(self, text: str) -> None:
        """Show a text above the controls; "" hides it."""

    def toggle_help(self) -> None:
        """Open or close the list of keys."""


class Panel(Protocol):
    """Part of the controls: built once per browser from a `Page`, then set from what is shown."""

    def show(self, shown: Shown) -> None:
        """Set the panel to what is shown."""
