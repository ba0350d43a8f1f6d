"""CoBEVT: fused axial attention over agents and space."""

from collections.abc import Iterable
from typing import ClassVar, Self

import torch
from torch import Tensor, nn

from dsrc.models.fusion.base import AgentLayout, Fusion, stacked_maps, zeroed
from dsrc.models.fusion.warp import into_ego
from dsrc.models.fusion.windows import AgentWindows, FeedForward, Residual, padded
from dsrc.models.settings import ModelSettings


class WindowFusion(Fusion):
    """Blocks of attention in windows over the agents' cells, then the mean over the agents, a norm and a linear layer.

    Attributes:
        agents: largest number of agents.
        window: side of a window, cells.
        multiple: windows to whose multiples a map is padded.
        released: pad the agents with zero maps, masked as keys, as OpenCOOD does.
    """

    place = "map"
    ordered = True
    multiple: ClassVar[int] = 1

    def __init__(self, agents: int, window: int, released: bool) -> None:
        super().__init__()
        self.agents, self.window, self.released = agents, window, released

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(settings.shrink_channels, settings.max_agents, released=settings.released)  # type: ignore[call-arg]

    def _build(self, channels: int, blocks: Iterable[dict[str, nn.Module]]) -> None:
        """Set the blocks, each attention and feed-forward twice, and the layers after them."""
        self.blocks = nn.ModuleList(nn.ModuleDict(block) for block in blocks)
        self.norm = nn.LayerNorm(channels)
        self.out = zeroed(nn.Linear(channels, channels))
        self.keep = nn.Parameter(torch.ones(channels))

    def attend(self, group: Tensor) -> Tensor:
        """Return (A, H, W, C) features of one sample's (A, C, H, W) after the blocks."""
        height, width = group.shape[-2:]
        x, valid = padded(group.permute(0, 2, 3, 1), self.multiple * self.window)
        if self.released:
            valid = torch.ones(x.shape[:3], dtype=torch.bool, device=x.device) if valid is None else valid
            absent = self.agents - len(x)
            x, valid = (torch.cat([part, part.new_zeros((absent, *part.shape[1:]))]) for part in (x, valid))
        for block in self.blocks:
            near, forward, wide, forward_again = block.values()  # type: ignore[operator]
            x = forward(near(x, valid))
            x = forward_again(wide(x, valid))
        return x[:, :height, :width]

    def head(self, x: Tensor) -> Tensor:
        """Return (C, H, W) of (A, H, W, C)."""
        return self.out(self.norm(x.mean(0))).permute(2, 0, 1)


class CoBEVT(WindowFusion):
    """Fused axial attention, (N, C, H, W) to (B, C, H, W).

    Source: CoBEVT, arXiv 2207.02202, Section 3.2 and Figure 3. Three blocks of: attention among all agents' cells in
    4 x 4 windows, feed-forward; attention in windows of 4 x 4 cells spread evenly over the map, feed-forward; each with
    norm first and residual. Then the mean over the agents, a norm and a linear layer. A map that windows do not divide
    is padded with masked cells, and cropped again.

    Start: maximum. The maximum over the agents, times `keep` (1 per channel at first, 0 in the published network), is
    added to the result of the linear layer, which starts at zero.

    Released (OpenCOOD): the agents are padded to the maximum with zero maps, masked as keys, but attending as queries
    and counted in the mean. `released` does so; else there are real agents only. OpenCOOD fails on maps that windows do
    not divide.
    """

    start = "maximum"

    def __init__(
        self,
        channels: int,
        agents: int = 5,
        depth: int = 3,
        heads: int = 8,
        window: int = 4,
        hidden: int | None = None,
        dropout: float = 0.1,
        released: bool = False,
    ) -> None:
        """Make the blocks; feed-forward layers have the width `hidden`, None for that of the maps."""
        super().__init__(agents, window, released)

        def attention(spread: bool) -> Residual:
            return Residual(channels, AgentWindows(channels, heads, agents, window, dropout, spread))

        def forward() -> Residual:
            return Residual(channels, FeedForward(channels, hidden or channels, dropout))

        self._build(
            channels,
            (
                {
                    "near": attention(False),
                    "near_forward": forward(),
                    "spread": attention(True),
                    "spread_forward": forward(),
                }
                for _ in range(depth)
            ),
        )

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse the maps."""
        groups = [into_ego(group, layout, b) for b, group in enumerate(layout.split(features))]
        learned = torch.stack([self.head(self.attend(group)) for group in groups])
        return self.keep[:, None, None] * stacked_maps([group.amax(0) for group in groups]) + learned
