"""Stored sets: detections that `dsrc evaluate` or `dsrc benchmark` left in a folder, read when they are asked for."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.evaluation.detection_table import DetectionTable, join_tables
from dsrc.evaluation.stored import FILE, StoredDrive, StoredIndex, StoredRun, read_index, read_run, run_names
from dsrc.review.sources.base import Setup
from dsrc.review.sources.drives import DriveSource
from sensors.corruptions import Condition
from sim.errors import DataError, complaint


class StoredSet:
    """Stored detections of one method in a drive; see `DetectionSet`.

    Attributes:
        name: of the method, as shown.
        recorded: True.
        runs: by condition.

    Args:
        number: row of the drive in the index.
        runs: of the method, by condition.
    """

    recorded = True

    def __init__(self, name: str, folder: Path, drive: Drive, number: int, runs: Mapping[Condition, StoredRun]) -> None:
        self.name, self.runs = name, dict(runs)
        self._folder, self._drive, self._number = folder, drive, number
        self._tables: dict[Condition, tuple[DetectionTable, list[DetectionTable]]] = {}
        self._lock = threading.Lock()

    def conditions(self) -> tuple[Condition, ...]:
        """Conditions with detections."""
        return tuple(self.runs)

    def get(self, row: int, setup: Setup) -> DetectionTable | None:
        """Detections in one frame; None where none are stored, or those of another ego."""
        table, frames = self._load(setup.condition)
        at = int(np.searchsorted(table.position, row))
        if at == len(table) or table.position[at] != row or setup.ego_id not in (None, int(table.ego_id[at])):
            return None
        return frames[at]

    def rows(self, setup: Setup) -> NDArray[np.int64]:
        """(K,) rows of the frames with detections, ascending."""
        return self.run(setup).position

    def run(self, setup: Setup) -> DetectionTable:
        """All detections of a condition; those of one ego where the setup names it."""
        table, frames = self._load(setup.condition)
        if setup.ego_id is None or (table.ego_id == setup.ego_id).all():
            return table
        return join_tables([frame for frame in frames if frame.ego_id[0] == setup.ego_id])

    def _load(self, condition: Condition) -> tuple[DetectionTable, list[DetectionTable]]:
        with self._lock:
            if condition not in self._tables:
                run = self.runs.get(condition)
                table = read_run(self._folder, () if run is None else run.cells[self._number])
                _check_frames(self._folder, table, self._drive)
                self._tables[condition] = table, table.frames()
            return self._tables[condition]


def _check_frames(folder: Path, table: DetectionTable, drive: Drive) -> None:
    """Raise DataError unless the frames of a table ascend and are those of the drive."""
    inside = table.position < len(drive.frames)
    name = f"drive {drive.drive.name}"
    if not inside.all():
        found = int(table.position.max())
        raise DataError(complaint(folder / "cells", f"{name}: position", f"below {len(drive.frames)}", found))
    if (np.diff(table.position) <= 0).any():
        raise DataError(complaint(folder / "cells", f"{name}: position", "ascending numbers", "others"))
    expected = np.array(drive.frames, np.int64)[table.position]
    if (table.index != expected).any():
        row = int(np.argmax(table.index != expected))
        raise DataError(complaint(folder / "cells", f"{name}: index", f"frame {expected[row]}", int(table.index[row])))


def open_results(folder: Path, data: Path | None = None) -> list[DriveSource]:
    """Open the drives of a folder of results, with a stored set for each method.

    Args:
        folder: of `dsrc evaluate` or `dsrc benchmark`.
        data: drives or folder of drives, where they are now; None for where they were.

    Raises:
        DataError: the folder, its index or a drive is missing, or a drive is not the one that was evaluated.
    """
    index = read_index(folder)
    if not index.runs:
        raise DataError(complaint(folder / FILE, "runs", "detections of at least one method", "none"))
    moved = {path.name: path for path in list_drives(data)} if data is not None else {}
    sources = []
    for number, stored in enumerate(index.drives):
        source = DriveSource(stored_drive(folder / FILE, stored, moved), index.seed)
        names = run_names(index.runs)
        for name, runs in _by_name(index, number, names).items():
            source.sets[name] = StoredSet(name, folder, source.drive, number, runs)
        sources.append(source)
    return sources


def stored_drive(index: Path, stored: StoredDrive, moved: Mapping[str, Path]) -> Drive:
    """Open a drive of results.

    Args:
        index: file that names the drive.
        moved: where drives are now, by name.

    Raises:
        DataError: the drive is missing, or not the one that was evaluated.
    """
    place = moved.get(stored.name, Path(stored.path))
    try:
        drive = open_drive(place)
    except DataError as error:
        raise DataError(f"{index}: drives: {stored.name}: {error}; give the folder of its drives") from None
    if drive.digest() != stored.data:
        expected = f"the drive that was evaluated ({stored.data[:12]})"
        raise DataError(complaint(place, "data", expected, f"another ({drive.digest()[:12]})", f"; see {index}"))
    return drive


def _by_name(index: StoredIndex, number: int, names: Sequence[str]) -> dict[str, dict[Condition, StoredRun]]:
    """Runs with cells of a drive, by name of their set and condition."""
    found: dict[str, dict[Condition, StoredRun]] = {}
    for name, run in zip(names, index.runs, strict=True):
        if run.cells[number]:
            found.setdefault(name, {})[run.condition] = run
    return found
