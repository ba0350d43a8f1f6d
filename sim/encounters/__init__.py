"""Encounters: twelve safety-critical situations with a road user occluded from the ego.

They follow the pre-crash typology of vehicle-to-vehicle safety (IMA, LTA, EEBL, FCW, BSW/LCW, DNPW: Najm et al.,
*Pre-Crash Scenario Typology for Crash Avoidance Research*, DOT HS 810 767, 2007) and Euro NCAP's obstructed
pedestrian. An encounter is drawn from a seed and a draw number; `sensors.recording.encounter_check` finds the first
draw of a seed whose occlusion is verified by ray casting.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import msgspec

from sim.encounters import crossing, following, on_map, own, turning, walking
from sim.encounters.background import with_background
from sim.encounters.lane_paths import lane_paths_of
from sim.encounters.networks import write_roads
from sim.encounters.types import Encounter, EncounterType, Ghost, Parameter, without
from sim.errors import ScenarioError, complaint
from sim.roads.networks import names_network, read_network, resolve_network
from sim.scenario import AgentRule, Scenario
from sim.streams import Stream, random_generator

ENCOUNTERS: dict[str, EncounterType] = {
    **crossing.ENCOUNTERS,
    **turning.ENCOUNTERS,
    **following.ENCOUNTERS,
    **walking.ENCOUNTERS,
}
for _name, _roles, _on_streets in (
    ("lta_truck", on_map.LTA_ROLES, on_map.lta_truck),
    ("red_light_runner", on_map.RUNNER_ROLES, on_map.red_light_runner),
):
    ENCOUNTERS[_name] = replace(ENCOUNTERS[_name], roles=_roles, on_streets=_on_streets)
"""Encounter types by id: those that ship."""
KINDS = {**ENCOUNTERS, own.KIND: own.OWN}
"""Encounter types by id, with the one that a scenario describes itself."""


def encounter_of(scenario: Scenario, seed: int) -> Encounter:
    """Return the encounter of a scenario, a function of seed and settings.

    Raises:
        ScenarioError: the scenario has no encounter, or a value is out of its range.
    """
    if scenario.conflict is None:
        raise ScenarioError(complaint(scenario.name, "conflict", "one of an encounter", "none"))
    return _made(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=32)
def _made(scenario_json: bytes, seed: int) -> Encounter:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    spec = scenario.conflict
    assert spec is not None
    kind = KINDS[spec.kind]
    values = {p.name: _draw(p, spec.parameters.get(p.name, p.draw), seed, spec.draw) for p in kind.parameters}
    values |= {p.name: _draw(p, given, seed, spec.draw) for p, given in own.drawn_of(spec)}
    appearance = random_generator(seed, Stream.ENCOUNTER_LAYOUT, spec.draw, "looks")
    if kind.lay_out is None or (spec.streets and kind.on_streets is not None):
        net = read_network(resolve_network(scenario, seed))
        streets = lane_paths_of(scenario.name, net, spec.streets)
        if kind.on_streets is not None:
            layout = kind.on_streets(values, appearance, streets)
        else:
            layout = own.lay_out(values, appearance, streets, spec, net, scenario.name)
    else:
        layout = kind.lay_out(values, appearance)
    if spec.traffic is not msgspec.UNSET and spec.traffic != "none":
        roads = write_roads(scenario.name, layout.roads) if layout.roads else resolve_network(scenario, seed)
        rng = random_generator(seed, Stream.ENCOUNTER_TRAFFIC, spec.draw)
        layout = with_background(layout, spec.traffic, read_network(roads), rng)
    if spec.control == "no_occluder":
        return Encounter(spec.kind, values, without(layout, "occluder"))
    if spec.control == "no_conflict":
        return Encounter(spec.kind, values, without(layout, "conflict"))
    if spec.control == "ghost":
        claimed = next(someone for someone in layout.actors if "conflict" in someone.roles)
        helpers = [someone.name for someone in layout.actors if "helper" in someone.roles]
        ghost = Ghost(replace(claimed, name="ghost"), helpers[0] if helpers else "roadside")
        return Encounter(spec.kind, values, without(layout, "conflict"), (ghost,))
    return Encounter(spec.kind, values, layout)


def _draw(parameter: Parameter, given: float | tuple[float, float], seed: int, draw: int) -> float:
    """Return the value of one parameter, from its own random stream: fixing one leaves the others unchanged."""
    low, high = given if isinstance(given, tuple) else (given, given)
    rng = random_generator(seed, Stream.ENCOUNTER_PARAMETER, draw, parameter.name)
    if parameter.whole:
        return float(rng.integers(round(low), round(high) + 1))
    return round(float(rng.uniform(low, high)), 3)


def network_file(scenario: Scenario, seed: int) -> Path:
    """Return the .net.xml(.gz) file of a scenario: its own network, else the roads of its encounter.

    Raises:
        ScenarioError: see `sim.roads.networks.resolve_network`.
    """
    if scenario.conflict is None or names_network(scenario):
        return resolve_network(scenario, seed)
    roads = encounter_of(scenario, seed).layout.roads
    if roads is None:
        raise ScenarioError(complaint(scenario.name, "network", "one of shipped, generate, file", "none of them"))
    return write_roads(scenario.name, roads)


def with_encounter(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario with the area and agents of its encounter; unchanged without an encounter.

    Raises:
        ScenarioError: see `encounter_of`.
    """
    if scenario.conflict is None:
        return scenario
    instance = encounter_of(scenario, seed)
    names = tuple(dict.fromkeys([*instance.names("ego"), *instance.names("helper")]))
    agents: AgentRule = msgspec.structs.replace(
        scenario.agents,
        named=names,
        vehicles=len(names),
        roadside=instance.layout.units or scenario.agents.roadside,
    )
    network = msgspec.structs.replace(scenario.network, area_m=scenario.network.area_m or instance.area)
    return msgspec.structs.replace(scenario, agents=agents, network=network)


__all__ = ["ENCOUNTERS", "KINDS", "Encounter", "encounter_of", "with_encounter", "network_file"]
