"""Where2comm: fusion of the cells that their senders are confident of."""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import functional

from dsrc.models.fusion.attention import attended
from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.settings import ModelSettings


class Where2comm(Fusion):
    """Confidence-selected cells of the first scale, fused by attention per scale.

    Source: Where2comm, arXiv 2209.12836, Section 4: the confidence of a cell is that of the agent's own detections
    there (4.2), smoothed by a 5 x 5 Gaussian; above 0.01 it is sent (4.3); the receiver computes the further scales of
    the received cells and fuses each by attention per cell (4.4). One round. In training a random number of the best
    cells is sent. (N, C, H, W) scales to (B, C, H, W); the confidence takes a run of decoder and heads on every
    collaborator's maps.

    Released: the authors' code keeps the whole maps of the third and the fifth agent, too, not the ego's alone:
    `released` does so. Its Gaussian has the amplitude 1 / (2 pi sigma), here too.
    """

    scales_sent = 1

    def __init__(self, threshold: float = 0.01, released: bool = False) -> None:
        """Make the selection.

        Args:
            threshold: smoothed confidence above which a cell is sent.
            released: keep the maps of every other agent whole.
        """
        super().__init__()
        self.threshold, self.released = threshold, released
        self.kernel: Tensor
        self.register_buffer("kernel", gaussian(5, 1.0), persistent=False)

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(released=settings.released)

    def send(self, maps: Sequence[Tensor], layout: AgentLayout, network: Any = None) -> list[Tensor]:
        """Return the first scale, zero in the cells that are not sent."""
        if self.training:
            confidence = self.smoothed(network.logits(maps))
            return [maps[0] * self.as_large(self.mask(confidence, layout), maps[0])]
        # An ego keeps its whole map: only the collaborators' confidence is needed.
        starts = set(accumulate((0, *layout.agents)))
        others = [row for row in range(len(maps[0])) if row not in starts]
        if not others:
            return list(maps)
        found = self.smoothed(network.logits([scale[others] for scale in maps]))
        confidence = found.new_zeros((len(maps[0]), *found.shape[1:]))
        confidence[others] = found
        return [maps[0] * self.as_large(self.mask(confidence, layout), maps[0])]

    def forward(self, maps: Sequence[Tensor], layout: AgentLayout, network: Any = None) -> list[Tensor]:
        """Fuse the first scale and the network's later stages of it."""
        scales = list(maps)
        for stage in network.backbone.stages[len(scales) :]:
            scales.append(stage(scales[-1]))
        return [self.fuse(scale, layout) for scale in scales]

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale."""
        return attended(features, layout)

    def smoothed(self, logits: Tensor) -> Tensor:
        """Return the (N, 1, h, w) smoothed confidence of (N, anchors, h, w) logits."""
        best = torch.sigmoid(logits.detach()).amax(1, keepdim=True)
        return functional.conv2d(best, self.kernel.to(best.dtype), padding=self.kernel.shape[-1] // 2)

    def as_large(self, mask: Tensor, features: Tensor) -> Tensor:
        """Resize an (N, 1, h, w) mask to (N, C, H, W), with soft edges where it is coarser."""
        size = features.shape[-2:]
        if mask.shape[-2:] == size:
            return mask
        return functional.interpolate(mask, size, mode="bilinear", align_corners=False)

    def mask(self, confidence: Tensor, layout: AgentLayout) -> Tensor:
        """Return the (N, 1, h, w) mask of cells that are sent or the ego's own."""
        if self.training:
            parts = [_best(group) for group in layout.split(confidence)]
        else:
            parts = [(group > self.threshold).to(confidence.dtype) for group in layout.split(confidence)]
        for part in parts:
            part[:: 2 if self.released else len(part)] = 1.0
        return torch.cat(parts)


def _best(group: Tensor) -> Tensor:
    """Return a mask of a random number of the most confident cells of (A, 1, h, w)."""
    flat = group.flatten(1)
    count = int(flat.shape[1] * torch.rand(()).item())
    mask = torch.zeros_like(flat).scatter(1, flat.topk(count, dim=1, sorted=False).indices, 1.0)
    return mask.view_as(group)


def gaussian(size: int, sigma: float) -> Tensor:
    """Return a (1, 1, size, size) Gaussian kernel."""
    x = torch.arange(size) - size // 2
    square = x[:, None] ** 2 + x[None] ** 2
    return (torch.exp(-square / (2 * sigma**2)) / (2 * math.pi * sigma))[None, None]
