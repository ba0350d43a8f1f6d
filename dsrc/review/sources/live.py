"""LiveSource: frames of a running simulation or training, the latest kept; whoever makes them never waits."""

import threading
from collections import deque
from collections.abc import Mapping

from dsrc.evaluation.detection_table import DetectionTable
from dsrc.review.sources.base import SEED, Kind, MemorySet, Source
from sensors.frame import Frame
from sim.errors import DataError, complaint

KEPT = 300
"""Frames that are kept: half a minute at 10 Hz; five agents of 60,000 points take 15 MB per frame at most."""


class LiveSource(Source):
    """Frames as they come; rows count from the first frame ever, and old ones are dropped.

    Args:
        kept: number of frames that are kept.
        protocol: of the drive that is made.
    """

    kind: Kind = "live"
    labelled = False  # until a frame has an object

    def __init__(
        self, name: str, kept: int = KEPT, protocol: Mapping[str, object] | None = None, seed: int = SEED
    ) -> None:
        if kept < 1:
            raise ValueError(f"kept must be at least 1, got {kept}")
        super().__init__(name, protocol, seed)
        self._frames: deque[Frame] = deque(maxlen=kept)
        self._count = 0
        self.ended = False
        self._lock = threading.Lock()

    def put(self, frame: Frame, detections: Mapping[str, DetectionTable] | None = None) -> int:
        """Add the newest frame and the detections in it by method, and return its row.

        Raises:
            ValueError: the source has ended, a table is not one of this row, or a set of that name is computed.
        """
        with self._lock:
            if self.ended:
                raise ValueError(f"{self.name} has ended")
            row = self._count
            for name, table in (detections or {}).items():
                known = self.sets.setdefault(name, MemorySet(name))
                if not known.recorded:
                    raise ValueError(f"{name} is computed, not recorded")
                known.put(row, table)
            self._frames.append(frame)
            self._count += 1
            self.first = self._count - len(self._frames)
            self.labelled |= len(frame.truth) > 0
            for each in self.sets.values() if self.first else ():
                each.forget(self.first)
        return row

    def end(self) -> None:
        """Mark that no more frames come."""
        with self._lock:
            self.ended = True

    def __len__(self) -> int:
        return self._count

    def read(self, row: int) -> Frame:
        """Return a frame.

        Raises:
            DataError: it has not come yet, or is no longer kept.
        """
        with self._lock:
            if not self.first <= row < self._count:
                expected = f"{self.first} to {self._count - 1}" if self._count else "a first frame to come"
                raise DataError(complaint(self.name, "frame", expected, row))
            return self._frames[row - self.first]
