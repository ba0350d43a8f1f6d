"""SampleStore: samples of drives by frame and ego.

Nothing is kept between epochs: reading a frame of four agents (10 ms) and moving it into the ego's frame (25 ms) costs
about what reading a prepared sample would, and prepared samples of all egos would fill gigabytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dsrc.data.drives import open_drive
from dsrc.data.sample import Sample, make_sample
from dsrc.ops.grid import GridSpec
from sensors.corruptions import corrupt_frame
from sensors.frame import Frame
from sim.errors import DataError, complaint

Corruption = tuple[str, int, int]
"""Kind, severity and seed of a corruption."""


@dataclass(frozen=True, slots=True)
class FrameRef:
    """One frame: the number of its drive in the store and its position there."""

    drive: int
    position: int


class SampleStore:
    """Makes the samples of drives.

    Attributes:
        drives: their readers.
        frames: all frames, drive by drive.
    """

    def __init__(
        self,
        drives: Sequence[Path],
        grid: GridSpec,
        comm_range_m: float,
        max_agents: int,
        keep_ego_box: bool = False,
    ) -> None:
        """Look at the drives.

        Args:
            drives: their folders.
            grid: range to which the samples are cropped.
            comm_range_m: agents farther from the ego do not take part.
            max_agents: at most this many agents per sample.
            keep_ego_box: count the ego's own body as an object where a collaborator has seen it.

        Raises:
            DataError: there is not a single frame.
        """
        self.drives = [open_drive(drive) for drive in drives]
        self.grid, self.comm_range_m, self.max_agents = grid, comm_range_m, max_agents
        self.keep_ego_box = keep_ego_box
        self.frames = [FrameRef(d, i) for d, reader in enumerate(self.drives) for i in range(len(reader))]
        if not self.frames:
            raise DataError(complaint(drives[0] if drives else "data", "frames", "at least one", 0))

    def egos(self, ref: FrameRef) -> list[int]:
        """Return the vehicles that can be the ego (all agents, where there is no vehicle), in folder order."""
        agents = self.drives[ref.drive].agents
        return [agent for agent in agents if agent >= 0] or list(agents)

    def sample(self, ref: FrameRef, ego_id: int, corruption: Corruption | None = None) -> Sample:
        """Return the sample of one frame and ego, with corrupted clouds beside the others if asked for.

        Raises:
            DataError: the sweeps do not say what the corruption needs.
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
        return make_sample(
            frame,
            ego_id,
            self.grid,
            comm_range_m=self.comm_range_m,
            max_agents=self.max_agents,
            keep_ego_box=self.keep_ego_box,
            key=f"{reader.drive.name}/{ego_id}/{reader.frames[ref.position]:06d}",
        )
