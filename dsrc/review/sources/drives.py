"""DriveSource: frames of a recorded drive of any format."""

from collections.abc import Mapping
from typing import Any

from dsrc.data.drives import Drive
from dsrc.review.sources.base import SEED, DetectionSet, Kind, has_labels
from sensors.frame import Frame
from sim.errors import DataError, complaint


class DriveSource:
    """Frames of a drive.

    Attributes:
        drive: the drive.
        name: of the drive.
        kind: `drive`.
        protocol: of the drive.
        seed: of the corruptions.
        sets: sets of detections by name.

    Raises:
        DataError: the drive has no frame.
    """

    kind: Kind = "drive"

    def __init__(self, drive: Drive, seed: int = SEED) -> None:
        if len(drive.frames) == 0:
            raise DataError(complaint(drive.drive, "frames", "at least one frame", "none"))
        self.drive, self.seed = drive, seed
        self.name = drive.drive.name
        self.protocol: Mapping[str, Any] = getattr(drive, "protocol", {})
        self.sets: dict[str, DetectionSet] = {}
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
            self._labelled = has_labels(self.read, len(self))
        return self._labelled
