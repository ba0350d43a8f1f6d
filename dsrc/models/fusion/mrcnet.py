"""MRCNet-style fusion across scales, by maximum and mean over the agents."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.fusion.base import AgentLayout, Fusion, stacked_maps, zeroed
from dsrc.models.fusion.warp import into_ego
from dsrc.models.settings import ModelSettings


class MRCNetStyle(Fusion):
    """MRCNet-style fusion, (N, C_k, H_k, W_k) scales to (B, C_k, H_k, W_k); no model of MRCNet was published.

    Source: MRCNet, Hong et al., CVPR 2024, pages 15301 to 15310: multi-scale robust fusion. All scales are brought to D
    channels by 1 x 1 convolutions. Ego and collaborator are joined by their maximum per scale; a pyramid brings each
    scale's third of the channels to the others and back. Maximum and mean over the ego and each collaborator's
    result, as two channels of a 3 x 3 x 3 convolution over channels and cells, are added to the ego's map.

    Start: identity. What is added is brought back to the scale's own width by a 1 x 1 convolution that starts at zero;
    so the ego's map keeps all its channels, and the decoder is that of any method. Before it, layers start as
    selections: the first channels of a scale, their maximum over the agents, nothing of the pyramid.

    The scales are sent unchanged and brought to D channels by the receiver: two thirds of the numbers, with the default
    widths.

    Not faithful, and cannot be: its motion enhancement needs earlier frames, which a `Sample` does not have, and is
    left out; its multi-scale deformable attention is left out, too (in the one public copy of the model its result is
    thrown away); there each place in the list of agents has weights of its own and absent ones are copies of the ego,
    here all collaborators share weights and absent ones are absent.
    """

    start = "identity"

    def __init__(self, channels: tuple[int, ...], width: int) -> None:
        """Make the layers.

        Args:
            width: D, channels of all scales while they are fused.
        """
        super().__init__()
        third = max(width // 3, 1)
        # Without bias, so that lost cells stay zero.
        project = [nn.Conv2d(c, width, 1, bias=False) for c in channels]
        join = [zeroed(nn.Conv3d(2, 1, 3, padding=1)) for _ in channels]
        for brought, maximum in zip(project, join, strict=True):
            nn.init.dirac_(brought.weight)
            maximum.weight.data[0, 0, 1, 1, 1] = 1.0
        self.project, self.join = nn.ModuleList(project), nn.ModuleList(join)
        self.thin = nn.Conv2d(width, third, 3, padding=1)
        self.grow = nn.ModuleDict(
            {
                f"{a}_{b}": nn.ConvTranspose2d(third, third, 2 ** (a - b), 2 ** (a - b))
                for a in range(3)
                for b in range(a)
            }
        )
        self.gather = nn.ModuleList(zeroed(nn.Conv2d(3 * third, width, 3, padding=1)) for _ in range(3))
        self.restore = nn.ModuleList(zeroed(nn.Conv2d(width, c, 1)) for c in channels)

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(settings.stage_channels, max(settings.decoder_widths))

    def forward(self, maps: Sequence[Tensor], layout: AgentLayout, network: object = None) -> list[Tensor]:
        """Fuse the scales."""
        alike = [layout.split(layer(scale)) for layer, scale in zip(self.project, maps, strict=True)]
        joined = [
            self._joined([into_ego(group, layout, b) for group in groups])
            for b, groups in enumerate(zip(*alike, strict=True))
        ]
        return [
            stacked_maps([group[0] for group in layout.split(scale)]) + layer(torch.stack(parts))
            for layer, scale, parts in zip(self.restore, maps, zip(*joined, strict=True), strict=True)
        ]

    def _joined(self, scales: list[Tensor]) -> list[Tensor]:
        """Return three (D, H_k, W_k) additions to the ego's map, from all agents' (A, D, H_k, W_k)."""
        alongside = [torch.cat([own[:1], part]) for own, part in zip(scales, self._enhanced(scales), strict=True)]
        both = [torch.stack([part.amax(0), part.mean(0)]) for part in alongside]
        return [torch.relu(_over_channels(join, pair)) for join, pair in zip(self.join, both, strict=True)]  # type: ignore[arg-type]

    def _enhanced(self, scales: list[Tensor]) -> list[Tensor]:
        """Return (A - 1, D, H_k, W_k) maps of each collaborator, joined with the ego and across scales."""
        strongest = [torch.maximum(scale[:1], scale[1:]) for scale in scales]
        if not len(strongest[0]):
            return strongest
        thin = [self.thin(scale) for scale in strongest]
        results = []
        for b, gather in enumerate(self.gather):
            size = thin[b].shape[-2:]
            parts = [
                thin[a]
                if a == b
                else self.grow[f"{a}_{b}"](thin[a])
                if a > b
                else functional.max_pool2d(thin[a], 2 ** (b - a))
                for a in range(3)
            ]
            results.append(strongest[b] + gather(torch.cat([part[..., : size[0], : size[1]] for part in parts], dim=1)))
        return results


def _over_channels(layer: nn.Conv3d, both: Tensor) -> Tensor:
    """Return the (D, H, W) result of an `nn.Conv3d(2, 1, 3)` on two (D, H, W) maps.

    Computed as a 2D convolution with three results per channel, shifted and added: thirty times faster on CPUs.
    """
    weight = layer.weight[0].transpose(0, 1)
    parts = functional.conv2d(both.transpose(0, 1), weight, padding=1)
    filled = functional.pad(parts, (0, 0, 0, 0, 0, 0, 1, 1))
    total = filled[:-2, 0] + filled[1:-1, 1] + filled[2:, 2]
    return total if layer.bias is None else total + layer.bias
