"""FrameStore: frames of a source, as recorded and corrupted, the latest used kept; threads share it."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from dsrc.evaluation.conditions import Condition
from dsrc.review.sources.base import Source
from dsrc.review.sources.detected import corrupted_frame
from sensors.corruptions import CLEAN, CORRUPTIONS
from sensors.frame import Frame

T = TypeVar("T")

KEPT = 24
"""Frames that are kept of each kind: 5 agents of 60,000 points take 15 MB."""


class LatestUsed(Generic[T]):
    """Cache that drops what was used longest ago; threads may share it, and may then make a value twice.

    Args:
        kept: number of values.
    """

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._lock = threading.Lock()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, made when missing."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        made = make()
        with self._lock:
            self._values[key] = made
            self._values.move_to_end(key)
            while len(self._values) > self._kept:
                self._values.popitem(last=False)
        return made


class FrameStore:
    """Frames of a source.

    Attributes:
        source: the source.

    Args:
        source: the source.
        kept: number of frames as recorded, and of corrupted ones.
    """

    def __init__(self, source: Source, kept: int = KEPT) -> None:
        self.source = source
        self._recorded: LatestUsed[Frame] = LatestUsed(kept)
        self._corrupted: LatestUsed[Frame] = LatestUsed(kept)

    def recorded(self, row: int) -> Frame:
        """Return a frame as recorded; raises DataError where it is damaged."""
        return self._recorded.get(row, lambda: self.source.read(row))

    def corrupted(self, row: int, condition: Condition, ego_id: int | None = None) -> Frame:
        """Return a frame under a condition.

        Args:
            row: of the frame.
            condition: of the sweeps.
            ego_id: agent that detects; None for the first vehicle.

        Raises:
            DataError: the frame is damaged, or a sweep lacks what the corruption needs.
            SettingsError: the corruption is unknown.
        """
        frame = self.recorded(row)
        if condition.kind == CLEAN:
            return frame
        # Few corruptions and choices of agents know an ego; the others are the same for all.
        known = CORRUPTIONS.get(condition.kind)
        of_ego = condition.who in ("ego", "helpers") or (known is not None and known.spares_ego)
        ego = ego_id if of_ego else None
        return self._corrupted.get(
            (row, condition, ego),
            lambda: corrupted_frame(frame, condition, self.source.seed, self.source.name, ego_id),
        )
