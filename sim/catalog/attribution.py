"""Attribution of a scenario: owners and terms of the works of others that its drives are made of.

By the source of the network, so that an own scenario on a shipped map has it too, and a drive that is there already.
"""

from sim.roads.wheels import WHEELS
from sim.scenario import NetworkSpec, Scenario

OPENSTREETMAP = "Map data (c) OpenStreetMap contributors, ODbL 1.0, https://www.openstreetmap.org/copyright"
_SUMO = "EPL-2.0 or GPL-2.0-or-later, https://eclipse.dev/sumo"
BODIES = f"Shapes of cars and vans: eclipse-sumo, {_SUMO}"
_HIGHWAY_ENV = (
    "Roads: highway-env (c) 2018 Edouard Leurent, (c) 2023 Farama Foundation, MIT, "
    "https://github.com/Farama-Foundation/HighwayEnv"
)
_AFTER_OPENSTREETMAP = ("game/bs3d/", "game/fkk_in/", "game/DRT/", "game/A10KW/", "game/highway/")
"""Folders of eclipse-sumo whose networks were converted from OpenStreetMap: their edges have its ids."""


def attributions(scenario: Scenario) -> tuple[str, ...]:
    """Return one line per work, the scenario's own `attribution` first; generated roads have no other owner."""
    lines = [scenario.attribution, *_of_network(scenario.network), BODIES]
    return tuple(dict.fromkeys(line for line in lines if line))


def _of_network(network: NetworkSpec) -> list[str]:
    lines = []
    if network.shipped:
        lines.append(f"Roads{' and houses' if network.city_mesh else ''}: eclipse-sumo, {_SUMO}")
    if network.shipped.startswith(_AFTER_OPENSTREETMAP):
        lines.append(OPENSTREETMAP)
    if network.wheel:
        lines.append(WHEELS[network.wheel.partition("/")[0]].notice)
    if network.highway_env:
        lines.append(_HIGHWAY_ENV)
    return lines
