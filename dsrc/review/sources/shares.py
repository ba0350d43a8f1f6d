"""Drives with the shares that `dsrc shares` left in a folder: who helped in each of their frames."""

from collections.abc import Sequence
from pathlib import Path

from dsrc.data.drives import Drive, list_drives
from dsrc.evaluation.sharing.stored import FILE, SharedFrame, StoredShares, read_shares
from dsrc.review.sources.base import Setup
from dsrc.review.sources.drives import DriveSource
from dsrc.review.sources.results import stored_drive
from sensors.corruptions import Condition
from sim.errors import DataError, complaint


class SharedSource(DriveSource):
    """Frames of a drive, and the shares of the agents in them.

    Args:
        stored: shares of its folder.
    """

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
        folder: of the shares.
        data: drives or folder of drives, where they are now; None for where they were.

    Raises:
        DataError: the folder's file or a drive is missing or damaged, or a drive is not the one that was looked at.
    """
    stored = read_shares(folder)
    names = [drive.name for drive in stored.drives]
    if not names or len(set(names)) < len(names):
        raise DataError(complaint(folder / FILE, "drives", "names that differ", ", ".join(names) or "none"))
    moved = {path.name: path for path in list_drives(data)} if data is not None else {}
    return [SharedSource(stored_drive(folder / FILE, drive, moved), stored) for drive in stored.drives]
