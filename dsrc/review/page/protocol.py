"""Page, Shown and Panel: what controls, commands and panels are made of."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from dsrc.review.model import ReviewModel
from dsrc.review.sources.base import Source
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView

if TYPE_CHECKING:
    from dsrc.review.page.session import Session

Page: TypeAlias = "Session"
"""Page of one browser, which builds its controls, commands and panels and is asked by them."""

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
