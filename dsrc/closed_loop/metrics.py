"""Surrogate safety measure of an episode: time to collision."""

import math

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.collisions import height_gap, overlap

_STEEPEST = 0.1
"""Slope of the steepest road: a box ahead may be higher by this share of its distance and yet be on the ego's way."""


def time_to_collision(
    ego: Boxes,
    ego_velocity: NDArray[np.float64],
    others: Boxes,
    velocity: NDArray[np.float64],
    horizon_s: float = 5.0,
    step_s: float = 0.1,
) -> float:
    """Return the time until the ego's box first overlaps another, all at constant velocity, s; inf beyond the horizon.

    Oriented boxes, not points, as SUMO's and nuPlan's measures use. Who is on a bridge above or below does not count.

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
    near &= height_gap(ego, others) < _STEEPEST * np.maximum(np.linalg.norm(offset, axis=1) - reach, 0.0)
    if not near.any():
        return math.inf
    moved = others[near].bev_polygons()[:, None] + relative[near][:, None, None, :] * times[None, :, None, None]
    hit = overlap(ego.bev_polygons()[:, None], moved).any(axis=0)
    return float(times[np.argmax(hit)]) if hit.any() else math.inf
