"""Red-light stop of commanded SUMO vehicles, at comfortable deceleration."""

import math
from typing import Any

STOP_M = 0.5
"""Gap between bumper and stop line, m."""


def red_light_speed(sumo: Any, vehicle: str, decel_mps2: float, step_s: float) -> float:
    """Return the highest speed from which a vehicle still stops comfortably before a light that is not green.

    A vehicle too close to stop when the light changes drives on.

    Args:
        sumo: the libsumo module of the running simulation.
        decel_mps2: comfortable deceleration, m/s2.
        step_s: time until the next command, s.

    Returns:
        m/s; infinite when nothing stops the vehicle.
    """
    lights = sumo.vehicle.getNextTLS(vehicle)
    if not lights or lights[0][3] not in "ryu":
        return math.inf
    now_mps, gap_m = sumo.vehicle.getSpeed(vehicle), lights[0][2]
    if now_mps**2 > 2.0 * decel_mps2 * max(gap_m, 0.0) + 1.0:
        return math.inf
    step_mps = decel_mps2 * step_s
    return max(math.sqrt(step_mps**2 + 2.0 * decel_mps2 * max(gap_m - STOP_M, 0.0)) - step_mps, 0.0)
