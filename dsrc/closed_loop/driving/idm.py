"""Car following: the improved intelligent driver model.

Improved Intelligent Driver Model (IIDM): M. Treiber, A. Kesting, *Traffic Flow Dynamics*, Springer 2013, section
11.3.7. Unlike the first one (Treiber, Hennecke, Helbing 2000) it keeps the wanted gap at the wanted speed.
"""

import math

import msgspec


class IdmSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the car-following model.

    Attributes:
        acceleration_mps2: strongest acceleration.
        deceleration_mps2: comfortable deceleration.
        headway_s: time gap.
        standing_m: gap at standstill, m.
        exponent: of the free-road term.
    """

    acceleration_mps2: float = 2.4
    deceleration_mps2: float = 2.5
    headway_s: float = 1.1
    standing_m: float = 2.2
    exponent: float = 4.0


def free_acceleration(speed_mps: float, wanted_mps: float, settings: IdmSettings) -> float:
    """Return the acceleration on a free road, m/s2; a wanted speed of 0 brakes comfortably."""
    s = settings
    if wanted_mps <= 0.0:
        return -s.deceleration_mps2
    if speed_mps <= wanted_mps:
        return s.acceleration_mps2 * (1.0 - (speed_mps / wanted_mps) ** s.exponent)
    over = s.acceleration_mps2 * s.exponent / s.deceleration_mps2
    return -s.deceleration_mps2 * (1.0 - (wanted_mps / speed_mps) ** over)


def following_acceleration(
    speed_mps: float, wanted_mps: float, gap_m: float, lead_mps: float, settings: IdmSettings
) -> float:
    """Return the acceleration behind a leader, m/s2, unbounded below.

    Args:
        gap_m: bumper to bumper.
        lead_mps: speed of the leader along the ego's path.
    """
    s = settings
    free = free_acceleration(speed_mps, wanted_mps, s)
    braking = 2.0 * math.sqrt(s.acceleration_mps2 * s.deceleration_mps2)
    dynamic = speed_mps * s.headway_s + speed_mps * (speed_mps - lead_mps) / braking
    ratio = (s.standing_m + max(dynamic, 0.0)) / max(gap_m, 0.1)
    interaction = s.acceleration_mps2 * (1.0 - ratio**2)
    if speed_mps > wanted_mps:
        return free if ratio < 1.0 else free + interaction
    if ratio >= 1.0:
        return interaction
    return free * (1.0 - ratio ** (2.0 * s.acceleration_mps2 / free)) if free > 1e-3 else min(free, 0.0)
