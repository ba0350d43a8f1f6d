"""No fusion: the ego alone."""

import torch
from torch import Tensor


def fuse_none(features: Tensor, agents: tuple[int, ...]) -> Tensor:
    """Keep the ego's rows of (N, C, H, W) features, as (B, C, H, W)."""
    return torch.stack([group[0] for group in features.split(list(agents))])
