"""Late fusion: the agents share boxes, not features.

The network is a single-agent one. All clouds of a `Sample` are in the ego LiDAR's frame already, so every cloud is
detected on separately in that frame and one non-maximum suppression joins the results: no boxes need transforming.
Each agent's cloud is a sample of its own, in training too, with the objects that this agent annotated.
"""

import numpy as np
from torch import Tensor

from dsrc.detections import Detections
from dsrc.ops.nms import rotated_nms
from sim.boxes import concatenate


def fuse_late(features: Tensor, agents: tuple[int, ...]) -> Tensor:
    """Return (N, C, H, W) features as they are: each cloud stands alone."""
    return features


def join_detections(parts: list[Detections], nms_iou: float) -> Detections:
    """Join the agents' detections, all in the ego LiDAR's frame, by one rotated non-maximum suppression."""
    boxes = concatenate([part.boxes for part in parts])
    score = np.concatenate([np.zeros(0, np.float32), *(part.score for part in parts)])
    kept = rotated_nms(boxes.array, score, nms_iou)
    return Detections(boxes[kept], score[kept])
