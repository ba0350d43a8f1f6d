"""CoBEVT: fused axial attention over agents and space."""

from typing import Self

import torch
from torch import Tensor, nn

from dsrc.models.fusion.base import AgentLayout, Fusion, stacked, zeroed
from dsrc.models.fusion.warp import into_ego
from dsrc.models.fusion.windows import AgentWindows, FeedForward, Residual, padded
from dsrc.models.settings import ModelSettings


class CoBEVT(Fusion):
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

    place = "map"
    start = "maximum"
    ordered = True

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
        """Make the blocks.

        Args:
            window: side of a window, cells.
            hidden: width of the feed-forward layers; None is that of the maps.
            released: pad the agents as OpenCOOD does.
        """
        super().__init__()
        self.agents, self.window, self.released = agents, window, released

        def attention() -> Residual:
            return Residual(channels, AgentWindows(channels, heads, agents, window, dropout))

        def forward() -> Residual:
            return Residual(channels, FeedForward(channels, hidden or channels, dropout))

        self.blocks = nn.ModuleList(
            nn.ModuleDict(
                {"near": attention(), "near_forward": forward(), "spread": attention(), "spread_forward": forward()}
            )
            for _ in range(depth)
        )
        self.norm = nn.LayerNorm(channels)
        self.out = zeroed(nn.Linear(channels, channels))
        self.keep = nn.Parameter(torch.ones(channels))

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(settings.shrink_channels, settings.max_agents, released=settings.released)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse the maps."""
        groups = [into_ego(group, layout, b) for b, group in enumerate(layout.split(features))]
        learned = torch.stack([self.head(self.attend(group)) for group in groups])
        return self.keep[:, None, None] * stacked([group.amax(0) for group in groups]) + learned

    def attend(self, group: Tensor) -> Tensor:
        """Return (A, H, W, C) features of one sample's (A, C, H, W) after the blocks."""
        height, width = group.shape[-2:]
        x, valid = padded(group.permute(0, 2, 3, 1), self.window)
        if self.released:
            x, valid = with_absent(x, valid, self.agents)
        for block in self.blocks:
            layers: nn.ModuleDict = block  # type: ignore[assignment]
            x = layers["near_forward"](layers["near"](x, valid, False))
            x = layers["spread_forward"](layers["spread"](x, valid, True))
        return x[:, :height, :width]

    def head(self, x: Tensor) -> Tensor:
        """Return (C, H, W) of (A, H, W, C)."""
        return self.out(self.norm(x.mean(0))).permute(2, 0, 1)


def with_absent(x: Tensor, valid: Tensor | None, agents: int) -> tuple[Tensor, Tensor]:
    """Pad to (L, H, W, C) features with zeros for absent agents, and return the (L, H, W) mask of real cells."""
    if valid is None:
        valid = torch.ones(x.shape[:3], dtype=torch.bool, device=x.device)
    absent = agents - len(x)
    return torch.cat([x, x.new_zeros((absent, *x.shape[1:]))]), torch.cat(
        [valid, valid.new_zeros((absent, *valid.shape[1:]))]
    )
