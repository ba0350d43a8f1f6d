"""Scenarios with other sensors, agents or another place than their file says."""

import math
from typing import Literal

import msgspec

from sim.errors import SettingsError, complaint
from sim.scenario import Area, Scenario

HALF_M = 150.0
"""Half the side of the area around a place, m."""


def with_sensors(
    scenario: Scenario,
    vehicles: int | None = None,
    lidar: str | None = None,
    roadside_lidar: str | None = None,
    roadside: bool = True,
    mount: tuple[float, float, float, float] | None = None,
) -> Scenario:
    """Return a scenario with other sensors or another number of agents; None leaves a setting as it is.

    Args:
        mount: x y z in the body frame, m, and pitch, deg, of the vehicles' LiDARs.
    """
    rule = scenario.agents
    units = rule.roadside if roadside else ()
    if roadside_lidar is not None:
        units = tuple(msgspec.structs.replace(unit, lidar=roadside_lidar) for unit in units)
    rule = msgspec.structs.replace(
        rule,
        vehicles=rule.vehicles if vehicles is None else vehicles,
        lidar=rule.lidar if lidar is None else lidar,
        roadside=units,
    )
    if mount is not None:
        rule = msgspec.structs.replace(rule, mount_xyz_m=mount[:3], mount_pitch_deg=mount[3])
    return msgspec.structs.replace(scenario, agents=rule)


def in_world(scenario: Scenario, world: Literal[1, 2] | None) -> Scenario:
    """Return a scenario in a world of another version, see `Scenario.world`; None leaves it as it is."""
    return scenario if world is None else msgspec.structs.replace(scenario, world=world)


def parked_along(scenario: Scenario, per_km: float | None) -> Scenario:
    """Return a scenario with so many parked cars per km of kerb; an encounter, and with None any other, as it is."""
    if per_km is None or scenario.conflict is not None:
        return scenario
    demand = msgspec.structs.replace(scenario.demand, parked_per_km=per_km)
    return msgspec.structs.replace(scenario, demand=demand)


def at_place(scenario: Scenario, at: str | tuple[float, float]) -> Scenario:
    """Return a scenario whose agents drive around a point of its world.

    The area in which agents are chosen, and trips pass, is a square around the point; roadside units outside are left
    out.

    Args:
        at: x and y, m, or both as text, `X,Y`.

    Raises:
        SettingsError: no two numbers, or the scenario is an encounter, which has a place of its own.
    """
    if scenario.conflict is not None:
        raise SettingsError(f"generate: {scenario.name} is an encounter, which has its own place; leave out --at")
    x, y = _point(at)
    area: Area = (x - HALF_M, y - HALF_M, x + HALF_M, y + HALF_M)
    network = msgspec.structs.replace(scenario.network, area_m=area)
    demand = msgspec.structs.replace(scenario.demand, focus_m=(x, y))
    units = scenario.agents.roadside
    near = tuple(one for one in units if max(abs(one.xyz_m[0] - x), abs(one.xyz_m[1] - y)) <= HALF_M)
    agents = msgspec.structs.replace(scenario.agents, roadside=near)
    return msgspec.structs.replace(scenario, network=network, demand=demand, agents=agents)


def _point(at: str | tuple[float, float]) -> tuple[float, float]:
    try:
        x, y = map(float, at.split(",") if isinstance(at, str) else at)
        if math.isfinite(x + y):
            return x, y
    except (TypeError, ValueError):
        pass
    raise SettingsError(complaint("generate", "--at", "two numbers X,Y, m", at))
