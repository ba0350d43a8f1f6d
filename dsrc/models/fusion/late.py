"""Late fusion: detections of all agents in one non-maximum suppression."""

import numpy as np
from torch import Tensor

from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from dsrc.ops.iou import rotated_nms
from sim.boxes import concatenate


class LateFusion(Fusion):
    """Late fusion: boxes of all agents, one non-maximum suppression.

    Source: OPV2V, arXiv 2109.07644, Section IV. The network is a single-agent one. All clouds of a `Sample` are in the
    ego LiDAR's frame already, so boxes need no transform.
    Each agent's cloud is a sample of its own, in training too, with the objects that this agent annotated: (N, C, H, W)
    maps stay (N, C, H, W).

    Released: OpenCOOD detects in each agent's own frame, and its recipe within 70.4 m of an agent only.
    """

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return 0: boxes are sent, not maps."""
        return 0

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Return the maps unchanged: each cloud is a sample."""
        return features


def join_detections(parts: list[Detections], nms_iou: float) -> Detections:
    """Merge the agents' detections, all in the ego LiDAR's frame, by one rotated non-maximum suppression."""
    boxes = concatenate([part.boxes for part in parts])
    score = np.concatenate([np.zeros(0, np.float32), *(part.score for part in parts)])
    kept = rotated_nms(boxes.array, score, nms_iou)
    return Detections(boxes[kept], score[kept])
