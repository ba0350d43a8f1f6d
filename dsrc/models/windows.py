"""Windows: parts of the samples' maps around road users, on which a step of a training costs less."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dsrc.models.fusion.base import AgentLayout

ALIGNED = 8
"""Input cells between two places of a window: those of a cell of the coarsest scale."""


@dataclass(frozen=True, slots=True)
class Windows:
    """One window of each of B samples.

    Attributes:
        low: (B,) first row and column, input cells.
        size: height and width, input cells.
    """

    low: tuple[tuple[int, int], ...]
    size: tuple[int, int]

    @classmethod
    def around(cls, positive: Tensor, size: tuple[int, int], stride: int) -> "Windows":
        """Draw windows with a random positive anchor of their sample in them; anywhere without one.

        Args:
            positive: (B, h, w, 2) bool positive anchors.
            size: height and width, input cells, multiples of `ALIGNED`; no larger than the map.
            stride: input cells of a cell of the anchors.
        """
        low = []
        for sample in positive:
            last = [sample.shape[axis] * stride - size[axis] for axis in (0, 1)]
            first = [int(torch.randint(0, most + 1, ())) for most in last]
            places = sample.any(-1).nonzero() * stride
            if len(places):
                place = places[int(torch.randint(0, len(places), ()))].tolist()
                # Down to a multiple of `ALIGNED`, so that the place stays inside.
                first = [int(at - torch.randint(0, size[axis] - ALIGNED + 1, ())) for axis, at in enumerate(place)]
            row, column = (min(max(at, 0), most) // ALIGNED * ALIGNED for at, most in zip(first, last, strict=True))
            low.append((row, column))
        return cls(tuple(low), size)

    def of_agents(self, maps: Tensor, layout: AgentLayout) -> Tensor:
        """Return the windows (N, C, *size) of the maps (N, C, H, W) of all samples' agents."""
        low = [each for each, count in zip(self.low, layout.agents, strict=True) for _ in range(count)]
        height, width = self.size
        return torch.stack(
            [part[:, row : row + height, at : at + width] for part, (row, at) in zip(maps, low, strict=True)]
        )

    def of_samples(self, maps: Tensor, stride: int) -> Tensor:
        """Return the windows (B, *size / stride, ...) of maps (B, h, w, ...) at a stride of input cells."""
        height, width = (cells // stride for cells in self.size)
        return torch.stack(
            [
                part[row // stride : row // stride + height, at // stride : at // stride + width]
                for part, (row, at) in zip(maps, self.low, strict=True)
            ]
        )
