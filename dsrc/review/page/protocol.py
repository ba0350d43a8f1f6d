"""Page: protocol of a review page for panels and commands."""

from typing import Any, Protocol

import viser

from dsrc.review.matching import Counts
from dsrc.review.model import ReviewModel
from dsrc.review.state import Camera, ReviewState
from dsrc.review.view import FrameView


class Page(Protocol):
    """Review page as its controls use it.

    Attributes:
        model: drives, detector and caches.
        server: viser server.
        state: newest settings.
        view: last drawn frame, None before the first.
        last_corruption: last corruption other than `clean`, "" before the first.
    """

    model: ReviewModel
    server: viser.ViserServer
    state: ReviewState
    view: FrameView | None
    last_corruption: str

    def update(self, **changes: Any) -> None:
        """Replace fields of the state and draw it."""

    def step(self, frames: int, wrap: bool = False) -> None:
        """Step by a number of frames, backward if negative."""

    @property
    def playing(self) -> bool:
        """Whether the drive is playing."""

    def play(self, speed: float | None) -> None:
        """Play at a multiple of real time; None pauses."""

    def toggle_play(self) -> None:
        """Play or pause."""

    def counts(self, state: ReviewState) -> Counts | None:
        """Counts of TP, FP and FN under another state; None without a detector."""

    def set_camera(self, camera: Camera) -> None:
        """Select a camera preset."""

    def reset_camera(self) -> None:
        """Restore the camera of the start."""
