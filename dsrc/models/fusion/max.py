"""Maximum fusion over the agents, of three scales or of one map."""

from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion, stacked_maps
from dsrc.models.fusion.warp import into_ego


class MaxFusion(Fusion):
    """Maximum over the agents per channel and cell, (N, C, H, W) to (B, C, H, W).

    Source: F-Cooper, arXiv 1909.06459, Section 3.3 (maxout of spatial features).

    Released: OpenCOOD fuses once, the 256 channels after decoder and a shrink layer. Here the three scales are fused
    each by itself, as in DSRC's own comparison (Table 3, Maximum) and CoAlign's `MaxFusion`.
    """

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale."""
        groups = layout.split(features)
        return stacked_maps([into_ego(group, layout, b).amax(0) for b, group in enumerate(groups)])


class MaxMapFusion(MaxFusion):
    """Maximum fusion of one map, after decoder and shrink convolutions, (N, C, h, w) to (B, C, h, w).

    Source: F-Cooper as OpenCOOD has it, but at a quarter of the grid's resolution: the layers of V2VNet, V2X-ViT,
    CoBEVT and ERMVP without weights of the fusion. Trained on single clouds (`max_agents` 1), it gives those four all
    their other weights.
    """

    place = "map"
