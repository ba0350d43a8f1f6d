"""Time to collision: the surrogate safety measure of an episode."""

import math

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.collisions import height_gap, overlap

_STEEPEST = 0.1
"""Slope of the steepest road, m/m: a box may be higher by this share of its distance and still be in the ego's path."""


def time_to_collision(
    ego: Boxes,
    ego_velocity: NDArray[np.float64],
    others: Boxes,
    velocity: NDArray[np.float64],
    horizon_s: float = 5.0,
    step_s: float = 0.1,
) -> float:
    """Return the time until the ego's box first overlaps another, all at constant velocity, s; inf beyond the horizon.

    Oriented boxes, where SUMO's and nuPlan's measures use points. Boxes on a bridge above or below do not count.

    Args:
        ego: one box, world frame.
        ego_velocity: (2,) m/s.
        others: N boxes, world frame.
        velocity: (N, 2) m/s.
        horizon_s: longest time to collision, s.
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
