"""Batches of points that are on the device: changed, sorted into pillars and given targets there.

The functions are those of PyTorch and run on any device. None waits for the device: sizes are those that the stored
clouds have at most.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import msgspec
import torch
from torch import Tensor

from dsrc.models.device import on_device
from dsrc.models.inputs.batch import Batch
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec
from dsrc.training.augmentation.augment import source_grid
from dsrc.training.recipes import Recipe
from dsrc.training.resident.plan import PartPlan, Plan
from dsrc.training.resident.store import FramePoints, ResidentPoints
from dsrc.training.resident.targets import Anchors
from dsrc.training.resident.voxels import Cells, Clouds, rows_of


def reason_for_host(recipe: Recipe, settings: ModelSettings) -> str | None:
    """Return which setting of a recipe needs points on the host; None for none."""
    reasons = {
        "augmentation.corruption": recipe.augmentation.corruption > 0,
        "augmentation.sizes": recipe.augmentation.sizes > 0,
        "augmentation.crowding": recipe.augmentation.crowding > 0,
        "augmentation.intensity": recipe.augmentation.intensity > 0,
        "labels.inside": recipe.labels.inside == "hull",
        "labels.targets": recipe.labels.targets == "released",
        "fusion": settings.fusion == "late",
        "own_frame": settings.own_frame,
        "left_handed": settings.left_handed,
        "height": settings.height == "ground",
        "intensity_steps": settings.intensity_steps is not None,
    }
    return next((name for name, needed in reasons.items() if needed), None)


@dataclass(frozen=True, slots=True)
class _Part:
    """Points of a sample in the array of all: rows of its agents, and of its objects in the array of these.

    Attributes:
        clouds: first row of each of the network's clouds, and the row after the last.
        end: row after those of all agents.
        found: as `clouds`, of the objects' points.
        found_end: as `end`.
    """

    clouds: tuple[int, ...]
    end: int
    found: tuple[int, ...]
    found_end: int


class ResidentBatches:
    """Maker of batches of resident points."""

    def __init__(self, store: ResidentPoints, settings: ModelSettings, recipe: Recipe) -> None:
        if recipe.labels.max_pillars is not None:
            fewer = min(recipe.labels.max_pillars, settings.max_pillars)
            settings = msgspec.structs.replace(settings, max_pillars=fewer)
        self.store, self.settings, self.recipe = store, settings, recipe
        self.cells, self.anchors = Cells(settings, store.device), Anchors(settings, store.device)
        self.read = _corners(source_grid(recipe.model.grid, recipe.augmentation), store.device)
        self.kept = _corners(recipe.model.grid, store.device)

    def __call__(self, plan: Plan) -> Batch:
        """Make the batch of a plan whose tensors are on the device."""
        settings = self.settings
        segments = [(self.store.points[part.frame], row) for part in plan.parts for row in part.rows]
        parts = list(_placed(plan.parts, self.store.points))
        points, inside = self._moved(segments, parts, plan)
        batch = Batch(
            keys=plan.keys,
            agents=plan.agents,
            boxes=plan.truth,
            student=None,
            grid=settings.grid,
            roadside=plan.roadside,
            targets=self.anchors.targets(plan.boxes, plan.fits),
        )
        if settings.role == "student":
            batch = self._with_student(batch, points, inside, parts, plan)
        if settings.role == "teacher" or settings.distils:
            batch = self._with_teacher(batch, segments, points, inside, parts, plan)
        if settings.role == "student" and settings.rec:
            whole = [part.end - part.clouds[0] for part in parts]
            batch = replace(batch, scene=self.cells.scene(_clouds(points, inside, whole)))
        return batch

    def _moved(
        self, segments: Sequence[tuple[FramePoints, int]], parts: Sequence[_Part], plan: Plan
    ) -> tuple[Tensor, Tensor]:
        """Return the (P, 4) points of all agents, in the egos' frames and changed, and which of them are in range."""
        stored = torch.cat([_of_agent(frame.points, frame.sizes, row) for frame, row in segments])
        pose = _repeated(plan.poses[:, :3], [frame.sizes[row] for frame, row in segments])
        # In double precision, as on the host: world coordinates of kilometres are in the poses.
        xyz = ((pose[..., :3] * stored[:, None, :3]).sum(2) + pose[..., 3]).float()
        inside = _in_range(xyz, self.read)
        of_samples = [part.end - part.clouds[0] for part in parts]
        plane, lift = _repeated(plan.planes, of_samples), _repeated(plan.lifts, of_samples)
        # Rounded once for both terms, as by the host's matrix product.
        xy = torch.addcmul(xyz[:, :1] * plane[..., 0], xyz[:, 1:2], plane[..., 1])
        xyz = torch.cat([xy, xyz[:, 2:] + lift[:, None]], dim=1)
        return torch.cat([xyz, stored[:, 3:]], dim=1), inside & _in_range(xyz, self.kept)

    def _with_student(self, batch: Batch, points: Tensor, inside: Tensor, parts: Sequence[_Part], plan: Plan) -> Batch:
        """Add the student's pillars."""
        own = [slice(part.clouds[0], part.clouds[-1]) for part in parts]
        sizes = [size for part in parts for size in _sizes(part.clouds)]
        points, inside = torch.cat([points[rows] for rows in own]), torch.cat([inside[rows] for rows in own])
        clean = _clouds(points, inside, sizes)
        if plan.shares is None or plan.draws is None:
            return replace(batch, student=self.cells.pillars(clean))
        kept = self._kept(inside, own, plan, plan.shares, plan.draws)
        thinned = self.cells.pillars(replace(clean, inside=inside & kept))
        if self.recipe.consistency > 0:
            return replace(batch, student=self.cells.pillars(clean), view=thinned)
        return replace(batch, student=thinned)

    def _kept(self, inside: Tensor, own: Sequence[slice], plan: Plan, shares: Tensor, draws: Tensor) -> Tensor:
        """Return the (P,) mask of points that thinning keeps: the i-th in range has a sample's i-th draw."""
        sizes = [rows.stop - rows.start for rows in own]
        place = torch.cat(
            [part.cumsum(0) - 1 + start for part, start in zip(inside.split(sizes), _starts(sizes), strict=True)]
        )
        of_agents = [
            self.store.points[part.frame].sizes[row] for part in plan.parts for cloud in part.clouds for row in cloud
        ]
        return draws[place.clamp(min=0)] < _repeated(shares, of_agents)

    def _with_teacher(
        self,
        batch: Batch,
        segments: Sequence[tuple[FramePoints, int]],
        points: Tensor,
        inside: Tensor,
        parts: Sequence[_Part],
        plan: Plan,
    ) -> Batch:
        """Add the teacher's pillars and the foreground, see `dsrc.models.inputs.teacher.teacher_clouds`."""
        settings = self.settings
        starts = on_device(torch.tensor(_starts([frame.sizes[row] for frame, row in segments])), self.store.device)
        found = torch.cat([_of_agent(frame.rows, frame.found, row) for frame, row in segments])
        found += _repeated(starts, [frame.found[row] for frame, row in segments])
        owners = iter([_of_agent(frame.owners, frame.found, row) for frame, row in segments])
        number = torch.arange(len(points), device=points.device)
        rows, meant, objects = [], [], []
        for part, planned, known in zip(parts, plan.parts, plan.known.split(plan.agents), strict=True):
            place = found[part.found[0] : part.found_end]
            on_object = known[:, torch.cat([next(owners) for _ in planned.rows])].any(2)
            seen = inside[place]
            chosen = on_object & seen
            # Points of the network's clouds come first, each on an object of its own agent or not.
            first, end, own = part.clouds[0], part.clouds[-1], part.found[-1] - part.found[0]
            cloud = _repeated(torch.arange(len(planned.clouds), device=points.device), _sizes(part.found))
            of_agent = on_object[:, :own].gather(0, cloud[None])[0]
            others = inside[first:end].index_copy(0, place[:own] - first, seen[:own] & ~of_agent)
            sizes = _sizes(part.clouds)
            split = zip(number[first:end].split(sizes), others.split(sizes), pairwise(part.found), strict=True)
            for agent, (own_rows, own_others, ends) in enumerate(split):
                shown = slice(None) if settings.sdd else slice(*(row - part.found[0] for row in ends))
                rows += [place[shown], own_rows]
                meant += [chosen[agent, shown], own_others]
                objects += [len(rows[-2]), len(own_rows)]
        whole, inside_whole = rows_of(points, torch.cat(rows)), torch.cat(meant)
        is_object = _repeated(torch.arange(len(objects), device=points.device), objects) % 2 == 0
        if settings.pcp:
            whole = torch.cat([whole, is_object[:, None].to(whole.dtype)], dim=1)
        clouds = _clouds(whole, inside_whole, [sum(pair) for pair in zip(objects[::2], objects[1::2], strict=True)])
        on_objects = replace(clouds, inside=inside_whole & is_object)
        batch = replace(batch, teacher=self.cells.pillars(clouds))
        if self.recipe.distill.teacher_norms == "moving":
            batch = replace(batch, objects=self.cells.pillars(on_objects))
        if settings.role == "teacher":
            return batch
        by_boxes = plan.foreground is not None
        return replace(batch, foreground=plan.foreground if by_boxes else self.cells.with_points(on_objects))


def _corners(grid: GridSpec, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the (3,) float32 lower and upper corner of a grid's range."""
    low, high = torch.tensor(grid.range_m, device=device).view(2, 3)
    return low, high


def _in_range(xyz: Tensor, corners: tuple[Tensor, Tensor]) -> Tensor:
    return ((xyz > corners[0]) & (xyz < corners[1])).all(1)


def _repeated(rows: Tensor, sizes: Sequence[int]) -> Tensor:
    """Return each row as often as its size says, which the host knows."""
    ends = on_device(torch.tensor(sizes).cumsum(0), rows.device)
    row = torch.searchsorted(ends, torch.arange(sum(sizes), device=rows.device), right=True)
    return rows[row] if rows.ndim == 1 else rows_of(rows.flatten(1), row).view(-1, *rows.shape[1:])


def _clouds(points: Tensor, inside: Tensor, sizes: Sequence[int]) -> Clouds:
    """Return clouds of these sizes."""
    return Clouds(points, _repeated(torch.arange(len(sizes), device=points.device), sizes), inside, tuple(sizes))


def _sizes(ends: Sequence[int]) -> list[int]:
    """Return the sizes of consecutive parts that begin and end at these rows."""
    return [end - start for start, end in pairwise(ends)]


def _starts(sizes: Sequence[int]) -> list[int]:
    """Return the first row of each of consecutive parts of these sizes."""
    return list(accumulate(sizes, initial=0))[:-1]


def _of_agent(rows: Tensor, sizes: Sequence[int], agent: int) -> Tensor:
    """Return the rows of one agent."""
    start = sum(sizes[:agent])
    return rows[start : start + sizes[agent]]


def _placed(plans: Sequence[PartPlan], points: Sequence[FramePoints]) -> Iterator[_Part]:
    """Yield where the points of each sample are in the arrays of all."""
    row = found = 0
    for plan in plans:
        frame = points[plan.frame]
        ends = list(accumulate((sum(frame.sizes[agent] for agent in cloud) for cloud in plan.clouds), initial=row))
        found_ends = list(accumulate((sum(frame.found[a] for a in cloud) for cloud in plan.clouds), initial=found))
        row = ends[-1] + sum(frame.sizes[agent] for agent in plan.others)
        found = found_ends[-1] + sum(frame.found[agent] for agent in plan.others)
        yield _Part(tuple(ends), row, tuple(found_ends), found)
