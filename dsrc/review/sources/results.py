"""Drives with what `dsrc evaluate`, `dsrc benchmark` or `dsrc shares` left in a folder: detections, and who helped."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.sample import Range, participants
from dsrc.evaluation.detection_table import DetectionTable
from dsrc.evaluation.sharing.stored import FILE as SHARES
from dsrc.evaluation.sharing.stored import SharedFrame, StoredShares, read_shares
from dsrc.evaluation.stored import FILE, StoredDrive, StoredRun, read_index, read_run, run_names
from dsrc.review.sources.base import DriveSource, MemorySet, Setup
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.errors import DataError, complaint


class MissingDriveError(DataError):
    """A drive of results is no longer where it was."""


class StoredSet(MemorySet):
    """Stored detections of one method in a drive, read when a condition is first asked for.

    Attributes: those of `MemorySet`, and
        runs: by condition.

    Args:
        number: row of the drive in the index.
    """

    def __init__(self, name: str, folder: Path, drive: Drive, number: int, runs: Mapping[Condition, StoredRun]) -> None:
        super().__init__(name)
        self.runs, self._folder, self._drive, self._number = dict(runs), folder, drive, number

    def conditions(self) -> tuple[Condition, ...]:
        """Conditions with detections."""
        return tuple(self.runs)

    def team(self, frame: Frame, ego_id: int, setup: Setup) -> tuple[tuple[int, ...] | None, Range | None]:
        """Return the agents that took part, the ego first, and the range that was judged, m."""
        run = self.runs.get(setup.condition)
        if run is None:
            return super().team(frame, ego_id, setup)
        team = tuple(frame.agents[row].agent_id for row in participants(frame, ego_id, run))
        return team[: run.agents], run.range_m

    def _known(self, setup: Setup) -> dict[int, DetectionTable]:
        own = self._own(setup)
        if own.condition in self.runs and own not in self._tables:
            table = read_run(self._folder, self.runs[own.condition].cells[self._number])
            _check_frames(self._folder, table, self._drive)
            rows = table.position.tolist()
            self._tables[own] = dict(zip(rows, table.frames(), strict=True))
        return super()._known(setup)


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
        by_name: dict[str, dict[Condition, StoredRun]] = {}
        for name, run in zip(run_names(index.runs), index.runs, strict=True):
            if run.cells[number]:
                by_name.setdefault(name, {})[run.condition] = run
        for name, runs in by_name.items():
            source.sets[name] = StoredSet(name, folder, source.drive, number, runs)
        sources.append(source)
    return sources


def stored_drive(index: Path, stored: StoredDrive, moved: Mapping[str, Path]) -> Drive:
    """Open a drive of results.

    Args:
        moved: where drives are now, by name.

    Raises:
        MissingDriveError: the drive is missing or damaged.
        DataError: it is not the one that was evaluated.
    """
    place = moved.get(stored.name, Path(stored.path))
    try:
        drive = open_drive(place)
    except DataError as error:
        raise MissingDriveError(f"{index}: drives: {stored.name}: {error}; give the folder of its drives") from None
    if drive.digest() != stored.data:
        expected = f"the drive that was evaluated ({stored.data[:12]})"
        raise DataError(complaint(place, "data", expected, f"another ({drive.digest()[:12]})", f"; see {index}"))
    return drive


class SharedSource(DriveSource):
    """Frames of a drive, and the shares of the agents in them."""

    def __init__(self, drive: Drive, stored: StoredShares) -> None:
        super().__init__(drive, stored.seed)
        rows = {number: row for row, number in enumerate(drive.frames)}
        self._shares: dict[tuple[Condition, int], SharedFrame] = {
            (stored.condition(frame.condition), rows[frame.frame]): frame
            for frame in stored.frames
            if frame.drive == self.name and frame.frame in rows
        }

    def shares(self, row: int, setup: Setup) -> SharedFrame | None:
        """Return the shares in a frame; None where they are unknown, or those of another ego."""
        found = self._shares.get((setup.condition, row))
        return None if found is None or setup.ego_id not in (None, found.ego_id) else found

    def shared(self, setup: Setup) -> str:
        """Say where there are shares, for a frame without them."""
        here = sorted(row for condition, row in self._shares if condition == setup.condition)
        if here:
            return f"No shares in this frame of this ego; the first with some is in row {here[0]}."
        known = ", ".join(dict.fromkeys(condition.label for condition, _ in self._shares))
        return f"No shares in {setup.condition.label}; there are in {known or 'no frame'}."


def open_shares(folder: Path, data: Path | None = None) -> Sequence[SharedSource]:
    """Open the drives of a folder of `dsrc shares`.

    Args:
        data: drives or folder of drives, where they are now; None for where they were.

    Raises:
        DataError: the folder's file or a drive is missing or damaged, or a drive is not the one that was looked at.
    """
    stored = read_shares(folder)
    names = [drive.name for drive in stored.drives]
    if not names or len(set(names)) < len(names):
        raise DataError(complaint(folder / SHARES, "drives", "names that differ", ", ".join(names) or "none"))
    moved = {path.name: path for path in list_drives(data)} if data is not None else {}
    return [SharedSource(stored_drive(folder / SHARES, drive, moved), stored) for drive in stored.drives]
