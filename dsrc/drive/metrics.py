"""Surrogate safety measures of one episode: collisions, time to collision, progress."""

import math

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes


def overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (...,) whether convex footprints (..., 4, 2) overlap, by the separating axis theorem.

    Footprints that only touch do not overlap.
    """
    apart = np.zeros(np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), bool)
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=-2)[..., :2, :] - polygon[..., :2, :]  # a rectangle has two directions
        normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
        on_a = np.einsum("...kc,...ec->...ek", a, normals)
        on_b = np.einsum("...kc,...ec->...ek", b, normals)
        gap = (on_a.max(-1) <= on_b.min(-1)) | (on_b.max(-1) <= on_a.min(-1))
        apart |= gap.any(axis=-1)
    return ~apart


def time_to_collision(
    ego: Boxes,
    ego_velocity: NDArray[np.float64],
    others: Boxes,
    velocity: NDArray[np.float64],
    horizon_s: float = 5.0,
    step_s: float = 0.1,
) -> float:
    """Return the time until the ego's box first overlaps another, all at constant velocity, s; inf beyond the horizon.

    Oriented boxes, not points, as SUMO's and nuPlan's measures use.

    Args:
        ego: one box, world frame.
        ego_velocity: (2,) m/s.
        others: N boxes, world frame.
        velocity: (N, 2) m/s.
        horizon_s: how far to look, s.
        step_s: resolution, s.
    """
    if len(others) == 0:
        return math.inf
    times = np.arange(0.0, horizon_s + 0.5 * step_s, step_s)
    relative = velocity - ego_velocity[None, :]
    reach = 0.5 * (np.linalg.norm(ego.size[0, :2]) + np.linalg.norm(others.size[:, :2], axis=1))
    offset = others.center[:, :2] - ego.center[0, :2]
    # Only boxes whose circles can meet within the horizon need the exact test.
    speed2 = np.maximum(np.sum(relative**2, axis=1), 1e-9)
    closest_at = np.clip(-np.sum(offset * relative, axis=1) / speed2, 0.0, horizon_s)
    near = np.linalg.norm(offset + closest_at[:, None] * relative, axis=1) <= reach
    if not near.any():
        return math.inf
    moved = others[near].bev_polygons()[:, None] + relative[near][:, None, None, :] * times[None, :, None, None]
    hit = overlap(ego.bev_polygons()[:, None], moved).any(axis=0)
    return float(times[np.argmax(hit)]) if hit.any() else math.inf
