"""Settings of a detector: shape and meaning of its weights."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal, Protocol

import msgspec
from msgspec import Meta

from dsrc.data.level import taller
from dsrc.data.sample import COMM_RANGE_M, OPENCOOD_RANGE_M, DetectorSettings, JudgedBy, SampleRequest, TeamBy
from dsrc.ops.anchors import Users
from dsrc.ops.grid import GridSpec
from sim.errors import did_you_mean

Backbone = Literal["res2net", "resnet", "plain"]
Count = Annotated[int, Meta(ge=1)]
Share = Annotated[float, Meta(ge=0, le=1)]
Size = Annotated[float, Meta(gt=0)]


def fusion_of(settings: DetectorSettings) -> str:
    """Return a detector's fusion; one without `ModelSettings` reads the agents' clouds, as early fusion does."""
    return settings.fusion if isinstance(settings, ModelSettings) else "early"


class FusionKind(Protocol):
    """What settings know of a class of `dsrc.models.fusion`: whether it fuses stages of the backbone or one map."""

    place: ClassVar[Literal["stages", "map"]]


class ModelSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a detector, saved in every checkpoint.

    The defaults are the paper's (Implementation Details): 0.4 m pillars and Res2Net blocks 3, 5, 8.

    Attributes:
        grid: bird's-eye grid in the ego LiDAR's frame.
        users: road users that are detected, see `dsrc.ops.anchors.ANCHORS`.
        role: input clouds: a teacher's are built with ground truth, a student's are the sensors'.
        fusion: key of `dsrc.models.fusion.FUSIONS`.
        backbone: key of `BACKBONES`; None is the method's own: CoAlign's residual blocks, Res2Net for all others.
        released: mistakes of the method's published code are reproduced, see its class.
        height: what heights are above: `sensor`, the ego's LiDAR, as samples are; `ground`, the surface of the ground
            below each cloud, which is taken off the clouds and put back on the boxes, see `dsrc.data.level`.
        left_handed: the network was trained in the mirror image, y to the right, as CARLA's LiDARs have it; samples and
            detections are right-handed all the same. Grids are then even about y = 0.
        intensity_steps: steps between 0 and 1 that intensities are rounded to; 255 for the released networks, whose
            data hold 8 bits; None keeps them.
        own_frame: each agent's cloud is encoded in its own frame, as by an agent that broadcasts its features; the
            receiver warps the maps. Else clouds are brought to the ego's frame first.
        drop_lone_points: each agent drops points with few neighbours before detection, as flakes are; inference only,
            see `dsrc.models.inputs.lone_points`.
        align_poses: poses of the collaborators are corrected by an agent-object pose graph before detection, which
            takes another run of the network on each agent's cloud alone.
        compress: ratio by which the channels of a sent map are reduced, see `Compressor`.
        share: share of its tiles that an agent sends, the most confident ones; inference only and without training,
            see `dsrc.models.compression`.
        bits: bits per sent number, inference only.
        sdd: sparse-to-dense distillation: the teacher's objects hold the points of all agents.
        pcp: point cloud painting: the teacher's points carry a fifth channel, 1 inside a labelled box.
        rec: point cloud reconstruction supervises the fused feature (training only).
        box_order: order of the sizes in regression maps: `lwh`, or `hwl` as in the released models.
        max_points: points kept per pillar, first come.
        max_pillars: pillars kept per cloud, first come.
        padded_slots: zero rows that pad a pillar to `max_points` take part in batch norm and maximum, as in the
            released code. Else statistics and maximum are of real points only.
        pillar_channels: width of the pillar encoder.
        stage_channels: widths of the three backbone stages, each at half the resolution of the one before.
        stage_blocks: residual blocks of the stages.
        base_width: width of a Res2Net split at 64 channels; the split is `channels * base_width // 64`.
        decoder_channels: width of each scale after upsampling to half the grid's resolution, one for all or three.
        shrink_channels: width of the two convolutions before the heads; 0 for none, so that the heads read the decoder.
        shrink_kernel: kernel size of the first of them; the second is 3 x 3.
        shrink_stride: stride of the first of them, at whose resolution the heads stay, as OpenCOOD's do; None is 1
            where stages are fused and, where one map is, 2 and a layer that upsamples it again for the heads.
        attention_channels: width of V2X-ViT's attentions, heads times channels of a head: one for all, or those over
            agents and in windows of 4, 8 and 16 cells; None is that of the map.
        shrink_norm: batch norms in these two convolutions. The published networks have none; ours then lost nearly half
            of the channels, which were negative in every cell.
        norm_momentum: momentum of the batch norms of the encoder, the decoder and the shrink convolutions.
        anchor_lwh: size of the anchors, m; None is that of `users`.
        direction: a third head classifies the box's direction along its anchor; without it, front and back are guessed.
        direction_start: heading at which the first of the two half turns begins that this head tells apart, rad, as in
            PointPillars and CoAlign; None is the direction along the anchor.
        score_prior: confidence of an untrained head, None for PyTorch's initialisation.
        reconstruction_channels: widths of the reconstruction head, per vertical bin and after reduction.
        reconstruction_cell_z_m: height of a reconstruction voxel; the released code's is the whole range.
        comm_range_m: communication range of the ego, between LiDARs in the plane, m: agents beyond it take no part.
        max_agents: number of agents that are fused, the ego included.
        team_by: order of the rules of range and number by which agents take part; `folders` is OpenCOOD's.
        judged_by: boxes that count in an evaluation, see `dsrc.data.sample.JudgedBy`; with `opencood` detections and
            ground truth are OpenCOOD's, and so is `ap_opencood`.
        score_threshold: confidence below which detections are dropped.
        nms_iou: overlap above which the less confident of two detections is dropped.
        max_extent_m: extent along x or y above which detections are dropped, buses among them; 6 m in the released
            code, None keeps all.
    """

    fusions: ClassVar[Mapping[str, type[FusionKind]]] = MappingProxyType({})
    """Classes by name, handed in by `dsrc.models.fusion`, whose methods read these settings."""

    grid: GridSpec = GridSpec()
    users: Users = "vehicles"
    role: Literal["student", "teacher"] = "student"
    fusion: str = "attention"
    backbone: Backbone | None = None
    released: bool = False
    height: Literal["sensor", "ground"] = "sensor"
    left_handed: bool = False
    intensity_steps: Count | None = None
    own_frame: bool = False
    drop_lone_points: bool = False
    align_poses: bool = False
    compress: Count = 1
    share: Share = 1.0
    bits: Literal[32, 16, 8] = 32
    sdd: bool = True
    pcp: bool = True
    rec: bool = True
    box_order: Literal["lwh", "hwl"] = "lwh"
    max_points: Count = 32
    max_pillars: Count = 70_000
    padded_slots: bool = False
    pillar_channels: Count = 64
    stage_channels: tuple[Count, Count, Count] = (64, 128, 256)
    stage_blocks: tuple[Count, Count, Count] = (3, 5, 8)
    base_width: Count = 26
    decoder_channels: int | tuple[int, ...] = 128
    shrink_channels: Annotated[int, Meta(ge=0)] = 256
    shrink_kernel: Literal[1, 3] = 3
    shrink_stride: Literal[1, 2] | None = None
    attention_channels: int | tuple[int, ...] | None = None
    shrink_norm: bool = False
    norm_momentum: Share = 0.01
    anchor_lwh: tuple[Size, Size, Size] | None = None
    direction: bool = False
    direction_start: float | None = None
    score_prior: Annotated[float, Meta(gt=0, lt=1)] | None = 0.01
    reconstruction_channels: tuple[Count, Count] = (128, 32)
    reconstruction_cell_z_m: Annotated[float, Meta(gt=0)] = 0.4
    comm_range_m: Annotated[float, Meta(ge=0)] = COMM_RANGE_M
    max_agents: Count = 5
    team_by: TeamBy = "range"
    judged_by: JudgedBy = "grid"
    score_threshold: Share = 0.2
    nms_iou: Share = 0.15
    max_extent_m: Annotated[float, Meta(gt=0)] | None = None

    def __post_init__(self) -> None:
        if self.fusion not in self.fusions:
            raise ValueError(f"fusion: unknown '{self.fusion}'{did_you_mean(str(self.fusion), self.fusions)}")
        if self.grid.width % 8 or self.grid.height % 8:
            raise ValueError(f"grid: expected multiples of 8 cells, found {self.grid.width} x {self.grid.height}")
        if self.left_handed and self.grid.range_m[1] != -self.grid.range_m[4]:
            found = f"{self.grid.range_m[1]:g} to {self.grid.range_m[4]:g} m"
            raise ValueError(f"left_handed: expected a grid that is even about y = 0, found {found}")
        if self.users != "vehicles" and (self.direction or self.anchor_lwh is not None):
            # Its anchors are squares of two sizes: none has a heading, and one size would leave one class.
            found = f"direction {self.direction}, anchor_lwh {self.anchor_lwh}"
            raise ValueError(f"users: expected vehicles with a direction head or anchors of a size, found {found}")
        if min(self.stage_channels) * self.base_width < 64:
            raise ValueError(
                f"base_width: expected at least {64 / min(self.stage_channels):g}, found {self.base_width}"
            )
        if self.own_frame and (self.distils or self.rec or self.fusion in ("early", "late")):
            # Their targets, clouds and boxes are all in the ego's frame.
            found = f"fusion {self.fusion}, sdd {self.sdd}, pcp {self.pcp}, rec {self.rec}"
            raise ValueError(f"own_frame: expected a fusion of maps without teacher and reconstruction, found {found}")
        if self.own_frame and self.height == "ground":
            # Poses between levelled frames are not those between the sensors'.
            raise ValueError("height: expected sensor with own_frame, found ground")
        if (self.share < 1 or self.bits < 32) and self.fusion in ("none", "early", "late"):
            raise ValueError(f"share, bits: expected a fusion of maps, found {self.fusion}")
        if self.share < 1 and self.fusion == "mrcnet":
            # Its decoder takes two maps at a time: no agent can tell by itself where it sees something.
            raise ValueError(f"share: expected 1 with fusion mrcnet, found {self.share}")
        if self.bits < 32 and self.compress > 1:
            raise ValueError(f"bits: expected 32 with compressed maps, found {self.bits}")
        if self.compress > min(*self.stage_channels, self.map_channels):
            raise ValueError(f"compress: expected no more than a map has channels, found {self.compress}")
        for name, number in (("decoder_channels", 3), ("attention_channels", 4)):
            # Not in the types: msgspec 0.22 reads beyond its memory in a union of bounded integers and fixed tuples.
            widths = getattr(self, name)
            listed = widths if isinstance(widths, tuple) else (1 if widths is None else widths,) * number
            if len(listed) != number or min(listed) < 1:
                raise ValueError(f"{name}: expected a width or {number}, at least 1 each, found {widths}")
        if self.attention_channels is not None and self.fusion != "v2xvit":
            raise ValueError(f"attention_channels: expected none with fusion {self.fusion}, found those of v2xvit")
        if self.attention_channels is not None and any(width % 16 for width in self.attention_widths):
            raise ValueError(f"attention_channels: expected multiples of 16 heads, found {self.attention_channels}")
        if self.head_stride > 2 and (self.distils or self.rec):
            # Teachers and reconstructions are at half the grid's resolution.
            found = f"{self.shrink_stride} with sdd {self.sdd}, pcp {self.pcp}, rec {self.rec}"
            raise ValueError(f"shrink_stride: expected no teacher and no reconstruction, found {found}")
        of_map = self.fusions[self.fusion].place == "map"
        if not self.shrink_channels and (self.shrink_stride == 2 or of_map or self.rec):
            raise ValueError(f"shrink_channels: expected more than 0 with fusion {self.fusion}, found 0")
        one_width = self.fusion in ("cobevt", "ermvp") or (self.fusion == "v2xvit" and self.attention_channels is None)
        if self.shrink_channels % 16 and one_width:
            raise ValueError(f"shrink_channels: expected a multiple of 16 heads, found {self.shrink_channels}")
        if self.rec and self.reconstruction_bins % 2:
            raise ValueError(f"grid: expected an even number of 0.4 m layers, found {self.reconstruction_bins}")
        if self.rec and self.reconstruction_cell_z_m < 0.4:
            raise ValueError(f"reconstruction_cell_z_m: expected at least 0.4, found {self.reconstruction_cell_z_m:g}")

    @property
    def request(self) -> SampleRequest:
        """Rules by which samples are made for the detector, and in whose range its detections count."""
        opencood = self.judged_by == "opencood"
        range_m = OPENCOOD_RANGE_M if opencood else None
        grid = taller(self.grid) if self.height == "ground" else self.grid
        return SampleRequest(grid, self.comm_range_m, self.max_agents, self.users, self.team_by, opencood, range_m)

    @property
    def backbone_name(self) -> Backbone:
        """Key of `BACKBONES`."""
        return self.backbone or ("resnet" if self.fusion == "coalign" else "res2net")

    @property
    def decoder_widths(self) -> tuple[int, int, int]:
        """Widths of the three scales after upsampling."""
        one = self.decoder_channels
        first, second, third = (one, one, one) if isinstance(one, int) else one
        return first, second, third

    @property
    def map_channels(self) -> int:
        """Channels of the map that the heads read."""
        return self.shrink_channels or sum(self.decoder_widths)

    @property
    def map_stride(self) -> int:
        """Cells of the grid along a cell of the map that is fused, in methods that fuse one."""
        return 2 * (self.shrink_stride or 2)

    @property
    def head_stride(self) -> int:
        """Cells of the grid along a cell of the heads' maps."""
        return 2 * (self.shrink_stride or 1)

    @property
    def attention_widths(self) -> tuple[int, ...]:
        """Four widths of V2X-ViT's attentions: over agents and in windows of 4, 8 and 16 cells."""
        one = self.shrink_channels if self.attention_channels is None else self.attention_channels
        return (one,) * 4 if isinstance(one, int) else one

    @property
    def point_features(self) -> int:
        """Channels of a point: x, y, z, intensity and, for a painted teacher, the paint."""
        return 5 if self.role == "teacher" and self.pcp else 4

    @property
    def distils(self) -> bool:
        """Distillation is on: a student of these settings needs a teacher."""
        return self.sdd or self.pcp

    @property
    def reconstruction_bins(self) -> int:
        """Vertical bins of the reconstruction: ten of 0.4 m over [-3, 1] m."""
        return round((self.grid.range_m[5] - self.grid.range_m[2]) / 0.4)
