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
from dsrc.training.augment import source_grid
from dsrc.training.recipes import Recipe
from dsrc.training.resident.plan import PartPlan, Plan
from dsrc.training.resident.store import FramePoints, ResidentPoints
from dsrc.training.resident.targets import Anchors
from dsrc.training.resident.voxels import Cells, Clouds


def reason_for_host(recipe: Recipe, settings: ModelSettings) -> str | None:
    """Return which setting of a recipe needs points on the host; None for none."""
    reasons = {
        "augmentation.corruption": recipe.augmentation.corruption > 0,
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
            batch = replace(batch, scene=self.cells.scene(self._clouds(points, inside, whole)))
        return batch

    def _clouds(self, points: Tensor, inside: Tensor, sizes: Sequence[int]) -> Clouds:
        return Clouds.of(points, inside, sizes, on_device(torch.tensor(sizes), self.store.device))

    def _moved(
        self, segments: Sequence[tuple[FramePoints, int]], parts: Sequence[_Part], plan: Plan
    ) -> tuple[Tensor, Tensor]:
        """Return the (P, 4) points of all agents, in the egos' frames and changed, and which of them are in range."""
        stored = [_of_agent(frame.points, frame.sizes, row) for frame, row in segments]
        xyz = torch.cat(
            [
                # In double precision, as on the host: world coordinates of kilometres are in the poses.
                (cloud[:, :3].double() @ pose[:3, :3].T + pose[:3, 3]).float()
                for cloud, pose in zip(stored, plan.poses, strict=True)
            ]
        )
        inside = _in_range(xyz, self.read)
        changed = [
            torch.cat([_in_plane(own, plane), own[:, 2:] + lift], dim=1)
            for own, plane, lift in zip(
                xyz.split([part.end - part.clouds[0] for part in parts]), plan.planes, plan.lifts, strict=True
            )
        ]
        xyz = torch.cat(changed)
        intensity = torch.cat([cloud[:, 3:] for cloud in stored])
        return torch.cat([xyz, intensity], dim=1), inside & _in_range(xyz, self.kept)

    def _with_student(self, batch: Batch, points: Tensor, inside: Tensor, parts: Sequence[_Part], plan: Plan) -> Batch:
        """Add the student's pillars."""
        own = [slice(part.clouds[0], part.clouds[-1]) for part in parts]
        sizes = [end - start for part in parts for start, end in pairwise(part.clouds)]
        points, inside = torch.cat([points[rows] for rows in own]), torch.cat([inside[rows] for rows in own])
        clean = self._clouds(points, inside, sizes)
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
        share = shares.repeat_interleave(
            on_device(torch.tensor(of_agents), self.store.device), output_size=sum(of_agents)
        )
        return draws[place.clamp(min=0)] < share

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
        settings, known = self.settings, iter(plan.known)
        found = torch.cat(
            [
                _of_agent(frame.rows, frame.found, row) + start
                for (frame, row), start in zip(segments, _starts([f.sizes[row] for f, row in segments]), strict=True)
            ]
        )
        owners = [_of_agent(frame.owners, frame.found, row) for frame, row in segments]
        of_part = iter(owners)
        rows, meant, objects, sizes = [], [], [], []
        number = torch.arange(len(points), device=points.device)
        for part, planned in zip(parts, plan.parts, strict=True):
            own_owners = torch.cat([next(of_part) for _ in planned.rows])
            of_sample = slice(part.found[0], part.found_end)
            place = found[of_sample]
            for (start, end), (first, last) in zip(pairwise(part.clouds), pairwise(part.found), strict=True):
                on_object = next(known)[own_owners].any(1)
                chosen = on_object & inside[place]
                of_own = slice(first - part.found[0], last - part.found[0])
                others = inside[start:end].index_copy(0, place[of_own] - start, (inside[place] & ~on_object)[of_own])
                shown = slice(None) if settings.sdd else of_own
                rows += [place[shown], number[start:end]]
                meant += [chosen[shown], others]
                objects += [len(meant[-2]), end - start]
                sizes.append(sum(objects[-2:]))
        whole, inside_whole = points[torch.cat(rows)], torch.cat(meant)
        is_object = self._clouds(whole, inside_whole, objects).cloud % 2 == 0
        if settings.pcp:
            whole = torch.cat([whole, is_object[:, None].to(whole.dtype)], dim=1)
        clouds = self._clouds(whole, inside_whole, sizes)
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


def _in_plane(xyz: Tensor, plane: Tensor) -> Tensor:
    """Return the (P, 2) changed x and y, rounded as by the host's matrix product: once for both terms."""
    return torch.addcmul(xyz[:, :1] * plane[:, 0], xyz[:, 1:2], plane[:, 1])


def _in_range(xyz: Tensor, corners: tuple[Tensor, Tensor]) -> Tensor:
    return ((xyz > corners[0]) & (xyz < corners[1])).all(1)


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
