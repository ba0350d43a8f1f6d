"""One seed of a scenario as files of ASAM's standards: trajectories in an .xosc, roads in an .xodr beside it."""

import re
from pathlib import Path

from sim.encounters import network_file
from sim.exchange.openscenario import xosc_of
from sim.files import replacing, write_file
from sim.roads.tools import Option, drop_header, run_tool
from sim.scenario import Scenario
from sim.traffic.open import open_traffic

_DATE = re.compile(r'date="[^"]*"')
_MADE = 'date="1970-01-01T00:00:00" vendor="dsrc-testbed"'


def export(scenario: Scenario, seed: int, out: Path) -> list[Path]:
    """Simulate a seed's traffic over `duration_s` and write it; the same seed writes the same bytes.

    Houses and other static things are not exported, nor is the ground of worlds of version 2: roads have the heights of
    their network. Standing vehicles that hide others are.

    Args:
        out: folder, which gets `NAME_SEED.xosc` and `NAME_SEED.xodr`.

    Returns:
        Both files.

    Raises:
        ScenarioError: network, demand or encounter is invalid, or the roads are no SUMO network.
        TrafficError: the traffic cannot run.
    """
    roads, story = (out / f"{scenario.name}_{seed}.{ending}" for ending in ("xodr", "xosc"))
    network = network_file(scenario, seed)
    with open_traffic(scenario, seed) as traffic:
        steps = [traffic.actors]
        for _ in range(round(scenario.duration_s / traffic.step_s)):
            steps.append(traffic.step())
    with replacing(roads) as temporary:
        options: dict[str, Option] = {
            "sumo-net-file": str(network),
            "opendrive-output": str(temporary),
            "no-warnings": True,
        }
        run_tool("netconvert", options, temporary, scenario.name)
        drop_header(temporary)
        text = temporary.read_text(encoding="utf-8")
        temporary.write_text(_DATE.sub(_MADE, text, count=1), encoding="utf-8")
    write_file(story, xosc_of(scenario.name, scenario.description, steps, roads.name))
    return [story, roads]
