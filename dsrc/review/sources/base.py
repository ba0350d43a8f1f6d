"""Source and MemorySet: what a review page reads frames and detections from; DriveSource, that of a drive."""

import contextlib
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive
from dsrc.data.sample import Range
from dsrc.evaluation.detection_table import DetectionTable, join_tables
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.errors import DataError, UserError, complaint

if TYPE_CHECKING:
    # The closed loop takes a second to import.
    from dsrc.closed_loop.log import EpisodeLog
    from dsrc.review.sources.meeting import Meeting
    from dsrc.review.sources.moment import EpisodeMoment, EpisodeTimeline

Kind = Literal["drive", "episode", "live"]

SEED = 0
"""Seed of the corruptions, the default of `dsrc evaluate` and `dsrc corrupt`."""


@dataclass(frozen=True, slots=True)
class Setup:
    """Setup of a detection: condition of the sweeps, ego, cooperation.

    Attributes:
        condition: corruption of the sweeps.
        ego_id: agent that detects; None for the first vehicle of the frame.
        cooperative: with the collaborators' clouds; else with the ego's alone. Recorded sets have their own.
    """

    condition: Condition = field(default_factory=Condition)
    ego_id: int | None = None
    cooperative: bool = True


class MemorySet:
    """Named detections of one method in the frames of a source, by frame; threads may fill and read it at once.

    Attributes:
        name: of the method, as shown.
        recorded: True for what cannot be computed here.
    """

    def __init__(self, name: str, recorded: bool = True) -> None:
        self.name, self.recorded = name, recorded
        self._tables: dict[Setup, dict[int, DetectionTable]] = {}
        self._joined: dict[Setup, tuple[int, DetectionTable]] = {}
        self._lock = threading.Lock()
        self._changes = 0

    def put(self, row: int, table: DetectionTable, setup: Setup | None = None) -> None:
        """Keep the detections of a frame; its `position` must be the row."""
        if len(table) != 1 or table.position[0] != row:
            raise ValueError(f"a table of frame {row} alone is expected, found {table.position.tolist()}")
        with self._lock:
            self._tables.setdefault(self._own(setup or Setup()), {})[row] = table
            self._changes += 1

    def team(self, frame: Frame, ego_id: int, setup: Setup) -> tuple[tuple[int, ...] | None, Range | None]:
        """Return the agents that take part, the ego first, and the range that is judged, m; None where unknown."""
        return (None if self.recorded or setup.cooperative else (ego_id,)), None

    def forget(self, before: int) -> None:
        """Drop the detections of all frames before a row."""
        with self._lock:
            for tables in self._tables.values():
                for row in [row for row in tables if row < before]:
                    del tables[row]
            self._changes += 1

    def _own(self, setup: Setup) -> Setup:
        """Setup of the stored tables: recorded detections have their own ego and cooperation."""
        return Setup(setup.condition) if self.recorded else setup

    def _known(self, setup: Setup) -> dict[int, DetectionTable]:
        """Tables by row; the lock is held."""
        return self._tables.get(self._own(setup), {})

    def conditions(self) -> tuple[Condition, ...] | None:
        """Conditions with detections; None for any that is computed."""
        if not self.recorded:
            return None
        with self._lock:
            return tuple(dict.fromkeys(setup.condition for setup in self._tables))

    def get(self, row: int, setup: Setup) -> DetectionTable | None:
        """Detections in one frame; None where they are unknown, or those of another ego."""
        with self._lock:
            table = self._known(setup).get(row)
        return None if table is None or setup.ego_id not in (None, int(table.ego_id[0])) else table

    def rows(self, setup: Setup) -> NDArray[np.int64]:
        """(K,) rows of the frames with known detections of the ego, ascending."""
        with self._lock:
            known = sorted(self._known(setup))
        if setup.ego_id is not None:
            known = [row for row in known if self.get(row, setup) is not None]
        return np.array(known, np.int64)

    def run(self, setup: Setup) -> DetectionTable:
        """All known detections of the ego, in the order of the frames; `position` is the row of a frame."""
        with self._lock:
            changes, known = self._changes, self._joined.get(setup)
        if known is not None and known[0] == changes:
            return known[1]
        tables = [self.get(row, setup) for row in self.rows(setup).tolist()]
        joined = join_tables([table for table in tables if table is not None])
        with self._lock:
            self._joined[setup] = changes, joined
        return joined


class Source:
    """Frames of a drive, an episode or a running simulation, and the detections in them.

    Attributes:
        name: as shown.
        kind: what it is.
        protocol: content of `data_protocol.yaml`; empty without one.
        seed: of the corruptions.
        sets: sets of detections by name.
        folder: of the drive; None without one.
        first: row of the oldest frame that is kept.
        ended: whether no more frames come.
        version: number that changes where there is more of frames that were read before.
        note: what is missing, "" for nothing.
        fault: corruption, channel and faults under which an episode was driven, as a table has them.
        log: of an episode that has ended; None elsewhere.
        meeting: contact or nearest pass of such an episode; None elsewhere.
    """

    kind: Kind = "drive"
    folder: Path | None = None
    first, version = 0, 0
    ended = True
    note, fault = "", ""
    log: "EpisodeLog | None" = None
    meeting: "Meeting | None" = None

    def __init__(self, name: str, protocol: Mapping[str, Any] | None = None, seed: int = SEED) -> None:
        self.name, self.seed = name, seed
        self.protocol: Mapping[str, Any] = protocol or {}
        self.sets: dict[str, MemorySet] = {}

    def __len__(self) -> int:
        """Return the number of frames, which may grow."""
        raise NotImplementedError

    def read(self, row: int) -> Frame:
        """Return a frame as recorded.

        Raises:
            DataError: it is damaged, or no longer kept.
        """
        raise NotImplementedError

    def outline(self, row: int) -> Frame:
        """Return a frame whose sweeps may be missing where they take long to make; raises as `read`."""
        return self.read(row)

    @property
    def labelled(self) -> bool:
        """Whether there is ground truth; without it nothing is judged."""
        raise NotImplementedError

    def moment(self, row: int) -> "EpisodeMoment | None":
        """Return what the ego of an episode saw, believed and planned at a step; None elsewhere."""
        return None

    def timeline(self) -> "EpisodeTimeline | None":
        """Return the course of an episode so far; None elsewhere."""
        return None

    def explain(self) -> None:
        """Find what takes long: the cause of a crash, and the sweeps of an episode."""


class DriveSource(Source):
    """Frames of a drive.

    Attributes: those of `Source`, and
        drive: the drive.

    Raises:
        DataError: the drive has no frame.
    """

    def __init__(self, drive: Drive, seed: int = SEED) -> None:
        if len(drive.frames) == 0:
            raise DataError(complaint(drive.drive, "frames", "at least one frame", "none"))
        super().__init__(drive.drive.name, getattr(drive, "protocol", {}), seed)
        self.drive, self.folder = drive, drive.drive
        self._labelled: bool | None = None

    def __len__(self) -> int:
        return len(self.drive.frames)

    def read(self, row: int) -> Frame:
        """Return a frame as recorded; raises DataError where it is damaged."""
        frame = self.drive.read(row)
        if len(frame.truth):
            self._labelled = True
        return frame

    @property
    def labelled(self) -> bool:
        """Whether a frame that was read has any object, or the first, middle or last readable one."""
        if self._labelled is None:
            self._labelled = False
            for row in (0, len(self) // 2, len(self) - 1):
                with contextlib.suppress(UserError):
                    if len(self.read(row).truth):
                        break
        return self._labelled
