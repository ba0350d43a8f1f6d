"""LiDAR presets by name: those of makers and datasets, and registered ones.

A sensor of another package is an entry point of the group `dsrc.sensors` that names a `LidarSpec`,

    [project.entry-points."dsrc.sensors"]
    my-lidar = "my_package.lidars:MY_LIDAR"

and is found by every command and worker process.
"""

from sensors.presets import datasets, hesai, livox, ouster, robosense, velodyne
from sensors.spec import LidarSpec
from sim.catalog.registry import Registry, instance_of
from sim.errors import ScenarioError, SettingsError, complaint, did_you_mean
from sim.scenario import Scenario

__all__ = ["LIDARS", "get_lidar", "register_sensor", "scenario_lidars"]


LIDARS: Registry[LidarSpec] = Registry(
    "dsrc.sensors",
    {spec.name: spec for maker in (datasets, velodyne, hesai, ouster, robosense, livox) for spec in maker.SPECS},
    instance_of(LidarSpec),
)
"""LiDAR presets by name, shipped and registered."""


def register_sensor(spec: LidarSpec) -> None:
    """Add a LiDAR, which scenarios and commands then take by its name, in this process.

    Worker processes find it by an entry point of the group `dsrc.sensors`. `sensors.presets.check.check_sensor` tests
    it.

    Raises:
        SettingsError: the name is empty or that of another LiDAR.
    """
    if not spec.name:
        raise SettingsError(complaint("register_sensor", "name", "at least one letter", "''"))
    LIDARS.register(spec.name, spec)


def get_lidar(name: str) -> LidarSpec:
    """Return the preset of this name; SettingsError when unknown."""
    if name not in LIDARS:
        raise SettingsError(f"unknown lidar '{name}'{did_you_mean(name, LIDARS)}")
    return LIDARS[name]


def scenario_lidars(scenario: Scenario) -> tuple[LidarSpec, tuple[LidarSpec, ...]]:
    """Return the sensor of the vehicles and those of the roadside units of a scenario.

    Raises:
        ScenarioError: unknown preset.
    """
    rule = scenario.agents
    names = {"agents.lidar": rule.lidar}
    names |= {f"agents.roadside[{index}].lidar": unit.lidar for index, unit in enumerate(rule.roadside)}
    for field, name in names.items():
        if name not in LIDARS:
            raise ScenarioError(complaint(scenario.name, field, "a LiDAR preset", name, did_you_mean(name, LIDARS)))
    first, *others = (LIDARS[name] for name in names.values())
    return first, tuple(others)
