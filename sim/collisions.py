"""Which boxes overlap: our own collision test, because SUMO's misses what happens off its lanes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes

_TOUCH_M = 1e-9
"""Depth up to which footprints only touch."""


def overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (...,) whether rectangular footprints (..., 4, 2) overlap, by the separating axis theorem.

    Footprints that only touch, or have no area, do not overlap.

    Args:
        a: corners in the order of `Boxes.bev_polygons`, m.
        b: others in the same frame; leading axes are broadcast.
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
    """Return (N,) free height between boxes of equal rows, m; negative where they share heights.

    Args:
        a: N boxes, or one that is compared with all of `b`.
        b: N boxes in the same frame, or one.
    """
    return np.abs(a.center[:, 2] - b.center[:, 2]) - 0.5 * (a.size[:, 2] + b.size[:, 2])


def collide(a: Boxes, b: Boxes) -> NDArray[np.bool_]:
    """Return (N,) whether upright boxes of equal rows share more than a touching face.

    Args:
        a: N boxes, or one that is compared with all of `b`.
        b: N boxes in the same frame, or one.
    """
    return overlap(a.bev_polygons(), b.bev_polygons()) & (height_gap(a, b) < 0.0)


def overlapping_pairs(boxes: Boxes, margin: float = 0.0) -> NDArray[np.int64]:
    """Find all pairs of upright boxes that share more than a touching face.

    Args:
        boxes: N boxes in one frame.
        margin: grow every footprint on all sides by this, m; a negative one shrinks it, at most to nothing.

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
