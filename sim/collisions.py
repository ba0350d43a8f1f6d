"""Which boxes overlap: our own collision test, because SUMO's misses what happens off its lanes."""

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes


def overlapping_pairs(boxes: Boxes, margin: float = 0.0) -> NDArray[np.int64]:
    """Find all pairs of upright boxes that share more than a touching face.

    A pair of rectangles is apart when one of the four directions of their sides separates them (separating axes).

    Args:
        boxes: N boxes in one frame.
        margin: grow every footprint on all sides by this, m.

    Returns:
        (K, 2) rows into `boxes`, first < second, in ascending order.
    """
    half = 0.5 * boxes.size + np.array([margin, margin, 0.0])
    radius = np.hypot(half[:, 0], half[:, 1])
    offset = boxes.center[None, :, :2] - boxes.center[:, None, :2]
    near = np.hypot(offset[..., 0], offset[..., 1]) < radius[:, None] + radius[None, :]
    near &= np.abs(boxes.center[None, :, 2] - boxes.center[:, None, 2]) < half[:, None, 2] + half[None, :, 2]
    first, second = np.nonzero(np.triu(near, k=1))
    # The sides' directions of both boxes of a pair, (K, 4, 2), and their sides as vectors, (K, 4, 2).
    sides = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw), -np.sin(boxes.yaw), np.cos(boxes.yaw)], axis=1)
    axes = np.concatenate([sides[first], sides[second]], axis=1).reshape(-1, 4, 2)
    extents = axes * np.concatenate([half[first, :2], half[second, :2]], axis=1)[:, :, None]
    reach = np.abs(np.einsum("kaj,kbj->kab", axes, extents)).sum(axis=2)
    distance = np.abs(np.einsum("kaj,kj->ka", axes, offset[first, second]))
    hit = (distance < reach - 1e-9).all(axis=1)
    return np.stack([first[hit], second[hit]], axis=1).astype(np.int64)
