"""SampleStore: samples of drives by frame and ego, kept on disk once made.

Reading and transforming the sweeps of a frame takes longer than a training step; a stored sample is one read.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from dsrc.data.opv2v import DriveReader, data_hash
from dsrc.data.sample import GridSpec, Sample, make_sample
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, complaint


@dataclass(frozen=True, slots=True)
class FrameRef:
    """One frame: the number of its drive in the store and its position there."""

    drive: int
    position: int


class SampleStore:
    """Makes the samples of drives, or reads them where they were made before.

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
        cache: Path | None = None,
    ) -> None:
        """Look at the drives.

        Args:
            drives: their folders.
            grid: range to which the samples are cropped.
            comm_range_m: agents farther from the ego do not take part.
            max_agents: at most this many agents per sample.
            cache: folder for the made samples; None makes them anew each time.
        """
        self.drives = [DriveReader(drive) for drive in drives]
        self.grid, self.comm_range_m, self.max_agents = grid, comm_range_m, max_agents
        self.frames = [FrameRef(d, i) for d, reader in enumerate(self.drives) for i in range(len(reader))]
        if not self.frames:
            raise DataError(complaint(drives[0] if drives else "data", "frames", "at least one", 0))
        what = f"{data_hash(drives)} {grid} {comm_range_m} {max_agents}"
        self._cache = None if cache is None else cache / hashlib.sha256(what.encode()).hexdigest()[:16]
        self._recent: OrderedDict[FrameRef, Frame] = OrderedDict()

    def egos(self, ref: FrameRef) -> list[int]:
        """Return the vehicles that can be the ego (all agents, where there is no vehicle), in folder order."""
        agents = self.drives[ref.drive].agents
        return [agent for agent in agents if agent >= 0] or list(agents)

    def sample(self, ref: FrameRef, ego_id: int) -> Sample:
        """Return the sample of one frame and ego."""
        reader = self.drives[ref.drive]
        key = f"{reader.drive.name}/{ego_id}/{reader.frames[ref.position]:06d}"
        path = None if self._cache is None else self._cache / f"{ref.drive:03d}_{key.replace('/', '_')}.npz"
        if path is not None and path.exists():
            return read_sample(path)
        sample = make_sample(
            self._frame(ref),
            ego_id,
            self.grid,
            comm_range_m=self.comm_range_m,
            max_agents=self.max_agents,
            key=key,
        )
        if path is not None:
            write_sample(path, sample)
        return sample

    def _frame(self, ref: FrameRef) -> Frame:
        """Read a frame; the last few stay, since its other egos often come next."""
        if ref not in self._recent:
            self._recent[ref] = self.drives[ref.drive].read(ref.position)
            if len(self._recent) > 2:
                self._recent.popitem(last=False)
        return self._recent[ref]


def write_sample(path: Path, sample: Sample) -> None:
    """Write a sample as npz, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{id(sample):x}.tmp")
    objects = [sample.boxes, *sample.agent_boxes]
    with temporary.open("wb") as file:
        np.savez(
            file,
            key=np.array(sample.key),
            agent_ids=np.array(sample.agent_ids, np.int64),
            cloud_sizes=np.array([len(cloud) for cloud in sample.clouds]),
            clouds=np.concatenate(sample.clouds),
            ego_from_agent=sample.ego_from_agent,
            box_sizes=np.array([len(boxes) for boxes in objects]),
            boxes=np.concatenate([boxes.array for boxes in objects]),
            labels=np.concatenate([boxes.label for boxes in objects]),
            object_ids=np.concatenate([boxes.object_id for boxes in objects]),
        )
    temporary.replace(path)


def read_sample(path: Path) -> Sample:
    """Read what `write_sample` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        found = dict(arrays)
    clouds = np.split(found["clouds"], np.cumsum(found["cloud_sizes"])[:-1])
    edges = np.concatenate([[0], np.cumsum(found["box_sizes"])])
    objects = [
        Boxes.from_array(found["boxes"][a:b], found["labels"][a:b], found["object_ids"][a:b])
        for a, b in pairwise(edges)
    ]
    return Sample(
        key=str(found["key"]),
        agent_ids=tuple(int(agent) for agent in found["agent_ids"]),
        clouds=tuple(clouds),
        ego_from_agent=found["ego_from_agent"],
        boxes=objects[0],
        agent_boxes=tuple(objects[1:]),
    )
