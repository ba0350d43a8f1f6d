"""Kinematic bicycle model, that of highway-env: axles half a length before and behind the centre, no slip.

P. Polack et al., *The kinematic bicycle model: a consistent model for planning feasible trajectories for autonomous
vehicles?*, IEEE IV 2017.
"""

import numpy as np

from sim.geometry import Array

_MOST = 0.35
"""Sine of the slip angle up to which wheels turn: 36 degrees."""


def bicycle_step(
    pose: Array, speed_mps: Array, acceleration_mps2: Array, steering_rad: Array, length_m: float, step_s: float
) -> tuple[Array, Array]:
    """Return (K, 3) poses and (K,) speeds, m/s, one step later; brakes stop a vehicle and never drive it back.

    Args:
        pose: (K, 3) x, y of the centre, m, and heading, rad.
        speed_mps: (K,) speeds.
        acceleration_mps2: (K,) changes of speed.
        steering_rad: (K,) angles of the front wheels, positive to the left.
        length_m: of the vehicle.
    """
    slip = np.arctan(0.5 * np.tan(steering_rad))
    direction, way = pose[:, 2] + slip, speed_mps * step_s
    turned = way * np.sin(slip) / (0.5 * length_m)
    moved = np.column_stack([way * np.cos(direction), way * np.sin(direction), turned])
    return pose + moved, np.maximum(speed_mps + acceleration_mps2 * step_s, 0.0)


def steering_for(turn_rad_s: Array, speed_mps: Array, length_m: float) -> Array:
    """Return the (K,) angles of the front wheels, rad, with which a vehicle turns at (K,) rates."""
    slip = np.arcsin(np.clip(0.5 * length_m * turn_rad_s / np.maximum(speed_mps, 0.1), -_MOST, _MOST))
    return np.asarray(np.arctan(2.0 * np.tan(slip)))
