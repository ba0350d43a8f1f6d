"""Base class of the fusion methods, and the layout of agents in a batch that they read."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self, TypeVar

import torch
from torch import Tensor, nn

from dsrc.models.device import Movable
from dsrc.models.settings import ModelSettings

# Legend: N agents of all samples, B samples, A agents of one sample, L most agents of a sample.

Layer = TypeVar("Layer", bound=nn.Module)


@dataclass(frozen=True, slots=True, eq=False)
class AgentLayout(Movable):
    """Layout of agents in a batch: agents per sample, lost tiles, kinds, delays, poses.

    Attributes:
        agents: (B,) number of agents of each sample; their rows are consecutive, ego first.
        lost: (N, H / 8, W / 8) bool lost tiles of the agents' maps; None when all arrived.
        roadside: (N,) bool, True for roadside units; None when all are vehicles.
        delay: (N,) int64 age of the features in frames; None when all are current.
        pairwise: (B, L, L, 4, 4) `[b, i, j]` maps points of agent i's frame to agent j's, m; rows of absent agents are
            not read. None when all features are in the ego's frame already, as they are when clouds are projected
            before they are encoded.
        extent_m: width (x) and height (y) of the maps, m; read with `pairwise` alone, like the next.
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
        """Split (N, ...) rows by sample."""
        return x.split(list(self.agents))


class Fusion(nn.Module):
    """Fusion method: feature maps of several agents to one map per sample.

    A method overrides `fuse`, or `forward` where scales depend on each other, and `from_settings` where it has weights.
    Contract: `dsrc.models.fusion_check.check_fusion`.

    Attributes:
        place: maps that are fused: `stages`, the three scales of the backbone, each before the decoder; or `map`, one
            map of `shrink_channels` after decoder and shrink convolutions, at a quarter of the grid's resolution
            unless `shrink_stride` says otherwise.
        scales_sent: number of stages that are transmitted.
        start: output of an untrained method with weights: `identity`, the ego's maps, or `maximum`, the largest value
            of all agents per channel and cell. It is exact, so that a network whose other weights come from a detector
            of single clouds starts with all that this one knows. Empty for methods without weights.
        ordered: the order of the collaborators matters, as with an embedding of an agent's place in the list.
    """

    place: ClassVar[Literal["stages", "map"]] = "stages"
    scales_sent: ClassVar[int] = 3
    start: ClassVar[Literal["", "identity", "maximum"]] = ""
    ordered: ClassVar[bool] = False

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls()

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return the numbers that an agent sends per frame, at most."""
        cells = settings.grid.width * settings.grid.height
        if cls.place == "map":
            return settings.shrink_channels * cells // settings.map_stride**2
        sent = settings.stage_channels[: cls.scales_sent]
        return sum(channels * cells // 4 ** (k + 1) for k, channels in enumerate(sent))

    @classmethod
    def channels_sent(cls, settings: ModelSettings) -> int:
        """Return the channels of all maps that an agent sends."""
        return settings.shrink_channels if cls.place == "map" else sum(settings.stage_channels[: cls.scales_sent])

    def send(self, maps: Sequence[Tensor], layout: AgentLayout, network: object = None) -> list[Tensor]:
        """Return the transmitted part of the agents' maps, zeros elsewhere; arguments as of `forward`."""
        return list(maps)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale's (N, C, H, W) maps into (B, C, H, W)."""
        raise NotImplementedError

    def forward(self, maps: Sequence[Tensor], layout: AgentLayout, network: object = None) -> list[Tensor]:
        """Fuse transmitted maps.

        Args:
            maps: (N, C, H, W) each, as of `send`.
            network: the detector, for a method that runs parts of it again.

        Returns:
            (B, C, H, W) each.
        """
        return [self.fuse(features, layout) for features in maps]


def zeroed(layer: Layer) -> Layer:
    """Set a layer's weights to zero, so that it adds nothing to a map before training."""
    for weight in layer.parameters():
        nn.init.zeros_(weight)
    return layer


def stacked_maps(rows: Sequence[Tensor]) -> Tensor:
    """Stack B (C, H, W) maps to (B, C, H, W) in their memory order, which `torch.stack` changes."""
    return rows[0][None] if len(rows) == 1 else torch.cat([row[None] for row in rows])
