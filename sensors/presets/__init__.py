"""The named LiDARs and where their numbers come from, by maker."""

from sensors.presets import datasets, hesai, livox, ouster, robosense, velodyne
from sensors.spec import LidarSpec
from sim.errors import ScenarioError, SettingsError, complaint, did_you_mean
from sim.scenario import Scenario

__all__ = ["LIDARS", "get_lidar", "scenario_lidars"]

LIDARS: dict[str, LidarSpec] = {
    spec.name: spec for maker in (datasets, velodyne, hesai, ouster, robosense, livox) for spec in maker.SPECS
}
"""The shipped presets by name."""


def get_lidar(name: str) -> LidarSpec:
    """Return the preset of this name; SettingsError when there is none."""
    if name not in LIDARS:
        raise SettingsError(f"unknown lidar '{name}'{did_you_mean(name, LIDARS)}")
    return LIDARS[name]


def scenario_lidars(scenario: Scenario) -> tuple[LidarSpec, tuple[LidarSpec, ...]]:
    """Return the sensor of the vehicles and those of the roadside units of a scenario.

    Raises:
        ScenarioError: a name is that of no preset.
    """
    rule = scenario.agents
    names = {"agents.lidar": rule.lidar}
    names |= {f"agents.roadside[{index}].lidar": unit.lidar for index, unit in enumerate(rule.roadside)}
    for field, name in names.items():
        if name not in LIDARS:
            raise ScenarioError(complaint(scenario.name, field, "a LiDAR preset", name, did_you_mean(name, LIDARS)))
    first, *others = (LIDARS[name] for name in names.values())
    return first, tuple(others)
