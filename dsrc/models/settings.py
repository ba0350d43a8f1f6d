"""ModelSettings: everything that fixes the shape and the meaning of a detector's weights."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from dsrc.ops.grid import GridSpec

Fusion = Literal[
    "attention",
    "max",
    "max_map",
    "none",
    "late",
    "early",
    "v2vnet",
    "v2xvit",
    "cobevt",
    "where2comm",
    "coalign",
    "ermvp",
    "mrcnet",
]
Backbone = Literal["res2net", "resnet", "plain"]
Count = Annotated[int, Meta(ge=1)]
Share = Annotated[float, Meta(ge=0, le=1)]


class ModelSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes and switches of a detector; saved in every checkpoint.

    The defaults are the paper's (Implementation Details): 0.4 m pillars and Res2Net blocks 3, 5, 8.

    Attributes:
        grid: bird's-eye grid in the ego LiDAR's frame.
        role: a teacher reads clouds that were built with ground truth, a student what the sensors saw.
        fusion: how the agents' features are joined, a key of `FUSIONS`.
        backbone: a key of `BACKBONES`; None is the method's own: CoAlign's residual blocks, Res2Net for all others.
        released: let the method do as its published code does where that is a mistake, as its class says.
        own_frame: encode each agent's cloud in its own frame, as one does that sends features without knowing who hears
            them; the receiver warps the maps. Else clouds are brought to the ego's frame first.
        align_poses: put the collaborators' poses right by a graph of agents and objects before a sample is
            detected in; it takes another run of the network on each agent's cloud by itself.
        compress: times fewer channels that are sent of each map.
        share: of the tiles of its maps that an agent sends, those in which it is surest to see something; in use only,
            training has everything. Needs no training of its own: see `dsrc.models.compression`.
        bits: of each number that is sent, in use only.
        sdd: sparse-to-dense distillation: the teacher's objects hold the points of all agents.
        pcp: point cloud painting: the teacher's points carry a fifth channel, 1 inside a labelled box.
        rec: point cloud reconstruction supervises the fused feature (training only).
        box_order: in which the regression maps have the sizes: `lwh`, or `hwl` as the released models have.
        max_points: points kept per pillar, first come.
        max_pillars: pillars kept per cloud, first come.
        padded_slots: whether the zero rows that pad a pillar to `max_points` take part in batch norm and in the
            maximum, as in the released code. Without them, statistics and maximum are of real points only.
        pillar_channels: width of the pillar encoder.
        stage_channels: widths of the three backbone stages, each at half the resolution of the one before.
        stage_blocks: residual blocks of the stages.
        base_width: width of a Res2Net split at 64 channels; the split is `channels * base_width // 64`.
        decoder_channels: width of each scale after it was brought back to half the grid's resolution.
        shrink_channels: width of the two 3 x 3 convolutions before the heads.
        shrink_norm: batch norms in these two convolutions. The published networks have none; ours then lost nearly half
            of the channels, which were negative in every cell.
        norm_momentum: of the batch norms of the encoder, the decoder and the shrink convolutions.
        direction: a third head says which way along its anchor a box heads; without it, front and back are guessed.
        score_prior: confidence that an untrained head gives, None for the framework's own start.
        reconstruction_channels: widths of the reconstruction head, per vertical bin and after reduction.
        reconstruction_cell_z_m: height of a reconstruction voxel; the released code's is the whole range.
        max_agents: agents that one ego listens to, itself included.
        score_threshold: detections below this confidence are dropped.
        nms_iou: of two detections that overlap more than this, the less confident is dropped.
        max_extent_m: detections longer than this along x or y are dropped, buses among them, as in the released code,
            which has 6 m; None keeps all.
    """

    grid: GridSpec = GridSpec()
    role: Literal["student", "teacher"] = "student"
    fusion: Fusion = "attention"
    backbone: Backbone | None = None
    released: bool = False
    own_frame: bool = False
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
    decoder_channels: Count = 128
    shrink_channels: Count = 256
    shrink_norm: bool = False
    norm_momentum: Share = 0.01
    direction: bool = False
    score_prior: Annotated[float, Meta(gt=0, lt=1)] | None = 0.01
    reconstruction_channels: tuple[Count, Count] = (128, 32)
    reconstruction_cell_z_m: Annotated[float, Meta(gt=0)] = 0.4
    max_agents: Count = 5
    score_threshold: Share = 0.2
    nms_iou: Share = 0.15
    max_extent_m: Annotated[float, Meta(gt=0)] | None = None

    def __post_init__(self) -> None:
        if self.grid.width % 8 or self.grid.height % 8:
            raise ValueError(f"grid: expected multiples of 8 cells, found {self.grid.width} x {self.grid.height}")
        if min(self.stage_channels) * self.base_width < 64:
            raise ValueError(
                f"base_width: expected at least {64 / min(self.stage_channels):g}, found {self.base_width}"
            )
        if self.own_frame and (self.distils or self.rec or self.fusion in ("early", "late")):
            # Their targets, clouds and boxes are all in the ego's frame.
            found = f"fusion {self.fusion}, sdd {self.sdd}, pcp {self.pcp}, rec {self.rec}"
            raise ValueError(f"own_frame: expected a fusion of maps without teacher and reconstruction, found {found}")
        if (self.share < 1 or self.bits < 32) and self.fusion in ("none", "early", "late"):
            raise ValueError(f"share, bits: expected a fusion of maps, found {self.fusion}")
        if self.share < 1 and self.fusion == "mrcnet":
            # Its decoder takes two maps at a time: no agent can tell by itself where it sees something.
            raise ValueError(f"share: expected 1 with fusion mrcnet, found {self.share}")
        if self.bits < 32 and self.compress > 1:
            raise ValueError(f"bits: expected 32 with compressed maps, found {self.bits}")
        if self.compress > min(*self.stage_channels, self.shrink_channels):
            raise ValueError(f"compress: expected no more than a map has channels, found {self.compress}")
        if self.shrink_channels % 16 and self.fusion in ("v2xvit", "cobevt", "ermvp"):
            raise ValueError(f"shrink_channels: expected a multiple of 16 heads, found {self.shrink_channels}")
        if self.rec and self.reconstruction_bins % 2:
            raise ValueError(f"grid: expected an even number of 0.4 m layers, found {self.reconstruction_bins}")

    @property
    def backbone_name(self) -> Backbone:
        """Key of `BACKBONES`."""
        return self.backbone or ("resnet" if self.fusion == "coalign" else "res2net")

    @property
    def point_features(self) -> int:
        """Channels of a point in a cloud: x, y, z, intensity and, for a painted teacher, the paint."""
        return 5 if self.role == "teacher" and self.pcp else 4

    @property
    def distils(self) -> bool:
        """Whether a student of these settings learns from a teacher."""
        return self.sdd or self.pcp

    @property
    def reconstruction_bins(self) -> int:
        """Vertical bins of the reconstruction: ten of 0.4 m over [-3, 1] m."""
        return round((self.grid.range_m[5] - self.grid.range_m[2]) / 0.4)
