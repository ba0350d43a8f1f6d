"""Attention fusion: each cell of the ego attends to the same cell of every agent."""

import torch
from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion, stacked_maps
from dsrc.models.fusion.warp import into_ego


class AttentionFusion(Fusion):
    """Per-cell scaled dot-product attention without parameters, (N, C, H, W) to (B, C, H, W).

    Source: AttFuse, OPV2V, arXiv 2109.07644, Section IV: query, key and value are the features themselves, the scale is
    the root of C. DSRC (arXiv 2412.10739, Figure 2) fuses its three scales so.

    Released: computed for all agents' rows, of which only the ego's is kept; here for the ego's alone.
    """

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale."""
        return stacked_maps([ego_row(into_ego(g, layout, b)) for b, g in enumerate(layout.split(features))])


def ego_row(group: Tensor) -> Tensor:
    """Attend from agent 0 of (A, C, H, W)."""
    # Channels last, the order of CPU convolutions: sums over the second axis take five times as long.
    x = group.permute(0, 2, 3, 1)
    scores = (x * x[:1]).sum(3, keepdim=True) / x.shape[3] ** 0.5
    return (torch.softmax(scores, dim=0) * x).sum(0).permute(2, 0, 1)
