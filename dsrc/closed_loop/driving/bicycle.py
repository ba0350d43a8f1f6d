"""Kinematic bicycle model, that of highway-env: axles half a length before and behind the centre, no slip.

P. Polack et al., *The kinematic bicycle model: a consistent model for planning feasible trajectories for autonomous
vehicles?*, IEEE IV 2017. Its wheels turn no faster than those of the BMW 320i of CommonRoad's vehicle models: M.
Althoff, M. Koschi, S. Manzinger, *CommonRoad: Composable Benchmarks for Motion Planning on Roads*, IEEE IV 2017.
"""

import math

import numpy as np

from dsrc.closed_loop.types import EgoState
from sim.geometry import Array

STEERING_RAD_S = 0.4
"""Fastest turn of the front wheels, rad/s."""

_MOST = 0.35
"""Sine of the slip angle up to which wheels turn: 36 degrees."""


def bicycle_step(
    pose: Array,
    speed_mps: Array,
    wheels_rad: Array,
    acceleration_mps2: Array,
    steering_rad: Array,
    length_m: float,
    step_s: float,
) -> tuple[Array, Array, Array]:
    """Return (K, 3) poses, (K,) speeds, m/s, and angles of the front wheels, rad, one step later.

    Brakes stop a vehicle and never drive it back.

    Args:
        pose: (K, 3) x, y of the centre, m, and heading, rad.
        speed_mps: (K,) speeds.
        wheels_rad: (K,) angles of the front wheels, positive to the left.
        acceleration_mps2: (K,) changes of speed.
        steering_rad: (K,) wanted angles of the front wheels; they turn to them at `STEERING_RAD_S` at most.
        length_m: of the vehicle.
    """
    most = STEERING_RAD_S * step_s
    wheels = wheels_rad + np.clip(steering_rad - wheels_rad, -most, most)
    slip = np.arctan(0.5 * np.tan(wheels))
    direction, way = pose[:, 2] + slip, speed_mps * step_s
    turned = way * np.sin(slip) / (0.5 * length_m)
    moved = np.column_stack([way * np.cos(direction), way * np.sin(direction), turned])
    return pose + moved, np.maximum(speed_mps + acceleration_mps2 * step_s, 0.0), wheels


def steering_for(turn_rad_s: Array, speed_mps: Array, length_m: float) -> Array:
    """Return the (K,) angles of the front wheels, rad, with which a vehicle turns at (K,) rates."""
    slip = np.arcsin(np.clip(0.5 * length_m * turn_rad_s / np.maximum(speed_mps, 0.1), -_MOST, _MOST))
    return np.asarray(np.arctan(2.0 * np.tan(slip)))


def wheels_of(before: EgoState, now: EgoState) -> Array:
    """Return the (1,) angle of the front wheels, rad, with which an ego turned from one state to the next.

    Straight for an ego that stood.
    """
    since_s = now.time_s - before.time_s
    if since_s <= 0.0:
        return np.zeros(1)
    turned = math.remainder(float(now.box.yaw[0] - before.box.yaw[0]), 2.0 * math.pi)
    return steering_for(np.array([turned / since_s]), np.array([before.speed_mps]), float(now.box.size[0, 0]))
