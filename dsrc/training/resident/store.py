"""Store of the points of all frames of a training in a device's memory; boxes and poses stay with the host."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import own_body
from dsrc.models.device import Movable
from dsrc.training.samples import FrameRef, SampleStore
from sensors.frame import Frame

POINT_BYTES = 16
"""Bytes of a point: x, y, z and intensity."""


@dataclass(frozen=True, slots=True, eq=False)
class FramePoints(Movable):
    """Points of a frame, agent by agent in the order of the frame, without their own bodies.

    Attributes:
        points: (P, 4) float32 x, y, z in the agent's LiDAR frame and intensity.
        rows: (O,) int64 rows, within an agent's points, of those in a box of the ground truth; ascending.
        owners: (O, K) int64 rows of their boxes, the last one repeated: boxes can overlap.
        sizes: (A,) points of each agent.
        found: (A,) of these in boxes.
    """

    points: Tensor
    rows: Tensor
    owners: Tensor
    sizes: tuple[int, ...]
    found: tuple[int, ...]

    @classmethod
    def of(cls, frame: Frame) -> "FramePoints":
        """Take the points of a frame.

        Rotating, mirroring, and scaling points and boxes alike moves no point out of its box or into it, but for those
        that are within rounding of a face.
        """
        clouds, rows, owners = [], [], []
        for row, agent in enumerate(frame.agents):
            sweep = agent.sweep
            kept = ~own_body(frame, row) & np.isfinite(sweep.points).all(axis=1)
            cloud = np.concatenate([sweep.points, sweep.intensity[:, None]], axis=1)[kept].astype(np.float32)
            inside, boxes = points_in_boxes(frame.truth, cloud, sweep.world_from_lidar)
            clouds.append(cloud)
            points, first, count = np.unique(inside, return_index=True, return_counts=True)
            rows.append(points)
            most = int(count.max(initial=1))
            owners.append(boxes[first[:, None] + np.minimum(np.arange(most), count[:, None] - 1)])
        most = max((own.shape[1] for own in owners), default=1)
        owners = [np.pad(own, ((0, 0), (0, most - own.shape[1])), "edge") for own in owners]
        return cls(
            points=_tensor(clouds, np.zeros((0, 4), np.float32)),
            rows=_tensor(rows, np.zeros(0, np.int64)),
            owners=_tensor(owners, np.zeros((0, most), np.int64)),
            sizes=tuple(map(len, clouds)),
            found=tuple(map(len, rows)),
        )


def _tensor(parts: Sequence[NDArray], none: NDArray) -> Tensor:
    return torch.from_numpy(np.concatenate([none, *parts]).astype(none.dtype, copy=False))


def without_points(frame: Frame) -> Frame:
    """Return a frame with its poses, boxes and counts alone."""
    return replace(frame, agents=tuple(replace(agent, sweep=agent.sweep[:0]) for agent in frame.agents))


class _Frames(Dataset[tuple[Frame, FramePoints]]):
    """Frames of a store of samples, to be read by several processes."""

    def __init__(self, store: SampleStore, frames: Sequence[FrameRef]) -> None:
        self.store, self.frames = store, frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, number: int) -> tuple[Frame, FramePoints]:
        ref = self.frames[number]
        frame = self.store.drives[ref.drive].read(ref.position)
        return without_points(frame), FramePoints.of(frame)


def expected_bytes(store: SampleStore, frames: Sequence[FrameRef]) -> int:
    """Return about how many bytes the points of frames take, as many in each as in the first of its drive."""
    total = 0
    for drive in sorted({ref.drive for ref in frames}):
        own = [ref for ref in frames if ref.drive == drive]
        first = store.drives[drive].read(own[0].position)
        total += POINT_BYTES * len(own) * sum(len(agent.sweep) for agent in first.agents)
    return total


def free_bytes(device: torch.device) -> int:
    """Return the free memory of a GPU."""
    return torch.cuda.mem_get_info(device)[0]


class ResidentPoints:
    """Points of frames on a device.

    Attributes:
        frames: without points, by their numbers.
        points: theirs.
        device: where they are.
    """

    def __init__(
        self, store: SampleStore, frames: Sequence[FrameRef], device: torch.device | str, workers: int = 0
    ) -> None:
        """Read the frames.

        Args:
            workers: processes that read.
        """
        self.device = torch.device(device)
        self.frames: list[Frame] = []
        self.points: list[FramePoints] = []
        loader = DataLoader(_Frames(store, frames), batch_size=None, collate_fn=_as_it_is, num_workers=workers)
        for frame, points in loader:
            self.frames.append(frame)
            self.points.append(points.to(self.device))


def _as_it_is(item: Any) -> Any:
    return item
