"""How the agents' feature maps become one: one file per method, all `(features, agents) -> fused`."""

from collections.abc import Callable

from torch import Tensor

from dsrc.models.fusion.attention import fuse_attention
from dsrc.models.fusion.late import fuse_late
from dsrc.models.fusion.max import fuse_max
from dsrc.models.fusion.none import fuse_none

FusionMethod = Callable[[Tensor, tuple[int, ...]], Tensor]
"""Fuses (N, C, H, W) features of consecutive agents, ego first, into (B, C, H, W)."""

FUSIONS: dict[str, FusionMethod] = {
    "attention": fuse_attention,
    "max": fuse_max,
    "none": fuse_none,
    "late": fuse_late,
}
