"""Page: what panels and commands may ask of a review page."""

from typing import Any, Protocol

import viser

from dsrc.review.matching import Counts
from dsrc.review.model import ReviewModel
from dsrc.review.state import Camera, ReviewState
from dsrc.review.view import FrameView


class Page(Protocol):
    """A review page, as its controls see it.

    Attributes:
        model: drives, detectors and their caches.
        server: of viser.
        state: what the page is asked to show.
        view: what it shows, None before the first drawing.
        last_corruption: the corruption that was chosen last, "" for none yet.
    """

    model: ReviewModel
    server: viser.ViserServer
    state: ReviewState
    view: FrameView | None
    last_corruption: str

    def update(self, **changes: Any) -> None:
        """Replace fields of the state and have it drawn."""

    def step(self, frames: int, wrap: bool = False) -> None:
        """Go forward by some frames, backward if negative."""

    @property
    def playing(self) -> bool:
        """Whether the frames advance by themselves."""

    def play(self, speed: float | None) -> None:
        """Advance at a multiple of real time; None pauses."""

    def toggle_play(self) -> None:
        """Play, or pause."""

    def counts(self, state: ReviewState) -> Counts | None:
        """Return TP, FP and FN of another state; None without a detector."""

    def set_camera(self, camera: Camera) -> None:
        """Take a camera preset."""

    def reset_camera(self) -> None:
        """Go back to the first look at a drive."""
