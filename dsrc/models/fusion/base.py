"""What all fusion methods have in common: whose features they get, and how they are called."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self, TypeVar

import torch
from torch import Tensor, nn

from dsrc.models.settings import ModelSettings

# Legend: N agents of all samples, B samples, A agents of one sample, L most agents of a sample.

Layer = TypeVar("Layer", bound=nn.Module)


@dataclass(frozen=True, slots=True, eq=False)
class AgentLayout:
    """Who stands in the rows of a batch of features, and what of them arrived.

    Attributes:
        agents: (B,) number of agents of each sample; their rows are consecutive, ego first.
        lost: (N, H / 8, W / 8) bool tiles of the agents' maps that did not arrive; None when all did.
        roadside: (N,) bool whether an agent is a roadside unit; None when all are vehicles.
        delay: (N,) int64 age of the features in frames; None when all are of now.
        pairwise: (B, L, L, 4, 4) `[b, i, j]` maps points of agent i's frame to agent j's, m; rows of absent agents are
            not read. None when all features are in the ego's frame already, as they are when clouds are projected
            before they are encoded.
        extent_m: width (x) and height (y) of the maps, m; needed with `pairwise` alone, like the next.
        centre_m: x and y of the maps' centre in their agents' frames, m.
    """

    agents: tuple[int, ...]
    lost: Tensor | None = None
    roadside: Tensor | None = None
    delay: Tensor | None = None
    pairwise: Tensor | None = None
    extent_m: tuple[float, float] = (0.0, 0.0)
    centre_m: tuple[float, float] = (0.0, 0.0)

    def split(self, x: Tensor) -> tuple[Tensor, ...]:
        """Return the rows of each sample."""
        return x.split(list(self.agents))

    def to(self, device: torch.device | str) -> "AgentLayout":
        """Move the tensors to a device."""
        moved: dict[str, Any] = {
            name: part.to(device)
            for name in ("lost", "roadside", "delay", "pairwise")
            if (part := getattr(self, name)) is not None
        }
        return replace(self, **moved)


class Fusion(nn.Module):
    """A way to make one feature map of several agents' maps.

    Attributes:
        place: which maps the agents send: `stages`, the three scales of the backbone, each fused by itself before the
            decoder; or `map`, one map of `shrink_channels` at a quarter of the grid's resolution, after decoder and
            shrink convolutions.
        scales_sent: how many of the stages go through the air.
        start: what a method with weights of its own gives before they are trained: `identity`, the ego's maps, or
            `maximum`, the largest of all agents' values per channel and cell. It is exact, so that a network whose
            other weights come from a detector of single clouds starts with all that this one knows. Empty for methods
            without weights.
    """

    place: ClassVar[Literal["stages", "map"]] = "stages"
    scales_sent: ClassVar[int] = 3
    start: ClassVar[Literal["", "identity", "maximum"]] = ""

    @classmethod
    def of(cls, settings: ModelSettings) -> Self:
        """Return the fusion for a detector of these settings."""
        return cls()

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return how many numbers an agent sends of one frame, at most."""
        cells = settings.grid.width * settings.grid.height
        if cls.place == "map":
            return settings.shrink_channels * cells // 16
        sent = settings.stage_channels[: cls.scales_sent]
        return sum(channels * cells // 4 ** (k + 1) for k, channels in enumerate(sent))

    @classmethod
    def channels_sent(cls, settings: ModelSettings) -> int:
        """Return how many channels the maps that an agent sends have together."""
        return settings.shrink_channels if cls.place == "map" else sum(settings.stage_channels[: cls.scales_sent])

    def send(self, maps: Sequence[Tensor], layout: AgentLayout, network: Any = None) -> list[Tensor]:
        """Return what the agents send of their maps, cells that are not sent being zero; arguments as of `forward`."""
        return list(maps)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale's (N, C, H, W) maps into (B, C, H, W)."""
        raise NotImplementedError

    def forward(self, maps: Sequence[Tensor], layout: AgentLayout, network: Any = None) -> list[Tensor]:
        """Fuse what the agents sent.

        Args:
            maps: what they sent, (N, C, H, W) each.
            layout: whose they are.
            network: the detector, for a method that lets parts of it run again.
        """
        return [self.fuse(features, layout) for features in maps]


def silent(layer: Layer) -> Layer:
    """Return a layer with weights of zero, so that what it adds to a map is learned from nothing."""
    for weight in layer.parameters():
        nn.init.zeros_(weight)
    return layer


def stacked(rows: Sequence[Tensor]) -> Tensor:
    """Return (B, C, H, W) of B (C, H, W) maps in the order that they have in memory, as `torch.stack` does not."""
    return rows[0][None] if len(rows) == 1 else torch.cat([row[None] for row in rows])
