"""Early fusion: raw points of all agents in one cloud."""

from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.settings import ModelSettings


class EarlyFusion(Fusion):
    """Early fusion: a single-agent network on the joined points of all agents.

    Source: Cooper, arXiv 1905.05265, Section III. The clouds are joined in the ego LiDAR's frame before they become
    pillars, so (1, C, H, W) maps per sample pass unchanged; the cap of points per pillar holds for all agents together,
    the ego's first.

    Released: OpenCOOD shuffles the joined points before its voxeliser.
    """

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return 0: clouds are sent, not maps."""
        return 0

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Return the maps unchanged."""
        return features
