"""Surrogate measures of safety: how near an episode came to a crash, from ground truth.

Boxes are oriented footprints, where SUMO's and many others' measures are of points; road users on a bridge above or
below do not count.
"""

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from dsrc.closed_loop.metrics.driven import Motion
from sim.boxes import Boxes
from sim.collisions import height_gap, overlap
from sim.geometry import wrap_angle

HORIZON_S = 10.0
"""Longest time to collision that counts, s."""
CRITICAL_TTC_S = 1.5
"""Time to collision below which exposure is counted, s."""
CROSSING_RAD = math.radians(30.0)
"""Smallest difference of heading of paths that cross."""
LONGEST_PET_S = 5.0
"""Longest post-encroachment time that counts, s."""
STANDING_MPS = 0.5
"""Speed below which there is no time headway, m/s."""
_SLOPE = 0.1  # steepest road, m/m: a box may be higher by this share of its distance and still be in the ego's way


def time_to_collision(
    ego: Boxes,
    ego_velocity: NDArray[np.float64],
    others: Boxes,
    velocity: NDArray[np.float64],
    horizon_s: float = HORIZON_S,
) -> float:
    """Return the time until the ego's box first meets another, all at constant velocity, s; inf beyond the horizon.

    Source: J. C. Hayward, Near-miss determination through use of a scale of danger, Highway Research Record 384 (1972).

    Args:
        ego: one box, world frame.
        ego_velocity: (2,) m/s.
        others: N boxes, world frame.
        velocity: (N, 2) m/s.
        horizon_s: longest time, s.
    """
    return float(times_to_collision(ego, ego_velocity, others, velocity, horizon_s).min(initial=math.inf))


def times_to_collision(
    ego: Boxes,
    ego_velocity: NDArray[np.float64],
    others: Boxes,
    velocity: NDArray[np.float64],
    horizon_s: float = HORIZON_S,
) -> NDArray[np.float64]:
    """Return the (N,) times until the ego's box meets each other one, s; 0 for overlaps, inf beyond the horizon.

    Exact: two moving rectangles meet when their shadows overlap on the normals of all their sides at once.
    """
    found = np.full(len(others), math.inf)
    relative = velocity - ego_velocity
    # Only boxes whose circles can meet within the horizon need the exact test.
    reach = 0.5 * (np.linalg.norm(ego.size[:, :2], axis=1) + np.linalg.norm(others.size[:, :2], axis=1))
    away = np.linalg.norm(others.center[:, :2] - ego.center[:, :2], axis=1)
    near = np.flatnonzero(away <= reach + horizon_s * np.linalg.norm(relative, axis=1))
    near = near[_same_road(ego, others[near])]
    if len(near):
        times = _first_touch(ego, others[near], relative[near])
        found[near] = np.where(times <= horizon_s, times, math.inf)
    return found


def _first_touch(ego: Boxes, others: Boxes, relative: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N,) times until boxes meet that move by (N, 2) velocities relative to the ego, m/s; inf for never."""
    ours, theirs = ego.bev_polygons(), others.bev_polygons()
    enters, leaves = np.full(len(others), 0.0), np.full(len(others), math.inf)
    for yaw in (np.repeat(ego.yaw, len(others)), others.yaw):
        for turn in (0.0, 0.5 * math.pi):
            normal = np.stack([np.cos(yaw + turn), np.sin(yaw + turn)], axis=1)
            on_us = np.einsum("nkc,nc->nk", np.broadcast_to(ours, theirs.shape), normal)
            on_them = np.einsum("nkc,nc->nk", theirs, normal)
            rate = np.einsum("nc,nc->n", relative, normal)
            near, far = on_us.min(axis=1) - on_them.max(axis=1), on_us.max(axis=1) - on_them.min(axis=1)
            # Their shadow lies over ours while near < rate * t < far.
            with np.errstate(divide="ignore", invalid="ignore"):
                first, last = np.minimum(near / rate, far / rate), np.maximum(near / rate, far / rate)
            still = np.abs(rate) < 1e-12
            over = (near < 0.0) & (far > 0.0)
            enters = np.maximum(enters, np.where(still, np.where(over, 0.0, math.inf), first))
            leaves = np.minimum(leaves, np.where(still, math.inf, last))
    return np.where(enters < leaves, enters, math.inf)


def _same_road(ego: Boxes, others: Boxes) -> NDArray[np.bool_]:
    """Return the (N,) mask of boxes that are not on a bridge above or below."""
    reach = 0.5 * (np.linalg.norm(ego.size[:, :2], axis=1) + np.linalg.norm(others.size[:, :2], axis=1))
    away = np.linalg.norm(others.center[:, :2] - ego.center[:, :2], axis=1)
    return np.asarray(height_gap(ego, others) < _SLOPE * np.maximum(away - reach, 0.0), bool)


def ttc_series(motion: Motion, horizon_s: float = HORIZON_S) -> NDArray[np.float64]:
    """Return the (T,) smallest time to collision at each step, s; inf beyond the horizon."""
    steps = range(len(motion))
    return np.array(
        [time_to_collision(motion.boxes[t : t + 1], motion.velocity[t], *motion.others(t), horizon_s) for t in steps],
        np.float64,
    )


def exposure(ttc: NDArray[np.float64], step_s: float, critical_s: float = CRITICAL_TTC_S) -> tuple[float, float]:
    """Return time exposed and time integrated time to collision: (TET in s, TIT in s2).

    TET is the time with a TTC below the critical one, TIT the integral of what lacks to it.

    Source: M. M. Minderhoud and P. H. L. Bovy, Extended time-to-collision measures for road traffic safety assessment,
    Accident Analysis and Prevention 33 (2001), 89-97.
    """
    lacking = np.maximum(critical_s - ttc, 0.0)
    return float((ttc < critical_s).sum() * step_s), float(lacking.sum() * step_s)


def drac(motion: Motion) -> float:
    """Return the largest deceleration rate to avoid a crash, m/s2; 0 if the ego never was to meet anybody.

    The constant braking of the ego that ends its approach just at the contact: v^2 / (2 gap), with v the closing speed
    along the ego's heading and gap = v TTC the distance over which they approach.

    Source: D. F. Cooper and N. Ferguson, Traffic studies at T-junctions, Traffic Engineering and Control 17 (1976).
    """
    worst = 0.0
    for t in range(len(motion)):
        ego, (others, velocity) = motion.boxes[t : t + 1], motion.others(t)
        times = times_to_collision(ego, motion.velocity[t], others, velocity)
        heading = np.array([math.cos(ego.yaw[0]), math.sin(ego.yaw[0])])
        closing = (motion.velocity[t] - velocity) @ heading
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.where((times > 0.0) & (times <= HORIZON_S) & (closing > 0.0), 0.5 * closing / times, 0.0)
        worst = max(worst, float(needed.max(initial=0.0)))
    return worst


def post_encroachment_time(motion: Motion) -> float:
    """Return the shortest time between one's leaving a place and the other's reaching it, s; inf beyond 5 s.

    Of road users whose headings differ by at least 30 degrees at that place: who follows in a lane has a headway.

    Source: B. L. Allen, B. T. Shin and P. J. Cooper, Analysis of traffic conflicts and collisions, Transportation
    Research Record 667 (1978), 67-74.
    """
    shortest = math.inf
    if not len(motion):
        return shortest
    corners = motion.boxes.bev_polygons()
    for steps, other in motion.tracks().values():
        times = motion.time_s[steps]
        apart = np.abs(motion.time_s[:, None] - times[None, :])
        offset = motion.boxes.center[:, None, :2] - other.center[None, :, :2]
        reach = 0.5 * (np.linalg.norm(motion.boxes.size[0, :2]) + np.linalg.norm(other.size[0, :2]))
        turned = np.abs(wrap_angle(motion.boxes.yaw[:, None] - other.yaw[None, :]))
        crossing = (turned > CROSSING_RAD) & (turned < math.pi - CROSSING_RAD)
        level = np.abs(motion.boxes.center[:, None, 2] - other.center[None, :, 2]) < 0.5 * (
            motion.boxes.size[0, 2] + other.size[0, 2]
        )
        near = crossing & level & (np.hypot(offset[..., 0], offset[..., 1]) < reach)
        ours, theirs = np.nonzero(near & (apart <= min(shortest, LONGEST_PET_S)))
        if len(ours):
            met = overlap(corners[ours], other.bev_polygons()[theirs])
            shortest = min(shortest, float(apart[ours, theirs][met].min(initial=math.inf)))
    return shortest


def nearest_distance(motion: Motion) -> float:
    """Return the smallest distance of the ego's footprint to another, m; inf without others."""
    nearest = math.inf
    for t in range(len(motion)):
        ego, (others, _) = motion.boxes[t : t + 1], motion.others(t)
        reach = 0.5 * (np.linalg.norm(ego.size[0, :2]) + np.linalg.norm(others.size[:, :2], axis=1))
        away = np.linalg.norm(others.center[:, :2] - ego.center[0, :2], axis=1)
        close = (away - reach < nearest) & (height_gap(ego, others) < 0.0)
        if close.any():
            gap = shapely.distance(
                shapely.polygons(ego.bev_polygons()[0]), shapely.polygons(others[close].bev_polygons())
            )
            nearest = min(nearest, float(gap.min()))
    return nearest


def headways(motion: Motion, routes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the (T,) net time headway at each step, s: the gap to the road user ahead over the ego's speed.

    Ahead is who is on the ego's route by half of both widths, and heads along it; inf without one, and for an ego that
    stands.

    Source: K. Vogel, A comparison of headway and time to collision as safety indicators, Accident Analysis and
    Prevention 35 (2003), 427-433, with the net gap in place of that between front bumpers.

    Args:
        routes: (K, 2) route from the ego's centre at each step, m.
    """
    found = np.full(len(motion), math.inf)
    for t, (route, speed) in enumerate(zip(routes, motion.speed_mps.tolist(), strict=False)):
        ego, (others, _) = motion.boxes[t : t + 1], motion.others(t)
        if speed < STANDING_MPS or len(route) < 2 or not len(others):
            continue
        along = np.abs(wrap_angle(others.yaw - ego.yaw[0])) < math.pi / 2
        others = others[along & _same_road(ego, others)]
        line, places = shapely.LineString(route), shapely.points(others.center[:, :2])
        on_path = shapely.distance(line, places) < 0.5 * (ego.size[0, 1] + others.size[:, 1])
        gap = shapely.line_locate_point(line, places) - 0.5 * (ego.size[0, 0] + others.size[:, 0])
        found[t] = float(gap[on_path & (gap > 0.0)].min(initial=math.inf)) / speed
    return found
