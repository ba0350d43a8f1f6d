"""Fusion by attention: each cell of the ego looks at the same cell of every agent.

Source: AttFuse, OPV2V, arXiv 2109.07644: scaled dot-product attention without parameters, query = key = value.
"""

import torch
from torch import Tensor


def fuse_attention(features: Tensor, agents: tuple[int, ...]) -> Tensor:
    """Fuse (N, C, H, W) features, rows of a sample consecutive and ego first, into (B, C, H, W).

    Only the ego's row of the attention is computed: the others would be thrown away.
    """
    return torch.stack([_ego_row(group) for group in features.split(list(agents))])


def _ego_row(group: Tensor) -> Tensor:
    """Attend from agent 0 of (A, C, H, W)."""
    if len(group) == 1:
        return group[0]
    scores = (group * group[:1]).sum(1, keepdim=True) / group.shape[1] ** 0.5
    return (torch.softmax(scores, dim=0) * group).sum(0)
