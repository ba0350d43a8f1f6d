"""The twelve encounters in which cooperation decides: each hides a road user from the ego until it is too late.

They follow the pre-crash typology of vehicle-to-vehicle safety (IMA, LTA, EEBL, FCW, BSW/LCW, DNPW: Najm et al.,
*Pre-Crash Scenario Typology for Crash Avoidance Research*, DOT HS 810 767, 2007) and Euro NCAP's obstructed
pedestrian. An instance is drawn from a seed and the number of a draw; `sensors.recording.encounter_check` looks for the first draw of a
seed that keeps its promise.
"""

import zlib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from sim.encounters import crossing, following, turning, walking
from sim.encounters import on_map as mapped
from sim.encounters.lane_paths import streets_of
from sim.encounters.networks import write_roads
from sim.encounters.types import Ghost, Instance, Kind, Parameter, without
from sim.errors import ScenarioError, complaint
from sim.roads.networks import names_network, read_network, resolve_network
from sim.scenario import AgentRule, Scenario

KINDS: dict[str, Kind] = {**crossing.KINDS, **turning.KINDS, **following.KINDS, **walking.KINDS}
for _name, _roles, _on_streets in (
    ("lta_truck", mapped.LTA_ROLES, mapped.lta_truck),
    ("red_light_runner", mapped.RUNNER_ROLES, mapped.red_light_runner),
):
    KINDS[_name] = replace(KINDS[_name], roles=_roles, on_streets=_on_streets)
"""All encounters by their ids."""


def instance_of(scenario: Scenario, seed: int) -> Instance:
    """Return the encounter of a scenario that has one: the same for equal seeds and settings.

    Raises:
        ScenarioError: the scenario has no conflict, or one of its values is out of its range.
    """
    if scenario.conflict is None:
        raise ScenarioError(complaint(scenario.name, "conflict", "one of an encounter", "none"))
    return _made(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=32)
def _made(scenario_json: bytes, seed: int) -> Instance:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    spec = scenario.conflict
    assert spec is not None
    kind = KINDS[spec.kind]
    values = {p.name: _draw(p, spec.parameters.get(p.name, p.draw), seed, spec.draw) for p in kind.parameters}
    looks = np.random.default_rng([seed, spec.draw, zlib.crc32(b"looks")])
    if spec.streets and kind.on_streets is not None:
        net = read_network(resolve_network(scenario, seed))
        layout = kind.on_streets(values, looks, streets_of(scenario.name, net, spec.streets))
    else:
        layout = kind.lay_out(values, looks)
    if spec.control == "no_occluder":
        return Instance(spec.kind, values, without(layout, "occluder"))
    if spec.control == "no_conflict":
        return Instance(spec.kind, values, without(layout, "conflict"))
    if spec.control == "ghost":
        claimed = next(someone for someone in layout.actors if "conflict" in someone.roles)
        helpers = [someone.name for someone in layout.actors if "helper" in someone.roles]
        ghost = Ghost(replace(claimed, name="ghost"), helpers[0] if helpers else "roadside")
        return Instance(spec.kind, values, without(layout, "conflict"), (ghost,))
    return Instance(spec.kind, values, layout)


def _draw(parameter: Parameter, given: float | tuple[float, float], seed: int, draw: int) -> float:
    """Return the value of one parameter; each has a stream of its own, so that fixing one leaves the others."""
    low, high = given if isinstance(given, tuple) else (given, given)
    rng = np.random.default_rng([seed, draw, zlib.crc32(parameter.name.encode())])
    if parameter.whole:
        return float(rng.integers(round(low), round(high) + 1))
    return round(float(rng.uniform(low, high)), 3)


def network_of(scenario: Scenario, seed: int) -> Path:
    """Return the .net.xml(.gz) file of a scenario: the roads that its encounter brings where it names none itself.

    Raises:
        ScenarioError: see `sim.roads.networks.resolve_network`.
    """
    if scenario.conflict is None or names_network(scenario):
        return resolve_network(scenario, seed)
    roads = instance_of(scenario, seed).layout.roads
    if roads is None:
        raise ScenarioError(complaint(scenario.name, "network", "one of shipped, generate, file", "none of them"))
    return write_roads(scenario.name, roads)


def laid_out(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario whose area and agents are those of its encounter; any other as it is.

    Raises:
        ScenarioError: see `instance_of`.
    """
    if scenario.conflict is None:
        return scenario
    instance = instance_of(scenario, seed)
    names = tuple(dict.fromkeys([*instance.names("ego"), *instance.names("helper")]))
    agents: AgentRule = msgspec.structs.replace(
        scenario.agents,
        named=names,
        vehicles=len(names),
        roadside=instance.layout.units or scenario.agents.roadside,
    )
    network = msgspec.structs.replace(scenario.network, area_m=scenario.network.area_m or instance.area)
    return msgspec.structs.replace(scenario, agents=agents, network=network)


__all__ = ["KINDS", "Instance", "instance_of", "laid_out", "network_of"]
