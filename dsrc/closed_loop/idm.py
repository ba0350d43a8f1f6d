"""Intelligent Driver Model (Treiber, Hennecke, Helbing 2000), with highway-env's parameters scaled to town."""

import math

import msgspec


class IdmSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the car-following model.

    Attributes:
        max_acceleration: comfortable acceleration, m/s2.
        comfortable_deceleration: of the gap term, m/s2.
        max_deceleration: emergency braking, m/s2.
        headway_s: desired time gap, s.
        jam_gap: desired gap at standstill, m.
        exponent: of the free-road term.
    """

    max_acceleration: float = 2.5
    comfortable_deceleration: float = 3.5
    max_deceleration: float = 7.5
    headway_s: float = 1.4
    jam_gap: float = 2.5
    exponent: float = 4.0


def idm_acceleration(
    speed: float, desired_speed: float, gap: float, lead_speed: float, settings: IdmSettings | None = None
) -> float:
    """Return the ego's acceleration in m/s2, within the limits of `settings`.

    Args:
        speed: the ego's, m/s.
        desired_speed: on a free road, m/s; at or below zero the ego brakes to a stop.
        gap: bumper to bumper distance to the obstacle ahead, m; inf when the road is free.
        lead_speed: speed of the obstacle along the ego's path, m/s; negative when it comes towards the ego.
        settings: default: `IdmSettings()`.
    """
    settings = settings or IdmSettings()
    if desired_speed <= 0.0:
        return -settings.comfortable_deceleration
    acceleration = settings.max_acceleration * (1.0 - (speed / desired_speed) ** settings.exponent)
    if math.isfinite(gap):
        braking = 2.0 * math.sqrt(settings.max_acceleration * settings.comfortable_deceleration)
        wanted = settings.jam_gap + max(0.0, speed * settings.headway_s + speed * (speed - lead_speed) / braking)
        acceleration -= settings.max_acceleration * (wanted / max(gap, 0.1)) ** 2
    return min(max(acceleration, -settings.max_deceleration), settings.max_acceleration)
