"""Detector: pillars of all agents to boxes in the ego LiDAR's frame. Student and teacher are the same class."""

from dataclasses import dataclass
from functools import cached_property
from math import log

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dsrc.data.batch import collate
from dsrc.data.sample import Sample
from dsrc.detections import Detections
from dsrc.models.encoder import PillarEncoder, Pillars
from dsrc.models.fusion import FUSIONS
from dsrc.models.fusion.late import join_detections
from dsrc.models.res2net import Res2Net
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import anchor_grid
from dsrc.ops.postprocess import PostSettings, decode_detections

# Legend: N agents of all samples, B samples, H W input grid, h w = H/2 W/2 output grid.


@dataclass(frozen=True, slots=True, eq=False)
class Output:
    """What a detector computes; the middle layers are there for the distillation.

    Attributes:
        stages: per scale (N, C, H / 2^k, W / 2^k) features of each agent before fusion.
        fused: (B, C, h, w) feature after fusion, decoder and shrink convolutions.
        cls: (B, 2, h, w) logits, one per anchor.
        reg: (B, 14, h, w) box residuals, 7 per anchor.
    """

    stages: tuple[Tensor, Tensor, Tensor]
    fused: Tensor
    cls: Tensor
    reg: Tensor


class Detector(nn.Module):
    """Pillar encoder, Res2Net, fusion per scale, decoder and heads.

    Source: DSRC, arXiv 2412.10739, Figure 2; the layers as in the released code.
    """

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.settings = settings
        channels, decoder, shrink = settings.stage_channels, settings.decoder_channels, settings.shrink_channels
        self.encoder = PillarEncoder(settings)
        self.backbone = Res2Net(settings.pillar_channels, channels, settings.stage_blocks, settings.base_width)
        self.fuse = FUSIONS[settings.fusion]
        self.decoder = nn.ModuleList(_upsample(channels[k], decoder, 2**k, settings.norm_momentum) for k in range(3))
        self.shrink = nn.Sequential(
            nn.Conv2d(3 * decoder, shrink, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(shrink, shrink, 3, padding=1),
            nn.ReLU(inplace=True),
        )
        self.cls_head = nn.Conv2d(shrink, 2, 1)
        self.reg_head = nn.Conv2d(shrink, 14, 1)
        if settings.score_prior is not None:
            # With a start of 0.5 everywhere, the loss of the empty cells drowns the objects for many epochs.
            nn.init.constant_(self.cls_head.bias, -log((1 - settings.score_prior) / settings.score_prior))  # type: ignore[arg-type]
        # Measured on CPUs: channels last makes the backbone 30 % faster and the decoder 40 % slower.
        self.backbone.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pillars: Pillars, agents: tuple[int, ...], lost: Tensor | None = None) -> Output:
        """Detect in B samples.

        Args:
            pillars: clouds of all samples' agents, those of a sample consecutive and ego first.
            agents: number of agents of each sample.
            lost: (N, H / 8, W / 8) bool tiles of the agents' features that did not arrive: zeros take their place.
        """
        stages = self.backbone(self.encoder(pillars))
        sent = stages if lost is None else [stage.masked_fill(_as_large(lost, stage), 0.0) for stage in stages]
        scales = [up(self.fuse(stage, agents).contiguous()) for up, stage in zip(self.decoder, sent, strict=True)]
        fused = self.shrink(torch.cat(scales, dim=1))
        return Output(stages, fused, self.cls_head(fused), self.reg_head(fused))

    @cached_property
    def anchors(self) -> NDArray[np.float64]:
        """(h, w, 2, 7) anchors x, y, z, l, w, h, yaw."""
        return anchor_grid(self.settings.grid)

    def decode(self, output: Output) -> list[Detections]:
        """Turn the heads' maps into detections wholly inside the grid's range, one row of the batch each."""
        settings = self.settings
        post = PostSettings(settings.score_threshold, settings.nms_iou, range_m=settings.grid.range_m)
        cls, reg = output.cls.detach().float().cpu().numpy(), output.reg.detach().float().cpu().numpy()
        return [decode_detections(c, r, self.anchors, post) for c, r in zip(cls, reg, strict=True)]

    @torch.inference_mode()
    def detect(self, sample: Sample) -> Detections:
        """Detect vehicles in one sample, best first, in the ego LiDAR's frame; needs no labels and no teacher."""
        was_training = self.training
        self.eval()
        batch = collate([sample], self.settings, training=False)
        if batch.student is None:
            raise ValueError("a teacher reads clouds that are made with ground truth: it cannot detect in a sample")
        device = self.cls_head.weight.device
        lost = None if batch.lost is None else batch.lost.to(device)
        parts = self.decode(self(batch.student.to(device), batch.agents, lost))
        self.train(was_training)
        return join_detections(parts, self.settings.nms_iou) if self.settings.fusion == "late" else parts[0]


def _as_large(lost: Tensor, stage: Tensor) -> Tensor:
    """Return the (N, h, w) tiles as an (N, 1, H, W) mask of a stage's cells."""
    factor = stage.shape[-1] // lost.shape[-1]
    return lost.repeat_interleave(factor, 1).repeat_interleave(factor, 2)[:, None]


def _upsample(inputs: int, outputs: int, stride: int, momentum: float) -> nn.Sequential:
    """Bring a scale back to half the grid's resolution."""
    return nn.Sequential(
        nn.ConvTranspose2d(inputs, outputs, stride, stride=stride, bias=False),
        nn.BatchNorm2d(outputs, eps=1e-3, momentum=momentum),
        nn.ReLU(inplace=True),
    )
