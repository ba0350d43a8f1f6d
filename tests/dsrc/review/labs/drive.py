"""A simulated drive of two frames with the smallest sensor."""

from pathlib import Path

import msgspec

from dsrc.data.write import generate
from sim.catalog.load import load_scenario


def small_drive(folder: Path) -> Path:
    """Generate the drive below a folder; two vehicles and the roadside unit of a made junction."""
    scenario = load_scenario("four_way")
    units = tuple(msgspec.structs.replace(unit, lidar="debug-16") for unit in scenario.agents.roadside)
    agents = msgspec.structs.replace(scenario.agents, vehicles=2, lidar="debug-16", roadside=units)
    return generate(msgspec.structs.replace(scenario, agents=agents, warmup_s=30.0), folder, 2, seed=5)
