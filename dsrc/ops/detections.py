"""Detections: scored boxes of one frame."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
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

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.integer] | slice) -> Self:
        """Select detections by a mask, indices or a slice."""
        return type(self)(self.boxes[rows], self.score[rows])
