"""Detector: pillars of all agents to boxes in the ego LiDAR's frame. Student and teacher are the same class."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from math import log

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dsrc.data.sample import Sample, make_sample
from dsrc.models.compression import as_large, reduced
from dsrc.models.fusion import FUSIONS, AgentLayout
from dsrc.models.fusion.late import join_detections
from dsrc.models.inputs.batch import collate, pillars_of
from dsrc.models.inputs.trained_frame import as_sensed, as_trained, mirrored, prepared
from dsrc.models.layers.backbones import BACKBONES
from dsrc.models.layers.blocks import Compressor, Decoder, double_conv, upsample
from dsrc.models.layers.conv_norm import count_batch
from dsrc.models.layers.encoder import PillarEncoder, Pillars
from dsrc.models.pose_graph import aligned
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS, anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER, headed, in_half_turn
from dsrc.ops.detections import Detections
from dsrc.ops.postprocess import PostSettings, decode_detections
from sensors.frame import Frame
from sim.boxes import VEHICLES, VULNERABLE

# Legend: N agents of all samples, B samples, H W input grid, h w = H/s W/s output grid, s = settings.head_stride.


@dataclass(frozen=True, slots=True, eq=False)
class NetworkOutput:
    """Output of a detector, middle layers for the distillation included.

    Attributes:
        stages: per scale (N, C, H / 2^k, W / 2^k) features of each agent before fusion.
        fused: (B, C, h, w) feature after fusion, decoder and shrink convolutions.
        cls: (B, 2, h, w) logits, one per anchor.
        reg: (B, 14, h, w) box residuals, 7 per anchor, sizes in the order `box_order`.
        direction: (B, 2, h, w) logits of a box that heads against its anchor, or in the second half turn from
            `direction_start`; None without that head.
    """

    stages: tuple[Tensor, Tensor, Tensor]
    fused: Tensor
    cls: Tensor
    reg: Tensor
    direction: Tensor | None = None

    def float(self) -> "NetworkOutput":
        """Convert what the heads say to single precision; the features are converted where they are compared."""
        direction = None if self.direction is None else self.direction.float()
        return NetworkOutput(self.stages, self.fused, self.cls.float(), self.reg.float(), direction)


class Detector(nn.Module):
    """Detector of a fusion method: pillar encoder, backbone, fusion, decoder and heads.

    Source: DSRC, arXiv 2412.10739, Figure 2; the layers as in the released code. With a method that fuses one map
    (`Fusion.place`) every agent decodes and shrinks its own to a quarter of the grid's resolution, and the fused map is
    upsampled to half of it, so that anchors, losses and thresholds are the same for all methods. OpenCOOD leaves these
    methods at a quarter, with a quarter of the anchors, and so does `shrink_stride` 2.
    """

    precision = torch.float32
    """Precision of matrix products and maps, set by `dsrc.models.storage.deploy`."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.settings = settings
        widths, shrink, momentum = settings.decoder_widths, settings.shrink_channels, settings.norm_momentum
        self.encoder = PillarEncoder(settings)
        self.backbone = BACKBONES[settings.backbone_name](settings)
        self.fusion = FUSIONS[settings.fusion].from_settings(settings)
        self.by_stage = self.fusion.place == "stages"
        self.decoder = Decoder(upsample(settings.stage_channels[k], widths[k], 2**k, momentum) for k in range(3))
        stride, norm = settings.shrink_stride or (1 if self.by_stage else 2), momentum if settings.shrink_norm else None
        self.shrink = (
            double_conv(sum(widths), shrink, settings.shrink_kernel, stride, norm) if shrink else nn.Sequential()
        )
        if not self.by_stage:
            self.widen = nn.Identity() if settings.shrink_stride else upsample(shrink, shrink, 2, momentum)
        if settings.compress > 1:
            sent = settings.stage_channels[: self.fusion.scales_sent] if self.by_stage else (shrink,)
            self.compressors = nn.ModuleList(Compressor(width, settings.compress) for width in sent)
        self.cls_head = nn.Conv2d(settings.map_channels, 2, 1)
        self.reg_head = nn.Conv2d(settings.map_channels, 14, 1)
        self.direction_head = nn.Conv2d(settings.map_channels, 2, 1) if settings.direction else None
        if settings.score_prior is not None:
            # From 0.5 everywhere, the loss of the empty cells outweighs the objects for many epochs.
            nn.init.constant_(self.cls_head.bias, -log((1 - settings.score_prior) / settings.score_prior))  # type: ignore[arg-type]
        # Measured on CPUs: 30 % faster.
        self.backbone.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pillars: Pillars, layout: AgentLayout) -> NetworkOutput:
        """Detect in B samples.

        Args:
            pillars: clouds of all samples' agents, those of a sample consecutive and ego first.
            layout: agents of the clouds; lost tiles of their maps are zeros.
        """
        if self.training:
            count_batch(self)
        if self.precision == torch.float32:
            return self._forward(pillars, layout)
        with torch.autocast(pillars.points.device.type, self.precision):
            return self._forward(pillars, layout).float()

    def _forward(self, pillars: Pillars, layout: AgentLayout) -> NetworkOutput:
        stages = self.backbone(self.encoder(pillars))
        return self.heads(stages, self.fuse(self.maps(stages), layout))

    def maps(self, stages: Sequence[Tensor]) -> list[Tensor]:
        """Return the agents' maps before transmission: three scales or one map, N rows each."""
        maps = list(stages) if self.by_stage else [self.shrink(self.decoder(stages))]
        if self.settings.compress > 1:
            for scale, ends in enumerate(self.compressors):
                maps[scale] = ends(maps[scale])
        return maps

    def fuse(self, maps: Sequence[Tensor], layout: AgentLayout) -> list[Tensor]:
        """Transmit and fuse the agents' maps: three scales or one map, B rows each."""
        sent = self.fusion.send(maps, layout, self)
        if not self.training and (self.settings.share < 1 or self.settings.bits < 32):
            sent = self._reduced_collaborators(sent, maps, layout)
        if layout.lost is not None:
            sent = [part.masked_fill(as_large(layout.lost, part), 0.0) for part in sent]
        return self.fusion(sent, layout, self)

    def _reduced_collaborators(
        self, sent: Sequence[Tensor], maps: Sequence[Tensor], layout: AgentLayout
    ) -> list[Tensor]:
        """Reduce the collaborators' maps to `share` and `bits`; an ego keeps all of its own."""
        egos = set(accumulate((0, *layout.agents)))
        others = [row for row in range(sum(layout.agents)) if row not in egos]
        if not others:
            return list(sent)
        confidence = None
        if self.settings.share < 1:
            own = [part[others] for part in maps]
            logits = self.logits(own) if self.by_stage else self.cls_head(self.widen(own[0]))
            confidence = logits.sigmoid().amax(1)
        few = reduced([part[others] for part in sent], confidence, self.settings)
        rows = torch.tensor(others, device=sent[0].device)
        return [part.index_copy(0, rows, small.to(part.dtype)) for part, small in zip(sent, few, strict=True)]

    def heads(self, stages: tuple[Tensor, Tensor, Tensor], maps: Sequence[Tensor]) -> NetworkOutput:
        """Return the output for fused maps."""
        fused = self.shrink(self.decoder(maps)) if self.by_stage else self.widen(maps[0])
        direction = None if self.direction_head is None else self.direction_head(fused)
        return NetworkOutput(stages, fused, self.cls_head(fused), self.reg_head(fused), direction)

    def logits(self, stages: Sequence[Tensor]) -> Tensor:
        """Return the (N, 2, h, w) classification logits of each agent alone, before fusion."""
        return self.cls_head(self.shrink(self.decoder(stages)))

    @cached_property
    def anchors(self) -> NDArray[np.float64]:
        """(h, w, 2, 7) anchors x, y, z, l, w, h, yaw."""
        return anchors_of(self.settings)

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of what is detected."""
        return classes_of(self.settings)

    def decode(self, output: NetworkOutput) -> list[Detections]:
        """Decode the heads' maps, see `decode_maps`."""
        cls, reg = output.cls.detach().float().cpu().numpy(), output.reg.detach().float().cpu().numpy()
        direction = None if output.direction is None else output.direction.detach().float().cpu().numpy()
        return decode_maps(cls, reg, direction, self.settings, self.anchors)

    @torch.inference_mode()
    def detect(self, sample: Sample) -> Detections:
        """Detect road users in one sample, best first, in the ego LiDAR's frame.

        Raises:
            ValueError: the detector is a teacher, which reads clouds made with ground truth.
        """
        sample, parts = self._parts(sample)
        found = join_detections(parts, self.settings.nms_iou) if self.settings.fusion == "late" else parts[0]
        return as_sensed(found, sample, self.settings)

    @torch.inference_mode()
    def detect_each(self, sample: Sample) -> list[Detections]:
        """Detect in the cloud of each agent alone, as `detect` does with late fusion before it joins them.

        Raises:
            ValueError: the detector fuses otherwise, or is a teacher.
        """
        if self.settings.fusion != "late":
            raise ValueError(f"expected a detector with late fusion, found one with {self.settings.fusion}")
        sample, parts = self._parts(sample)
        return [as_sensed(part, sample, self.settings) for part in parts]

    def joined(self, parts: list[Detections]) -> Detections:
        """Return the detections of several agents as one, best first."""
        return join_detections(parts, self.settings.nms_iou)

    def _parts(self, sample: Sample) -> tuple[Sample, list[Detections]]:
        """Return the sample as the network takes it and what it finds: with late fusion in each agent's cloud."""
        was_training = self.training
        if was_training:  # setting the mode of a hundred layers takes as long as coding the clouds
            self.eval()
        sample = prepared(sample, self.settings)
        if self.settings.align_poses:
            sample = aligned(sample, self._single_agent_detections(sample), self.settings.grid)
        batch = collate([sample], self.settings, training=False)
        if batch.student is None:
            raise ValueError("a teacher reads clouds that are made with ground truth: it cannot detect in a sample")
        device = self.cls_head.weight.device
        parts = self.decode(self(batch.student.to(device), batch.layout.to(device)))
        if was_training:
            self.train()
        return sample, parts

    def _single_agent_detections(self, sample: Sample) -> list[Detections]:
        count = 1 if self.settings.fusion == "none" else self.settings.max_agents
        clouds = as_trained(sample, self.settings).clouds[:count]
        pillars = pillars_of(clouds, self.settings).to(self.cls_head.weight.device)
        return self.decode(self(pillars, AgentLayout((1,) * len(clouds))))


def anchors_of(settings: ModelSettings) -> NDArray[np.float64]:
    """Return (h, w, 2, 7) anchors x, y, z, l, w, h, yaw of a detector."""
    return anchor_grid(settings.grid, settings.head_stride, settings.users, settings.anchor_lwh)


def classes_of(settings: ModelSettings) -> tuple[str, ...]:
    """Return the classes of what a detector detects."""
    return VEHICLES if settings.users == "vehicles" else VULNERABLE


def decode_maps(
    cls: NDArray[np.float32],
    reg: NDArray[np.float32],
    direction: NDArray[np.float32] | None,
    settings: ModelSettings,
    anchors: NDArray[np.float64],
) -> list[Detections]:
    """Decode the heads' maps into detections in the range that counts, one `Detections` per row of the batch.

    Boxes are right-handed, whatever frame the network was trained in. Heights are the network's: those above the ground
    count at any height until they are put back, see `as_sensed`.

    Args:
        cls: as in `NetworkOutput`, like those that follow.
        anchors: see `anchors_of`.
    """
    range_m = settings.request.judged_m
    if settings.height == "ground":
        range_m = (*range_m[:2], -np.inf, *range_m[3:5], np.inf)
    post = PostSettings(
        settings.score_threshold,
        settings.nms_iou,
        range_m=range_m,
        max_extent_m=settings.max_extent_m,
    )
    if settings.box_order == "hwl":
        reg = reg.reshape(len(reg), 2, 7, *reg.shape[2:])[:, :, REFERENCE_ORDER].reshape(reg.shape)
    if direction is not None:
        second, start = direction > 0, settings.direction_start
        reg = headed(reg, second) if start is None else in_half_turn(reg, second, anchors, start)
    label = ANCHORS[settings.users].label
    found = [decode_detections(c, r, anchors, post, label) for c, r in zip(cls, reg, strict=True)]
    return [Detections(mirrored(f.boxes), f.score) for f in found] if settings.left_handed else found


def detect(detector: Detector, frame: Frame, ego_id: int | None = None, *, cooperative: bool = True) -> Detections:
    """Detections in a frame, best first, in the ego LiDAR's frame.

    Args:
        detector: its settings give range and number of agents.
        ego_id: the ego; None for the first vehicle.
        cooperative: with the clouds of the agents in communication range; else the ego's alone.

    Raises:
        DataError: the frame has no agent of this id.
    """
    return detector.detect(make_sample(frame, ego_id, detector.settings.request, cooperative=cooperative))
