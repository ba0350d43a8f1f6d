"""Plan of a batch: all that the host draws and decides of its samples, without a single point.

A worker makes it of poses and boxes, by the rules and draws by which it makes whole samples; `ResidentBatches` makes
the batch of it on the device.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from dsrc.data.sample import Sample
from dsrc.models.device import Movable
from dsrc.models.inputs.batch import fusion_samples
from dsrc.models.inputs.labels import cells_in_boxes
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS
from dsrc.training.augmentation.augment import Change, changed, draw, draw_shares
from dsrc.training.recipes import Recipe
from dsrc.training.resident.store import FramePoints
from dsrc.training.samples import Draw, TrainingSet
from sensors.frame import Frame
from sim.boxes import Boxes

# Legend: S clouds of agents, N clouds of a network, B samples, n boxes of a sample, T boxes of a frame.


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSample:
    """Sample without points.

    Attributes:
        frame: number of its frame.
        whole: as recorded, with all of its agents.
        sample: changed.
        change: how.
        shares: per agent of `sample` the share of its points that the student keeps, and (K,) float64 draws for its
            points, the agents' one after the other; None where all stay.
    """

    frame: int
    whole: Sample
    sample: Sample
    change: Change
    shares: tuple[NDArray[np.float64], NDArray[np.float64]] | None


class ResidentSet(Dataset[DrawnSample]):
    """Training set whose points are on the device: the samples of a `TrainingSet`, without them."""

    def __init__(self, training: TrainingSet, frames: Sequence[Frame], points: Sequence[FramePoints]) -> None:
        """Take the frames without points, and the numbers of their points."""
        self.training, self.frames = training, frames
        self.sizes = [part.sizes for part in points]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, drawn: Draw) -> DrawnSample:
        number = drawn[1]
        ref, ego, rng = self.training.ego_of(drawn)
        frame, recipe = self.frames[number], self.training.recipe
        whole = self.training.store.sample_of(frame, ref, ego)
        change = draw(len(whole.clouds), recipe.augmentation, rng)
        sample = changed(whole, recipe.model.grid, change)
        shares = None
        if change.thin:
            rows = rows_in(frame, sample.agent_ids)
            drawn_shares = draw_shares(len(rows), rng)
            shares = drawn_shares, rng.random(sum(self.sizes[number][row] for row in rows))
        return DrawnSample(number, whole, sample, change, shares)


def rows_in(frame: Frame, agent_ids: Sequence[int]) -> list[int]:
    """Return the rows of agents in a frame."""
    ids = [agent.agent_id for agent in frame.agents]
    return [ids.index(agent) for agent in agent_ids]


@dataclass(frozen=True, slots=True)
class PartPlan:
    """Agents of a sample that a network reads, and those whose points its teacher and its reconstruction have too.

    Attributes:
        frame: number of the frame.
        clouds: per cloud of the network the rows of its agents in the frame: one, but with early fusion.
        others: rows of the others.
    """

    frame: int
    clouds: tuple[tuple[int, ...], ...]
    others: tuple[int, ...]

    @property
    def rows(self) -> list[int]:
        """Rows of all agents, in the order of their points."""
        return [*(row for cloud in self.clouds for row in cloud), *self.others]


@dataclass(frozen=True, slots=True, eq=False)
class Plan(Movable):
    """Plan of a batch.

    Attributes:
        keys: (B,) keys of the samples.
        agents: (B,) number of clouds of each.
        truth: (B,) ground truth, as in a `Batch`.
        parts: (B,) their agents.
        poses: (S, 4, 4) float64 ego_from_lidar.
        planes: (B, 2, 2) float32 changes of x and y.
        lifts: (B,) float32 changes of z, m.
        boxes: (B, n, 7) float64 x, y, z, l, w, h, yaw; zeros where a sample has fewer.
        fits: (B, n, 2) bool whether a box may have each anchor of a cell.
        known: (N, T) bool boxes of the frame that are objects of each agent.
        roadside: (N,) bool.
        foreground: (N, H, W) bool as in a `Batch`, where it depends on boxes alone.
        shares: (S,) float64 share of points that the student keeps; None where it keeps all.
        draws: (K,) float64 for the students' points.
    """

    keys: tuple[str, ...]
    agents: tuple[int, ...]
    truth: tuple[Boxes, ...]
    parts: tuple[PartPlan, ...]
    poses: Tensor
    planes: Tensor
    lifts: Tensor
    boxes: Tensor
    fits: Tensor
    known: Tensor
    roadside: Tensor
    foreground: Tensor | None = None
    shares: Tensor | None = None
    draws: Tensor | None = None


class PlanCollate:
    """Collate function: a list of samples without points to a plan."""

    def __init__(self, settings: ModelSettings, recipe: Recipe, dataset: ResidentSet) -> None:
        self.settings, self.recipe, self.frames, self.sizes = settings, recipe, dataset.frames, dataset.sizes

    def __call__(self, drawn: list[DrawnSample]) -> Plan:
        """Collate."""
        samples = [fusion_samples(one.sample, self.settings)[0] for one in drawn]
        parts = [self._part(one, sample) for one, sample in zip(drawn, samples, strict=True)]
        boxes = np.zeros((len(samples), max(1, *(len(sample.boxes) for sample in samples)), 7))
        fits = np.zeros((*boxes.shape[:2], 2), bool)
        takes = ANCHORS[self.settings.users].takes
        for row, sample in enumerate(samples):
            boxes[row, : len(sample.boxes)] = sample.boxes.array
            fits[row, : len(sample.boxes)] = takes[sample.boxes.label]
        plan = Plan(
            keys=tuple(sample.key for sample in samples),
            agents=tuple(len(sample.clouds) for sample in samples),
            truth=tuple(sample.boxes for sample in samples),
            parts=tuple(parts),
            poses=torch.from_numpy(np.concatenate([self._poses(*pair) for pair in zip(drawn, parts, strict=True)])),
            planes=torch.from_numpy(np.stack([one.change.plane for one in drawn]).astype(np.float32)),
            lifts=torch.from_numpy(np.array([one.change.lift for one in drawn], np.float32)),
            boxes=torch.from_numpy(boxes),
            fits=torch.from_numpy(fits),
            known=torch.from_numpy(self._known(drawn, samples)),
            roadside=torch.tensor([agent < 0 for sample in samples for agent in sample.agent_ids]),
        )
        if self.recipe.labels.foreground == "boxes" and self.settings.role == "student" and self.settings.distils:
            own = [part for sample in samples for part in sample.agent_boxes]
            plan = replace(plan, foreground=torch.from_numpy(cells_in_boxes(own, self.settings.grid)))
        if self.settings.role == "student" and any(one.shares for one in drawn):
            shares, draws = self._thinning(drawn, parts)
            plan = replace(plan, shares=shares, draws=draws)
        return plan

    def _part(self, drawn: DrawnSample, part: Sample) -> PartPlan:
        """Return the agents of a sample, in the order in which the points of all are merged."""
        joined = part.agent_ids
        if self.settings.fusion == "early":
            joined = drawn.sample.agent_ids[: self.settings.max_agents]
        others: list[int] = []
        if self.settings.role == "teacher" or self.settings.distils or self.settings.rec:
            others = [agent for agent in drawn.sample.agent_ids if agent not in joined]
            others += [agent for agent in drawn.whole.agent_ids if agent not in drawn.sample.agent_ids]
        rows = tuple(rows_in(self.frames[drawn.frame], joined))
        clouds = (rows,) if self.settings.fusion == "early" else tuple((row,) for row in rows)
        return PartPlan(drawn.frame, clouds, tuple(rows_in(self.frames[drawn.frame], others)))

    def _poses(self, drawn: DrawnSample, part: PartPlan) -> NDArray[np.float64]:
        """Return the (S, 4, 4) poses of a sample's agents."""
        rows = rows_in(self.frames[drawn.frame], drawn.whole.agent_ids)
        return drawn.whole.ego_from_agent[[rows.index(row) for row in part.rows]]

    def _known(self, drawn: list[DrawnSample], samples: list[Sample]) -> NDArray[np.bool_]:
        """Return the (N, T) mask of the agents' objects among the boxes of their frames."""
        truths = [self.frames[one.frame].truth.object_id for one in drawn]
        known = np.zeros((sum(len(sample.clouds) for sample in samples), max(map(len, truths))), bool)
        own = [(ids, boxes) for ids, one in zip(truths, samples, strict=True) for boxes in one.agent_boxes]
        for row, (ids, boxes) in enumerate(own):
            known[row, : len(ids)] = np.isin(ids, boxes.object_id)
        return known

    def _thinning(self, drawn: list[DrawnSample], parts: list[PartPlan]) -> tuple[Tensor, Tensor]:
        """Return the shares and draws of the students' points."""
        shares, draws = [], []
        for one, part in zip(drawn, parts, strict=True):
            rows = [row for cloud in part.clouds for row in cloud]
            count = sum(self.sizes[one.frame][row] for row in rows)
            # A network reads the first agents of the sample.
            shares.append(np.ones(len(rows)) if one.shares is None else one.shares[0][: len(rows)])
            draws.append(np.zeros(count) if one.shares is None else one.shares[1][:count])
        return torch.from_numpy(np.concatenate(shares)), torch.from_numpy(np.concatenate(draws))
