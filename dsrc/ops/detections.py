"""Detections: scored boxes of one frame."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.rows import Rows


@dataclass(frozen=True, slots=True, eq=False)
class Detections(Rows):
    """Detections of one frame, best first, in the ego LiDAR's coordinates unless named otherwise.

    Attributes:
        boxes: N boxes.
        score: (N,) float32 in [0, 1], descending.
    """

    boxes: Boxes
    score: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.score.shape != (len(self.boxes),):
            raise ValueError(f"Detections.score must have shape ({len(self.boxes)},), got {self.score.shape}")

    @classmethod
    def zeros(cls) -> Self:
        """Return empty detections."""
        return cls(Boxes.zeros(), np.zeros(0, np.float32))
