"""Sample store: samples of drives by frame and ego.

Nothing is cached: reading a frame of four agents (10 ms) and moving it into the ego's frame (25 ms) costs about as much
as reading a prepared sample, and prepared samples of all egos would fill gigabytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dsrc.data.drives import labelled_frames, open_drive
from dsrc.data.sample import Sample, SampleRequest, make_sample
from sensors.corruptions import corrupt_frame
from sensors.frame import Frame
from sim.errors import DataError, complaint

CorruptionDraw = tuple[str, int, int]
"""Kind, severity and seed of a corruption."""


@dataclass(frozen=True, slots=True)
class FrameRef:
    """Reference to a frame: the number of its drive in the store and its position there."""

    drive: int
    position: int


class SampleStore:
    """Samples of drives, made on access.

    Attributes:
        drives: their readers.
        frames: all frames, drive by drive.
    """

    def __init__(self, drives: Sequence[Path], request: SampleRequest) -> None:
        """Open the drives.

        Raises:
            DataError: the drives have no frames.
        """
        self.drives = [open_drive(drive) for drive in drives]
        self.request = request
        self.frames = [FrameRef(d, i) for d, reader in enumerate(self.drives) for i in labelled_frames(reader)]
        if not self.frames:
            raise DataError(complaint(drives[0] if drives else "data", "frames with ground truth", "at least one", 0))

    def egos(self, ref: FrameRef) -> list[int]:
        """Return the possible egos: vehicles (or all agents without a vehicle), in folder order."""
        agents = self.drives[ref.drive].agents
        return [agent for agent in agents if agent >= 0] or list(agents)

    def sample(self, ref: FrameRef, ego_id: int, corruption: CorruptionDraw | None = None) -> Sample:
        """Make the sample of one frame and ego, with corrupted clouds in addition if `corruption` is given.

        Raises:
            DataError: the sweeps lack what the corruption needs.
        """
        frame = self.drives[ref.drive].read(ref.position)
        sample = self._sample(frame, ref, ego_id)
        if corruption is None:
            return sample
        kind, severity, seed = corruption
        corrupted = corrupt_frame(frame, kind, severity, seed, ego_id=ego_id)
        return replace(sample, corrupted=self._sample(corrupted, ref, ego_id).clouds)

    def _sample(self, frame: Frame, ref: FrameRef, ego_id: int) -> Sample:
        reader = self.drives[ref.drive]
        key = f"{reader.drive.name}/{ego_id}/{reader.frames[ref.position]:06d}"
        return make_sample(frame, ego_id, self.request, key=key)
