"""Batch: tensors of several samples, input of a network and its losses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dsrc.data.sample import Sample
from dsrc.models.device import Movable
from dsrc.models.fusion.base import AgentLayout
from dsrc.models.inputs.labels import LabelSettings, cells_in_boxes
from dsrc.models.inputs.teacher import TeacherClouds, teacher_clouds
from dsrc.models.inputs.trained_frame import as_trained, mirrored
from dsrc.models.layers.encoder import Pillars
from dsrc.models.layers.reconstruction import SceneVoxels
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS, anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER
from dsrc.ops.grid import GridSpec
from dsrc.ops.pillars import sum_cells, voxelise
from dsrc.ops.targets import assign_targets
from sim.boxes import Boxes
from sim.geometry import invert, transform_points

# Legend: N agents of all samples, B samples, H W input grid, h w = H/2 W/2 output grid.

_LABELS = LabelSettings()


@dataclass(frozen=True, slots=True, eq=False)
class Targets(Movable):
    """Training targets of the detection heads.

    Attributes:
        positive: (B, h, w, 2) bool positive anchors.
        regression: (B, h, w, 14) float32 residuals of their boxes.
    """

    positive: Tensor
    regression: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Batch(Movable):
    """Batch of B samples with N agents in all.

    Attributes:
        keys: (B,) keys of the samples.
        agents: (B,) number of agents of each sample; their clouds are consecutive, ego first.
        lost: (N, h, w) bool lost tiles of the agents' feature maps; None when all arrived.
        roadside: (N,) bool, True for roadside units, whose ids are negative.
        pairwise: (B, L, L, 4, 4) `[b, i, j]` maps points of agent i's frame to agent j's, m; None when all clouds are
            in the ego's frame.
        grid: bird's-eye grid of all clouds.
        boxes: (B,) ground truth, right-handed as the samples; all else is as the network was trained.
        student: pillars of the sensors' clouds; None for a teacher's batch.
        targets: targets of the heads; None outside training, like all that follows.
        teacher: pillars of the teacher's clouds, None without distillation.
        foreground: (N, H, W) bool cells with a point on one of the agent's objects, None without teacher.
        scene: target of the reconstruction, None when it is off.
        objects: pillars of the agents' objects alone, for a teacher whose norms see them too; None for others.
        view: pillars of the corrupted clouds; None where the student has them, or no sample has any.
    """

    keys: tuple[str, ...]
    agents: tuple[int, ...]
    boxes: tuple[Boxes, ...]
    student: Pillars | None
    lost: Tensor | None = None
    roadside: Tensor | None = None
    pairwise: Tensor | None = None
    grid: GridSpec = field(default_factory=GridSpec)
    targets: Targets | None = None
    teacher: Pillars | None = None
    foreground: Tensor | None = None
    scene: SceneVoxels | None = None
    objects: Pillars | None = None
    view: Pillars | None = None

    @property
    def layout(self) -> AgentLayout:
        """Layout of the agents, for a fusion."""
        low, high = np.array(self.grid.range_m[:2]), np.array(self.grid.range_m[3:5])
        extent, centre = (high - low).tolist(), ((high + low) / 2).tolist()
        return AgentLayout(self.agents, self.lost, self.roadside, None, self.pairwise, tuple(extent), tuple(centre))


def collate(
    samples: Sequence[Sample],
    settings: ModelSettings,
    training: bool,
    labels: LabelSettings = _LABELS,
    objects: bool = False,
    both_views: bool = False,
) -> Batch:
    """Make a batch of samples.

    Args:
        samples: each with its clouds already cropped to the grid's range, right-handed.
        settings: settings of the network. A teacher's batch has no student pillars; a student's has the teacher's
            clouds too, in training, when its settings distil.
        training: make targets and everything else that needs ground truth.
        labels: rules by which targets are made of the ground truth.
        objects: in training, add the clouds of the teacher's objects, for its norms.
        both_views: make the student's pillars of the clean clouds and `view` of the corrupted ones; else a sample's
            corrupted clouds replace its clean ones.
    """
    if training and labels.max_pillars is not None:
        settings = msgspec.structs.replace(settings, max_pillars=min(labels.max_pillars, settings.max_pillars))
    samples = [as_trained(sample, settings) for sample in samples]
    whole = [(part, sample) for sample in samples for part in fusion_samples(sample, settings)]
    samples = [part for part, _ in whole]
    for_teacher = settings.role == "teacher"
    clean = [cloud for sample in samples for cloud in sample.clouds]
    corrupted = [cloud for sample in samples for cloud in sample.corrupted or sample.clouds]
    two = both_views and not for_teacher and any(sample.corrupted for sample in samples)
    batch = Batch(
        keys=tuple(sample.key for sample in samples),
        agents=tuple(len(sample.clouds) for sample in samples),
        boxes=tuple(mirrored(sample.boxes) if settings.left_handed else sample.boxes for sample in samples),
        student=None if for_teacher else _student_pillars(clean if both_views else corrupted, samples, settings),
        view=_student_pillars(corrupted, samples, settings) if two else None,
        lost=_lost(samples),
        pairwise=_pairwise(samples) if settings.own_frame else None,
        grid=settings.grid,
        roadside=torch.tensor([agent < 0 for sample in samples for agent in sample.agent_ids]),
    )
    if for_teacher or (training and settings.distils):
        views = [
            teacher_clouds(part, labels.inside, settings.sdd, settings.pcp, _clouds_of_others(part, sample, settings))
            for part, sample in whole
        ]
        batch = replace(batch, teacher=_painted_pillars([c for view in views for c in view.clouds], settings))
        if training and objects:
            clouds = [cloud for view in views for cloud in view.object_clouds]
            batch = replace(batch, objects=_painted_pillars(clouds, settings))
        if not for_teacher:
            by_points = labels.foreground == "points"
            boxes = [own for sample in samples for own in sample.agent_boxes]
            mask = _cells_with_points(views, settings.grid) if by_points else cells_in_boxes(boxes, settings.grid)
            batch = replace(batch, foreground=torch.from_numpy(mask))
    if not training:
        return batch
    scene = None
    if settings.rec and not for_teacher:
        # The scene of all agents, those too that the student does not fuse.
        merged = [np.concatenate([*part.clouds, *_clouds_of_others(part, sample, settings)]) for part, sample in whole]
        scene = scene_of(merged, settings)
    return replace(batch, targets=_targets(samples, settings, labels), scene=scene)


def fusion_samples(sample: Sample, settings: ModelSettings) -> list[Sample]:
    """Split or join a sample's agents as the fusion needs.

    Most fusions take up to `max_agents` agents in one sample, `none` the ego alone; `early` joins the agents' clouds
    into one, the ego's first; `late` makes each agent's cloud a sample of its own with the boxes that it annotated.
    """
    count = min(len(sample.clouds), settings.max_agents)
    if settings.fusion == "early":
        seen = sample.corrupted[: settings.max_agents]
        return [
            replace(
                with_agents(sample, (0,)),
                clouds=(np.concatenate(sample.clouds[: settings.max_agents]),),
                corrupted=(np.concatenate(seen),) if seen else (),
                agent_boxes=(sample.boxes,),
            )
        ]
    if settings.fusion == "late":
        return [replace(with_agents(sample, (row,)), boxes=sample.agent_boxes[row]) for row in range(count)]
    return [with_agents(sample, range(1 if settings.fusion == "none" else count))]


def _clouds_of_others(part: Sample, whole: Sample, settings: ModelSettings) -> list[NDArray[np.float32]]:
    """Return the clouds of a sample's agents that a part of it leaves out; a teacher has them still."""
    joined = whole.agent_ids[: settings.max_agents] if settings.fusion == "early" else part.agent_ids
    others = [cloud for agent, cloud in zip(whole.agent_ids, whole.clouds, strict=True) if agent not in joined]
    return [*others, *whole.other_clouds]


def with_agents(sample: Sample, rows: Sequence[int]) -> Sample:
    """Return a sample of some of its agents; the ground truth stays."""
    per_agent: dict[str, Any] = {
        name: tuple(part[row] for row in rows) if (part := getattr(sample, name)) else ()
        for name in ("agent_ids", "clouds", "agent_boxes", "lost", "corrupted", "grounds")
    }
    return replace(sample, **per_agent, ego_from_agent=sample.ego_from_agent[list(rows)])


def _student_pillars(
    clouds: Sequence[NDArray[np.float32]], samples: Sequence[Sample], settings: ModelSettings
) -> Pillars:
    """Return the pillars of all samples' clouds, each in the frame that its agent encodes it in."""
    if settings.own_frame:
        poses = [pose for sample in samples for pose in sample.ego_from_agent]
        clouds = [_moved(cloud, invert(pose), settings.grid) for cloud, pose in zip(clouds, poses, strict=True)]
    return pillars_of(clouds, settings)


def _moved(cloud: NDArray[np.float32], move: NDArray[np.float64], grid: GridSpec) -> NDArray[np.float32]:
    """Move a cloud to another frame and crop it to the range there."""
    points = transform_points(move, cloud[:, :3])
    low, high = np.array(grid.range_m[:3], np.float32), np.array(grid.range_m[3:], np.float32)
    inside = ((points > low) & (points < high)).all(axis=1)
    return np.concatenate([points, cloud[:, 3:]], axis=1)[inside].astype(np.float32)


def _pairwise(samples: Sequence[Sample]) -> Tensor:
    """Return the (B, L, L, 4, 4) transforms between agents' frames; the identity for absent ones."""
    most = max(len(sample.clouds) for sample in samples)
    between = np.tile(np.eye(4), (len(samples), most, most, 1, 1))
    for row, sample in enumerate(samples):
        poses = sample.ego_from_agent
        for i, pose in enumerate(poses):
            for j, other in enumerate(poses):
                between[row, i, j] = invert(other) @ pose
    return torch.from_numpy(between)


def _lost(samples: Sequence[Sample]) -> Tensor | None:
    """Return the (N, h, w) lost tiles of all samples' agents; None when all arrived."""
    shape = next((part.shape for sample in samples for part in sample.lost if part.size), None)
    if shape is None:
        return None
    none = np.zeros(shape, bool)
    parts = [part if part.size else none for s in samples for part in s.lost or (none,) * len(s.clouds)]
    return torch.from_numpy(np.stack(parts))


def pillars_of(clouds: Sequence[NDArray[np.float32]], settings: ModelSettings) -> Pillars:
    """Sort the points of (P, D) clouds into pillars."""
    points, rows, coords, counts = [], [], [], []
    start = 0
    grid = settings.grid
    cell = (grid.cell_m, grid.cell_m, grid.range_m[5] - grid.range_m[2])
    for number, cloud in enumerate(clouds):
        voxels = voxelise(cloud, grid.range_m, cell, settings.max_points, settings.max_pillars)
        points.append(cloud.take(voxels.order, axis=0))
        rows.append(np.repeat(np.arange(start, start + len(voxels)), voxels.count))
        counts.append(voxels.count)
        coords.append(np.concatenate([np.full((len(voxels), 1), number), voxels.coords_zyx[:, 1:]], axis=1))
        start += len(voxels)
    return Pillars(
        points=torch.from_numpy(np.concatenate(points).astype(np.float32, copy=False)),
        pillar=torch.from_numpy(np.concatenate(rows)),
        coords=torch.from_numpy(np.concatenate(coords).astype(np.int64, copy=False)),
        count=torch.from_numpy(np.concatenate(counts)),
        clouds=len(clouds),
    )


def _painted_pillars(clouds: Sequence[NDArray[np.float32]], settings: ModelSettings) -> Pillars:
    features = 5 if settings.pcp else 4
    return pillars_of([cloud[:, :features] for cloud in clouds], settings)


def _cells_with_points(views: list[TeacherClouds], grid: GridSpec) -> NDArray[np.bool_]:
    """Return the (N, H, W) mask of cells with a point on one of the agent's objects."""
    objects = [cloud for view in views for cloud in view.object_clouds]
    mask = np.zeros((len(objects), grid.height, grid.width), bool)
    for row, cloud in enumerate(objects):
        # The far face belongs to the last cell. What is clipped is not negative: cutting off its fraction rounds down.
        place = (cloud[:, :2].astype(np.float64) - grid.range_m[:2]) / grid.cell_m
        cells = np.clip(place, 0, [grid.width - 1, grid.height - 1]).astype(np.int64)
        mask[row, cells[:, 1], cells[:, 0]] = True
    return mask


def scene_of(merged: Sequence[NDArray[np.float32]], settings: ModelSettings) -> SceneVoxels:
    """Voxelise B merged (M, 4) clouds: occupied voxels and the mean of all their points."""
    grid, cell_z = settings.grid, settings.reconstruction_cell_z_m
    low, size = np.array(grid.range_m[:3]), np.array([grid.cell_m, grid.cell_m, cell_z])
    shape = np.array([grid.width, grid.height, round((grid.range_m[5] - grid.range_m[2]) / cell_z)])
    voxels, offsets = [], []
    for number, cloud in enumerate(merged):
        cells, count, sums = sum_cells(np.asarray(cloud, np.float32), low, size, shape)
        zyx = np.stack(np.unravel_index(cells, (settings.reconstruction_bins, grid.height, grid.width)), axis=1)
        centre = (zyx[:, ::-1] + 0.5) * size + low
        voxels.append(np.concatenate([np.full((len(cells), 1), number), zyx], axis=1))
        offsets.append(sums / count[:, None] - centre)
    return SceneVoxels(
        torch.from_numpy(np.concatenate(voxels).astype(np.int64)),
        torch.from_numpy(np.concatenate(offsets).astype(np.float32)),
        len(merged),
    )


_anchors = lru_cache(maxsize=4)(anchor_grid)


def _targets(samples: Sequence[Sample], settings: ModelSettings, labels: LabelSettings) -> Targets:
    legacy = labels.targets == "released"
    anchors = _anchors(settings.grid, settings.head_stride, settings.users, settings.anchor_lwh)
    kinds = ANCHORS[settings.users]
    found = [
        assign_targets(sample.boxes.array, anchors, kinds.positive_iou, legacy, fits=kinds.takes[sample.boxes.label])
        for sample in samples
    ]
    regression = np.stack([np.asarray(t.regression, np.float32) for t in found])
    regression[..., 6::7] *= kinds.headed
    if settings.box_order == "hwl":
        regression = regression.reshape(*regression.shape[:3], 2, 7)[..., REFERENCE_ORDER].reshape(regression.shape)
    return Targets(
        torch.from_numpy(np.stack([np.asarray(t.positive, bool) for t in found])), torch.from_numpy(regression)
    )
