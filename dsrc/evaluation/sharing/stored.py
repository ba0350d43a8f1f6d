"""Stored shares: `shares.json` of `dsrc shares`, for those who look at them again."""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from dsrc.data.jsonio import read_json
from dsrc.evaluation.stored import StoredDrive
from sensors.corruptions import EVERYONE, Condition, Family

FILE = "shares.json"

_Place = Annotated[float, Meta(ge=-1e7, le=1e7)]
_Side = Annotated[float, Meta(ge=0.0, le=1e7)]


class SharedBox(msgspec.Struct, frozen=True):
    """Box, and the shares of all agents in it.

    Attributes:
        object_id: of a true box, -1 for a false detection.
        box: x, y, z, length, width, height, yaw in the ego LiDAR's frame, m and rad.
        team: best score of the whole team's detections of it, 0 without one.
        share: by agent; they sum to `team`.
        without: best score of the team without this agent, by agent.
    """

    object_id: int
    box: tuple[_Place, _Place, _Place, _Side, _Side, _Side, float]
    team: float
    share: dict[int, float]
    without: dict[int, float]

    def __post_init__(self) -> None:
        if not self.share or self.share.keys() != self.without.keys():
            raise ValueError("share, without: expected the same agents, at least one")


class SharedFrame(msgspec.Struct, frozen=True):
    """Boxes of a frame of a drive under a condition.

    Attributes:
        drive: name of the drive.
        condition: kind of the corruption, or `clean`.
        frame: number of the frame.
        ego_id: agent that detects.
        boxes: true boxes and false detections.
    """

    drive: str
    condition: str
    frame: int
    ego_id: int
    boxes: tuple[SharedBox, ...]


class _Settings(msgspec.Struct, frozen=True):
    severity: int
    family: Family
    seed: int
    who: str = EVERYONE


class _Made(msgspec.Struct, frozen=True):
    settings: _Settings


class StoredShares(msgspec.Struct, frozen=True):
    """Content of `shares.json`, as far as it is looked at again.

    Attributes:
        provenance: what made it.
        drives: the drives.
        frames: their frames.
    """

    provenance: _Made
    drives: tuple[StoredDrive, ...]
    frames: tuple[SharedFrame, ...]

    @property
    def seed(self) -> int:
        """Seed of the corruptions."""
        return self.provenance.settings.seed

    def condition(self, kind: str) -> Condition:
        """Condition of a kind of corruption."""
        own = self.provenance.settings
        return Condition.of(kind, own.severity, own.family, own.who)


def read_shares(folder: Path) -> StoredShares:
    """Read the shares of a folder.

    Raises:
        DataError: the file is missing or damaged, or a field is missing; names file and field.
    """
    return read_json(folder / FILE, StoredShares)
