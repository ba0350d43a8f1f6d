"""Collision test of boxes: SUMO's own test misses contacts off its lanes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes

_TOUCH_M = 1e-9
"""Overlap depth up to which footprints only touch, m."""


def overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the (...,) overlap mask of rectangular footprints (..., 4, 2), by the separating axis theorem.

    Touching footprints and footprints without an area do not overlap.

    Args:
        a: corners in the order of `Boxes.bev_polygons`, m.
        b: the others, in the same frame; leading axes are broadcast.
    """
    apart = np.zeros(np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), bool)
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=-2)[..., :2, :] - polygon[..., :2, :]  # a rectangle has two directions
        normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
        touch = _TOUCH_M * np.hypot(edges[..., 0], edges[..., 1])
        on_a = np.einsum("...kc,...ec->...ek", a, normals)
        on_b = np.einsum("...kc,...ec->...ek", b, normals)
        gap = (on_a.max(-1) <= on_b.min(-1) + touch) | (on_b.max(-1) <= on_a.min(-1) + touch)
        apart |= gap.any(axis=-1)
    return ~apart


def height_gap(a: Boxes, b: Boxes) -> NDArray[np.float64]:
    """Return the (N,) vertical gap between boxes of equal rows, m; negative where heights overlap.

    Args:
        a: N boxes, or one that is compared with all of `b`.
        b: N boxes in the same frame, or one.
    """
    return np.abs(a.center[:, 2] - b.center[:, 2]) - 0.5 * (a.size[:, 2] + b.size[:, 2])


def collide(a: Boxes, b: Boxes) -> NDArray[np.bool_]:
    """Return the (N,) collision mask of upright boxes of equal rows; touching faces do not collide.

    Args:
        a: N boxes, or one that is compared with all of `b`.
        b: N boxes in the same frame, or one.
    """
    return overlap(a.bev_polygons(), b.bev_polygons()) & (height_gap(a, b) < 0.0)


def overlapping_pairs(boxes: Boxes, margin: float = 0.0) -> NDArray[np.int64]:
    """Return all pairs of colliding upright boxes.

    Args:
        boxes: N boxes in one frame.
        margin: growth of every footprint on all sides, m; negative shrinks it, at most to a point.

    Returns:
        (K, 2) rows into `boxes`, first < second, in ascending order.
    """
    grown = replace(boxes, size=np.maximum(boxes.size + 2.0 * np.array([margin, margin, 0.0]), 0.0))
    radius = 0.5 * np.hypot(grown.size[:, 0], grown.size[:, 1])
    offset = grown.center[None, :, :2] - grown.center[:, None, :2]
    # Only pairs whose circles meet need the exact test.
    near = np.hypot(offset[..., 0], offset[..., 1]) < radius[:, None] + radius[None, :]
    first, second = np.nonzero(np.triu(near, k=1))
    hit = collide(grown[first], grown[second])
    return np.stack([first[hit], second[hit]], axis=1).astype(np.int64)
