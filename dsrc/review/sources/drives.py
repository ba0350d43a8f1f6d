"""DriveSource: frames of a recorded drive of any format."""

from collections.abc import Mapping
from functools import cached_property
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

    Args:
        drive: the drive.
        seed: of the corruptions.

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

    def __len__(self) -> int:
        return len(self.drive.frames)

    def read(self, row: int) -> Frame:
        """Return a frame as recorded; raises DataError where it is damaged."""
        return self.drive.read(row)

    @cached_property
    def labelled(self) -> bool:
        """Whether the first, middle or last readable frame has any object."""
        return has_labels(self.read, len(self))
