"""V2VNet: graph network of messages between all agents."""

from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.fusion.base import AgentLayout, Fusion, zeroed
from dsrc.models.fusion.warp import about_centre, in_cells, shifted
from dsrc.models.settings import ModelSettings


class V2VNet(Fusion):
    """Graph network of two message rounds between all agents, (N, C, H, W) to (B, C, H, W).

    Source: V2VNet, arXiv 2008.07519, Section 3.3 (cross-vehicle aggregation), Equations 1 to 3. Per round and agent i:
    a 3 x 3 convolution of [j's features warped to i; i's features] is the message of j, zero outside j's map; the mean
    over all j, i itself included, enters a convolutional GRU with i's features. A linear layer per cell follows. The
    network that compensates delay is left out, as in OpenCOOD.

    Start: identity. The new features are `keep` times the old ones, 1 per channel at first, plus a gated candidate that
    starts at zero; the linear layer starts as the identity.

    Computed once, not per pair: the convolution is linear, so its two halves run once per j and once per i, and the
    last round runs for the ego alone. Without warps a round costs 2 A convolutions of C channels where the released
    code has A^2 of 2 C.

    Released (OpenCOOD): the GRU starts every call with a hidden state of zeros, so that it keeps nothing (`keep` 0);
    its reset gate and its weights for that state have no effect, and do not exist here. The mask of j's map turns about
    the first cell, the features about the map's centre; with rotation they disagree. `released` does so, else both turn
    about the centre.
    """

    place = "map"
    start = "identity"

    def __init__(self, channels: int, rounds: int = 2, released: bool = False) -> None:
        """Make a graph network; `released` masks as OpenCOOD does."""
        super().__init__()
        self.rounds, self.released = rounds, released
        self.message = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.update = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.candidate = zeroed(nn.Conv2d(2 * channels, channels, 3, padding=1))
        self.keep = nn.Parameter(torch.ones(channels))
        self.out = nn.Linear(channels, channels)
        nn.init.eye_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(settings.shrink_channels, released=settings.released)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse the maps."""
        rows = [self._ego(group, layout, b) for b, group in enumerate(layout.split(features))]
        fused = torch.stack(rows)
        return functional.conv2d(fused, self.out.weight[:, :, None, None], self.out.bias)

    def _ego(self, group: Tensor, layout: AgentLayout, sample: int) -> Tensor:
        """Return the ego's (C, H, W) after all rounds of (A, C, H, W)."""
        agents, size = len(group), group.shape[2:]
        motion = mask = None
        if layout.pairwise is not None:
            # [j, i]: from agent j to agent i.
            cells = in_cells(layout.pairwise[sample, :agents, :agents].double(), layout, (size[0], size[1]))
            motion = about_centre(cells, (size[0], size[1]))
            mask = self.covered(cells if self.released else motion, group)
        for turn in range(self.rounds):
            receivers = 1 if turn == self.rounds - 1 else agents
            messages = self._messages(group, motion, mask, receivers)
            group = self._step(group[:receivers], messages)
        return group[0]

    def _messages(self, group: Tensor, motion: Tensor | None, mask: Tensor | None, receivers: int) -> Tensor:
        """Return the (receivers, C, H, W) joined messages to each receiver in a round."""
        from_sender, from_self = self.message.weight.chunk(2, dim=1)
        own = functional.conv2d(group[:receivers], from_self, self.message.bias, padding=1)
        if motion is None or mask is None:
            return own + functional.conv2d(group, from_sender, padding=1).mean(0)
        messages = []
        for i in range(receivers):
            sent = functional.conv2d(shifted(group, motion[:, i]), from_sender, padding=1)
            messages.append(((sent + own[i]) * mask[:, i]).mean(0))
        return torch.stack(messages)

    def _step(self, own: Tensor, messages: Tensor) -> Tensor:
        both = torch.cat([own, messages], dim=1)
        return self.keep[:, None, None] * own + torch.sigmoid(self.update(both)) * torch.tanh(self.candidate(both))

    def covered(self, motion: Tensor, group: Tensor) -> Tensor:
        """Return the (A, A, 1, H, W) mask of cells of i, the second, that the map of j, the first, covers."""
        whole = torch.ones_like(group[:, :1])
        return torch.stack([shifted(whole, row, "nearest") for row in motion.unbind(1)], dim=1)
