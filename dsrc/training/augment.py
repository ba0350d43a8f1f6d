"""Augmentation of samples: all clouds and boxes of a sample move together, in the ego LiDAR's frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, inside_range
from dsrc.models.inputs.batch import with_agents
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import Augmentation
from sim.boxes import Boxes
from sim.geometry import wrap_angle


def source_grid(grid: GridSpec, augmentation: Augmentation) -> GridSpec:
    """Return the range to read, large enough for the rotated, scaled and lifted sample to fill the grid."""
    x = max(abs(grid.range_m[0]), abs(grid.range_m[3]))
    y = max(abs(grid.range_m[1]), abs(grid.range_m[4]))
    # Multiples of two cells keep the enlarged range a legal grid.
    step = 2 * grid.cell_m
    reach_x, reach_y = (
        float(np.ceil(_reach(*sides, augmentation.rotation_deg) / (1 - augmentation.scale) / step) * step)
        for sides in ((x, y), (y, x))
    )
    low, high = grid.range_m[2] - augmentation.height_m, grid.range_m[5] + augmentation.height_m
    if augmentation.rotation_deg == augmentation.scale == 0:
        (reach_x, reach_y) = (x, y)
    if augmentation.rotation_deg == augmentation.scale == augmentation.height_m == 0:
        return grid
    return GridSpec(range_m=(-reach_x, -reach_y, low, reach_x, reach_y, high), cell_m=grid.cell_m)


def _reach(along: float, across: float, rotation_deg: float) -> float:
    """Return the reach along the first axis of a rectangle of these half sides, rotated by up to an angle.

    It is largest with a corner on the axis, and falls with the angle from there.
    """
    angle = min(np.radians(rotation_deg), np.arctan2(across, along))
    return float(along * np.cos(angle) + across * np.sin(angle))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Change of a sample that augmentation has drawn.

    Attributes:
        agents: rows of the agents that stay; None for all.
        plane: (2, 2) float64 matrix of x and y: mirror images, rotation and scale.
        scale: factor of sizes in the plane.
        lift: shift along the vertical axis, m.
        thin: the student's clouds are thinned.
    """

    agents: tuple[int, ...] | None
    plane: NDArray[np.float64]
    scale: float
    lift: float
    thin: bool


def augment(sample: Sample, grid: GridSpec, augmentation: Augmentation, rng: np.random.Generator) -> Sample:
    """Drop collaborators, flip, rotate, scale and lift a sample, crop it to the grid, and thin it."""
    change = draw(len(sample.clouds), augmentation, rng)
    moved = changed(sample, grid, change)
    return thinned(moved, rng) if change.thin else moved


def draw(agents: int, augmentation: Augmentation, rng: np.random.Generator) -> Change:
    """Draw the change of a sample of so many agents."""
    # All draws are always made, so that one setting does not change the draws of others.
    drop, mirrors, turn, grow = rng.random(), rng.random(2) < 0.5, rng.uniform(-1, 1), rng.uniform(-1, 1)
    others = rng.permutation(np.arange(1, agents))[: rng.integers(agents)]
    signs = np.where(mirrors & augmentation.flip, -1.0, 1.0)
    angle = float(np.radians(augmentation.rotation_deg * turn))
    scale = 1 + augmentation.scale * grow
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # x and y only: scaling z would move the road.
    plane = scale * rotation @ np.diag(signs)
    thin = rng.random() < augmentation.thinning
    # Of a stream of its own, which leaves the draws of the thinning as they are.
    lift = augmentation.height_m * rng.spawn(1)[0].uniform(-1, 1)
    chosen = None
    if drop < max(augmentation.alone, augmentation.dropout):
        chosen = (0,) if drop < augmentation.alone else (0, *sorted(others.tolist()))
    return Change(chosen, plane, scale, lift, thin)


def changed(sample: Sample, grid: GridSpec, change: Change) -> Sample:
    """Change a sample, but for its thinning, and crop it to the grid.

    `ego_from_agent` is unchanged: a mirror image has no pose.
    """
    if change.agents is not None:
        sample = with_some(sample, change.agents)
    plane, scale, lift = change.plane, change.scale, change.lift
    return replace(
        sample,
        clouds=tuple(_cloud(cloud, plane, lift, grid) for cloud in sample.clouds),
        other_clouds=tuple(_cloud(cloud, plane, lift, grid) for cloud in sample.other_clouds),
        corrupted=tuple(_cloud(cloud, plane, lift, grid) for cloud in sample.corrupted),
        boxes=_boxes(sample.boxes, plane, scale, lift, grid),
        agent_boxes=tuple(_boxes(boxes, plane, scale, lift, grid) for boxes in sample.agent_boxes),
    )


def thinned(sample: Sample, rng: np.random.Generator) -> Sample:
    """Thin the student's clouds to a random share of each agent's points, from a tenth to all.

    Shares differ between agents, as the density of a scene does between views.
    """
    seen = sample.corrupted or sample.clouds
    shares = draw_shares(len(seen), rng)
    kept = (cloud[rng.random(len(cloud)) < share] for cloud, share in zip(seen, shares, strict=True))
    return replace(sample, corrupted=tuple(kept))


def draw_shares(agents: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the share of each agent's points that thinning keeps."""
    return rng.uniform(0.1, 1.0, agents)


def with_some(sample: Sample, rows: Sequence[int]) -> Sample:
    """Select agents, the ego first, and the ground truth that they have annotated.

    The others' clouds go to `other_clouds`: the teacher of a student of few agents stays dense.
    """
    dropped = tuple(cloud for row, cloud in enumerate(sample.clouds) if row not in rows)
    chosen = with_agents(sample, rows)
    known = np.isin(sample.boxes.object_id, np.concatenate([boxes.object_id for boxes in chosen.agent_boxes]))
    return replace(chosen, boxes=sample.boxes[known], other_clouds=(*sample.other_clouds, *dropped))


def _cloud(cloud: NDArray[np.float32], plane: NDArray[np.float64], lift: float, grid: GridSpec) -> NDArray[np.float32]:
    moved = cloud.copy()
    moved[:, :2] = cloud[:, :2] @ plane.T.astype(np.float32)
    moved[:, 2] += np.float32(lift)
    inside = np.ones(len(moved), bool)
    for axis in range(3):
        inside &= (moved[:, axis] > grid.range_m[axis]) & (moved[:, axis] < grid.range_m[axis + 3])
    return moved[inside]


def _boxes(boxes: Boxes, plane: NDArray[np.float64], scale: float, lift: float, grid: GridSpec) -> Boxes:
    forward = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1) @ plane.T
    center = boxes.center.copy()
    center[:, :2] = boxes.center[:, :2] @ plane.T
    center[:, 2] += lift
    moved = replace(
        boxes,
        center=center,
        size=boxes.size * np.array([scale, scale, 1.0]),
        yaw=wrap_angle(np.arctan2(forward[:, 1], forward[:, 0])),
    )
    return moved[inside_range(moved, grid)]
