"""Fusion by the maximum over the agents. Source: F-Cooper, arXiv 1909.06459."""

import torch
from torch import Tensor


def fuse_max(features: Tensor, agents: tuple[int, ...]) -> Tensor:
    """Fuse (N, C, H, W) features, rows of a sample consecutive and ego first, into (B, C, H, W)."""
    return torch.stack([group.amax(0) for group in features.split(list(agents))])
