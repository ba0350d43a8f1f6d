"""Ground of a scenario: its streets on the terrain of its world, for what is built on it and for who moves on it."""

from dataclasses import replace
from functools import lru_cache

import msgspec
import shapely

from sim.encounters import network_file, with_encounter
from sim.roads.networks import read_network
from sim.scenario import AgentRule, RoadsideUnit, Scenario
from sim.traffic.parking import parked_cars
from sim.world.highway import highway_streets
from sim.world.roads.kerbs import kerbs_of, stones
from sim.world.roads.landscape import uneven_land
from sim.world.roads.streets import Streets, read_streets
from sim.world.roads.surfaces import pavement
from sim.world.roads.swept import swept_axes, with_islands, with_swept

MARGIN_M = 120.0
"""Margin of the world beyond `network.area_m`, m: the range of a sensor."""

_KEPT = 2
"""Uneven grounds kept in memory."""


def streets_of(scenario: Scenario, seed: int) -> Streets:
    """Return the streets of a scenario on their ground; scenarios that differ in sensors alone share it if uneven.

    Args:
        seed: root seed of parked cars and of the relief.

    Raises:
        ScenarioError: the network is missing or cannot be read.
    """
    if not scenario.uneven:
        return _level(scenario, seed)
    whole = with_encounter(scenario, seed)
    units = tuple(RoadsideUnit(xyz_m=unit.xyz_m) for unit in whole.agents.roadside)  # no car parks where one stands
    return _uneven(msgspec.json.encode(msgspec.structs.replace(whole, agents=AgentRule(roadside=units))), seed)


@lru_cache(maxsize=_KEPT)
def _uneven(scenario_json: bytes, seed: int) -> Streets:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    streets = _level(scenario, seed)
    if scenario.conflict is None:  # road users of an encounter may leave their lanes
        axes = swept_axes(streets)
        streets = with_islands(with_swept(streets, axes), axes)
    paved = pavement(streets)
    kerbs = kerbs_of(streets, paved, seed)
    terrain, land = uneven_land(streets, paved, kerbs, seed)
    shapely.prepare(streets.road)
    return replace(streets, terrain=terrain, land=land, kerbs=stones(streets, kerbs))


def _level(scenario: Scenario, seed: int) -> Streets:
    if scenario.network.highway_env:
        from sim.traffic.highway.roads import read_roads

        return highway_streets(read_roads(scenario.network.highway_env), scenario.network.area_m)
    net = read_network(network_file(scenario, seed))
    return read_streets(net, scenario.network.area_m, MARGIN_M, parked_cars(scenario, net, seed).bays)
