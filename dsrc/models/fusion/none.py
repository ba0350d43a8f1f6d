"""No fusion: the ego's maps alone."""

import torch
from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.settings import ModelSettings


class NoFusion(Fusion):
    """No collaboration: the ego's maps as they are, (N, C, H, W) to (B, C, H, W).

    Released: OpenCOOD has no such model; its users set the number of agents to one and test against the ground truth of
    all agents, as here.
    """

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return 0: nothing is sent."""
        return 0

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Keep the first row of each sample."""
        return torch.stack([group[0] for group in layout.split(features)])
