"""Samples on level ground: the surface below each cloud is taken off it, and put back on what is found.

Real ground slopes, and sensors stand at other heights than those that a detector was trained with: boxes of one height
above a flat ground are missed and made up.

Each agent's cloud is levelled by a surface of its own in the frame of the sample, as an agent can that sends features
before it hears of others. The clouds so fit together where a believed pose errs in height, pitch or roll. Boxes are
levelled, and put back, by the ego's surface, and where it does not know the ground by that of the first agent that
does. A cloud without any ground stays as it is.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from dsrc.ops.grid import GridSpec
from dsrc.ops.ground import LIDAR_M, Ground, fit_ground
from sim.boxes import Boxes

BEYOND_M = 12.0
"""Height by which the range of what is levelled grows up and down: what counts lies on any ground."""


def taller(grid: GridSpec) -> GridSpec:
    """Return the range of a sample that is to be levelled into a grid."""
    x0, y0, z0, x1, y1, z1 = grid.range_m
    return GridSpec((x0, y0, z0 - BEYOND_M, x1, y1, z1 + BEYOND_M), grid.cell_m)


def level(sample: Sample, grid: GridSpec, lidar_m: float = LIDAR_M) -> Sample:
    """Return a sample on level ground, `lidar_m` below its origin, clouds cropped to a grid; itself if it is level.

    Args:
        sample: with clouds of `taller(grid)`.
        grid: range of the levelled clouds.
        lidar_m: height of the LiDAR above the ground.
    """
    if sample.grounds:
        return sample
    reach_m = max(abs(limit) for limit in (*grid.range_m[:2], *grid.range_m[3:5]))
    others, corrupted = (
        tuple(_lowered(cloud, _fitted(cloud, reach_m, lidar_m), grid, lidar_m) for cloud in clouds)
        for clouds in (sample.other_clouds, sample.corrupted)
    )
    grounds = [_fitted(cloud, reach_m, lidar_m) for cloud in sample.clouds]
    return level_by(replace(sample, other_clouds=others, corrupted=corrupted), grounds, grid, lidar_m)


def level_by(sample: Sample, grounds: Sequence[Ground], grid: GridSpec, lidar_m: float = LIDAR_M) -> Sample:
    """Return a sample levelled by known surfaces of its agents' clouds, see `level`; its other clouds stay."""
    ground = joined(grounds)
    return replace(
        sample,
        clouds=tuple(_lowered(cloud, own, grid, lidar_m) for cloud, own in zip(sample.clouds, grounds, strict=True)),
        boxes=raised(sample.boxes, ground, -1.0, lidar_m),
        agent_boxes=tuple(raised(boxes, ground, -1.0, lidar_m) for boxes in sample.agent_boxes),
        grounds=tuple(grounds),
    )


def raised(boxes: Boxes, ground: Ground, sign: float = 1.0, lidar_m: float = LIDAR_M) -> Boxes:
    """Return boxes put from level ground back on a surface, by its height at their centres; -1 takes it off them."""
    center = boxes.center.copy()
    center[:, 2] += sign * (ground.at(center) + lidar_m)
    return replace(boxes, center=center)


def _fitted(cloud: NDArray[np.float32], reach_m: float, lidar_m: float) -> Ground:
    ground = fit_ground(cloud, reach_m)
    return ground if ground.known.any() else replace(ground, heights=np.full_like(ground.heights, -lidar_m))


def _lowered(cloud: NDArray[np.float32], ground: Ground, grid: GridSpec, lidar_m: float) -> NDArray[np.float32]:
    moved = cloud.copy()
    moved[:, 2] -= (ground.at(cloud) + lidar_m).astype(np.float32)
    inside = (moved[:, 2] > np.float32(grid.range_m[2])) & (moved[:, 2] < np.float32(grid.range_m[5]))
    return moved.compress(inside, axis=0)


def joined(grounds: Sequence[Ground]) -> Ground:
    """Return the surface of the boxes: that of the first agent that knows any, with what the others know beside it."""
    first = next((ground for ground in grounds if ground.known.any()), grounds[0])
    heights, known = first.heights.copy(), first.known.copy()
    for other in grounds:
        new = other.known & ~known
        heights[new], known = other.heights[new], known | new
    return Ground(heights, known, first.cell_m)
