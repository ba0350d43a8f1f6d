"""Augmentation of samples: all clouds and boxes of a sample move together, in the ego LiDAR's frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample, inside_range
from dsrc.models.inputs.batch import with_agents
from dsrc.ops.grid import GridSpec
from dsrc.training.augmentation.crowding import crowded
from dsrc.training.recipes import Augmentation
from sensors.compiled import compiled
from sensors.corruptions.physics.receiver import DEFAULT_REFLECTIVITY
from sim.boxes import Boxes
from sim.collisions import overlapping_pairs
from sim.geometry import wrap_angle

SHORTEST_M = 2.2
"""Length below which no vehicle is shrunk."""
SKIN_M = 0.1
"""Points this far outside the sides and the top of a box are the vehicle's too: ranges have errors."""

Clouds = tuple[NDArray[np.float32], ...]


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
    """Crowd and resize vehicles, rescale intensities, drop agents, flip, rotate, scale, lift, crop, and thin."""
    change = draw(len(sample.clouds), augmentation, rng)
    # Of streams of their own, after that of the lift: all other draws stay as they are.
    of_sizes, of_intensities, of_crowding = rng.spawn(3)
    if augmentation.crowding and change.agents == (0,):
        sample, change = with_some(sample, (0,)), replace(change, agents=None)
    sample = crowded(sample, augmentation.crowding, of_crowding)
    sample = resized(sample, grid.range_m[5], augmentation.sizes, of_sizes)
    sample = rescaled(sample, augmentation.intensity, of_intensities)
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


def resized(sample: Sample, ceiling_m: float, sizes: float, rng: np.random.Generator) -> Sample:
    """Resize the vehicles of a sample about the centre of their bottom, with the points on them.

    A vehicle has one new size in all clouds and boxes of the sample. One keeps its size if it would grow into another
    road user or through the ceiling, or if its id is not its own. What another size would hide or show stays.

    Source: random object scaling of J. Yang et al., ST3D, CVPR 2021; there the three factors are independent.

    Args:
        sample: its agents' boxes are among its boxes.
        ceiling_m: height above which boxes leave the ground truth.
        sizes: see `Augmentation`.
    """
    if sizes == 0:
        return sample
    factors = _factors(sample.boxes, ceiling_m, sizes, rng)
    boxes = _resized_boxes(sample.boxes, factors)
    _, first = np.unique(sample.boxes.object_id, return_index=True)
    ids = sample.boxes.object_id[first]

    def of_agent(own: Boxes) -> Boxes:
        rows = first[np.searchsorted(ids, own.object_id)]
        return _resized_boxes(own, factors[rows])

    def of_clouds(clouds: Clouds) -> Clouds:
        return tuple(_resized_cloud(cloud, sample.boxes, factors) for cloud in clouds)

    return replace(
        sample,
        clouds=of_clouds(sample.clouds),
        other_clouds=of_clouds(sample.other_clouds),
        corrupted=of_clouds(sample.corrupted),
        boxes=boxes,
        agent_boxes=tuple(of_agent(own) for own in sample.agent_boxes),
    )


def _factors(boxes: Boxes, ceiling_m: float, sizes: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw (N, 3) factors of length, width and height; 1 for what keeps its size."""
    least = np.minimum(1.0, SHORTEST_M / boxes.size[:, 0])
    common = np.maximum(rng.uniform(1 - sizes, 1 + 0.5 * sizes, len(boxes)), least)
    length = np.maximum(common * rng.uniform(1 - 0.25 * sizes, 1 + 0.25 * sizes, len(boxes)), least)
    _, place, count = np.unique(boxes.object_id, return_inverse=True, return_counts=True)
    chosen = boxes.is_vehicle & (count[place] == 1)
    factors = np.where(chosen[:, None], np.stack([length, common, common], axis=1), 1.0)
    grows = np.any(factors > 1, axis=1)
    # Of each pair the larger of both sizes, so that it does not matter which of the two keeps its own.
    largest = _resized_boxes(boxes, np.maximum(factors, 1.0))
    hindered = largest.center[:, 2] + 0.5 * largest.size[:, 2] > ceiling_m
    hindered[overlapping_pairs(largest).ravel()] = True
    factors[grows & hindered] = 1.0
    return factors


def _resized_boxes(boxes: Boxes, factors: NDArray[np.float64]) -> Boxes:
    """Resize boxes; their bottoms stay."""
    center = boxes.center.copy()
    center[:, 2] += 0.5 * boxes.size[:, 2] * (factors[:, 2] - 1)
    return replace(boxes, center=center, size=boxes.size * factors)


def _resized_cloud(cloud: NDArray[np.float32], boxes: Boxes, factors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Move the points on boxes to where they are on the resized ones; the ground below and all other points stay."""
    moved = cloud.copy()
    rows, owners = points_in_boxes(boxes, cloud, margin=SKIN_M)
    turn = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)
    _move(moved, rows, owners, boxes.center, 0.5 * boxes.size, turn, factors)
    return moved


@compiled()
def _move(
    points: NDArray[np.float32],
    rows: NDArray[np.intp],
    owners: NDArray[np.intp],
    center: NDArray[np.float64],
    half: NDArray[np.float64],
    turn: NDArray[np.float64],
    factors: NDArray[np.float64],
) -> None:
    """Move points in place, each with the one of its boxes from whose faces it is least far out.

    Args:
        points: (P, 4) float32 x, y, z, intensity.
        rows: (K,) rows of points, ascending.
        owners: (K,) rows of the boxes around them.
        center: (N, 3).
        half: (N, 3) half sizes.
        turn: (N, 2) cosine and sine of the headings.
        factors: (N, 3) of length, width and height.
    """
    best, least = -1, np.inf
    for pair in range(len(rows)):
        row, box = rows[pair], owners[pair]
        x, y, z = points[row, 0] - center[box, 0], points[row, 1] - center[box, 1], points[row, 2] - center[box, 2]
        c, s = turn[box, 0], turn[box, 1]
        along, across = c * x + s * y, c * y - s * x
        out = max(abs(along) - half[box, 0], abs(across) - half[box, 1], abs(z) - half[box, 2])
        if out < least:
            best, least = box, out
            shift_x, shift_y = along * (factors[box, 0] - 1), across * (factors[box, 1] - 1)
            up = z + half[box, 2]
        if pair + 1 < len(rows) and rows[pair + 1] == row:
            continue
        if up >= 0:
            c, s = turn[best, 0], turn[best, 1]
            points[row, 0] += c * shift_x - s * shift_y
            points[row, 1] += s * shift_x + c * shift_y
            points[row, 2] += up * (factors[best, 2] - 1)
        best, least = -1, np.inf


def rescaled(sample: Sample, intensity: float, rng: np.random.Generator) -> Sample:
    """Rescale the intensities of a sample with a probability, see `Augmentation`; a student's as its teacher's."""
    agents = len(sample.clouds) + len(sample.other_clouds)
    chance = rng.random()
    gain, exponent = np.exp2(rng.uniform(-2, 2, agents)), rng.uniform(0.6, 1.6, agents)
    # Readers put 0 or `DEFAULT_REFLECTIVITY` where a sensor measures none.
    constant = rng.uniform(0, 2 * DEFAULT_REFLECTIVITY)
    if chance >= intensity:
        return sample
    unknown = chance < 0.5 * intensity

    def of_cloud(cloud: NDArray[np.float32], agent: int) -> NDArray[np.float32]:
        scaled = cloud.copy()
        if unknown:
            scaled[:, 3] = constant
        else:
            powers = np.maximum(cloud[:, 3], np.float32(0)) ** np.float32(exponent[agent])
            scaled[:, 3] = np.minimum(np.float32(gain[agent]) * powers, np.float32(1))
        return scaled

    others = range(len(sample.clouds), agents)
    return replace(
        sample,
        clouds=tuple(map(of_cloud, sample.clouds, range(agents))),
        other_clouds=tuple(map(of_cloud, sample.other_clouds, others)),
        corrupted=tuple(map(of_cloud, sample.corrupted, range(agents))),
    )


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
