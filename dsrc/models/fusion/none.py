"""No fusion: the ego alone."""

import torch
from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.settings import ModelSettings


class NoFusion(Fusion):
    """No collaboration: the ego's maps as they are, (N, C, H, W) to (B, C, H, W).

    Released: OpenCOOD has no such model; its users set the number of agents to one, and the ground truth of the test
    stays what all agents see. Here too.
    """

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return 0."""
        return 0

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Keep the first row of each sample."""
        return torch.stack([group[0] for group in layout.split(features)])
