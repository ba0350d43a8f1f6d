"""Consistency checks of a scenario, beyond types and ranges."""

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec

from sim.encounters import KINDS, own
from sim.errors import did_you_mean
from sim.roads.tools import sumo_tools
from sim.roads.wheels import wheel_folders
from sim.scenario import MOTOR_CLASSES, SIGNAL_LETTERS, AgentRule, EncounterSpec, Scenario
from sim.settings import dotted
from sim.traffic.highway.roads import ENVIRONMENTS


def wrong_values(scenario: Scenario, path: Path) -> Iterator[tuple[str, str, object, str]]:
    """Yield (field, expected, found, hint) of every inconsistent value."""
    network, demand = scenario.network, scenario.demand
    for field, value in _floats(msgspec.to_builtins(scenario), ()):
        if not math.isfinite(value):
            yield field, "a finite number", value, ""
    sources = ("shipped", "generate", "file", "wheel", "highway_env")
    given = [name for name in sources if getattr(network, name)]
    if len(given) != 1 and not (scenario.conflict and not given):
        yield "network", f"exactly one of {', '.join(sources)}", ", ".join(given) or "none of them", ""
    if network.area_m and not (network.area_m[0] < network.area_m[2] and network.area_m[1] < network.area_m[3]):
        yield "network.area_m", "x_min < x_max and y_min < y_max", list(network.area_m), ""
    if network.file and not (path.parent / network.file).is_file():
        yield "network.file", "an existing .net.xml file", network.file, ""
    if network.highway_env:
        if network.highway_env not in ENVIRONMENTS:
            hint = did_you_mean(network.highway_env, ENVIRONMENTS)
            yield "network.highway_env", "an environment of highway-env", network.highway_env, hint
    yield from _wrong_tools_path("network.shipped", network.shipped)
    yield from _wrong_tools_path("network.city_mesh", network.city_mesh)
    if not (path.parent / network.polygons).is_file():
        yield from _wrong_tools_path("network.polygons", network.polygons, "beside the scenario or ")
    if network.city_mesh and network.polygons:
        yield "network", "at most one of city_mesh, polygons", "both", ""
    yield from _wrong_member("network.wheel", network.wheel)
    if demand.trips and not (path.parent / demand.trips).is_file() and not demand.trips.startswith(wheel_folders()):
        yield from _wrong_tools_path("demand.trips", demand.trips, "beside the scenario, inside a wheel or ")
    if demand.trips and demand.trips_s[1] - demand.trips_s[0] < scenario.warmup_s + scenario.duration_s:
        expected = f"at least warmup_s + duration_s = {scenario.warmup_s + scenario.duration_s:g} s from begin to end"
        yield "demand.trips_s", expected, list(demand.trips_s), ""
    for index, program in enumerate(network.signals):
        if len({len(state) for _, state in program.phases}) != 1:
            yield f"network.signals[{index}].phases", "states of one length", "different lengths or none", ""
        for _, state in program.phases:
            if not state or set(state) - set(SIGNAL_LETTERS):
                expected = f"states of the letters {SIGNAL_LETTERS}"
                yield f"network.signals[{index}].phases", expected, f"'{state}'", ""
    for name in demand.type_mix:
        if name not in MOTOR_CLASSES:
            yield "demand.type_mix", "classes of motor vehicles", f"'{name}'", did_you_mean(name, MOTOR_CLASSES)
    if demand.vehicles_per_hour > 0 and not demand.trips and sum(demand.type_mix.values()) <= 0:
        yield "demand.type_mix", "a positive weight", dict(demand.type_mix), ""
    if scenario.conflict is not None:
        yield from _wrong_conflict(scenario.conflict, ", ".join(given))
        if scenario.agents.vehicles != AgentRule().vehicles:
            yield "agents.vehicles", "none, as its encounter names them", scenario.agents.vehicles, ""
    for index, unit in enumerate(scenario.agents.roadside):
        if unit.xyz_m[2] <= 0:
            yield f"agents.roadside[{index}].xyz_m", "a height above the ground > 0", list(unit.xyz_m), ""


def _wrong_conflict(conflict: EncounterSpec, given: str) -> Iterator[tuple[str, str, object, str]]:
    if conflict.kind not in KINDS:
        yield "conflict.kind", "a known encounter", conflict.kind, did_you_mean(conflict.kind, KINDS)
        return
    kind = KINDS[conflict.kind]
    is_own = conflict.kind == own.KIND
    if given and not kind.roles:
        mapped = ", ".join(name for name, one in KINDS.items() if one.roles)
        yield "network", f"none for {conflict.kind}; on a map there are {mapped}", given, ""
    elif is_own and not given:
        yield "network", "the map whose lanes conflict.streets names", "none", ""
    elif not is_own and set(conflict.streets) != (set(kind.roles) if given else set()):
        expected = f"the lanes of {', '.join(kind.roles)}" if given else "none without a network"
        yield "conflict.streets", expected, ", ".join(conflict.streets) or "none", ""
    if is_own:
        yield from ((*wrong, "") for wrong in own.wrong_values(conflict))
    elif set_fields := [name for name in ("road_user", "starts", "placed") if getattr(conflict, name)]:
        yield f"conflict.{set_fields[0]}", f"none of {conflict.kind}, which has its own; kind = 'own'", "one", ""
    known = {parameter.name: parameter for parameter in kind.parameters}
    for name in conflict.parameters:
        if name not in known:
            yield "conflict.parameters", f"parameters of {conflict.kind}", f"'{name}'", did_you_mean(name, known)
    given_of = conflict.parameters.items()
    ranges = [(known[name], f"parameters.{name}", value) for name, value in given_of if name in known]
    ranges += [(parameter, parameter.name, value) for parameter, value in own.drawn_of(conflict)]
    for parameter, field, value in ranges:
        low, high = value if isinstance(value, tuple) else (value, value)
        if not parameter.low <= low <= high <= parameter.high:
            expected = f"{parameter.low:g} to {parameter.high:g}, or [low, high] of them"
            yield f"conflict.{field}", expected, list(value) if isinstance(value, tuple) else value, ""
        elif parameter.whole and not (low == round(low) and high == round(high)):
            yield f"conflict.{field}", "whole numbers", list(value) if isinstance(value, tuple) else value, ""


def _wrong_tools_path(field: str, relative: str, elsewhere: str = "") -> Iterator[tuple[str, str, object, str]]:
    if not relative:
        return

    target = sumo_tools() / relative
    if target.is_file() and target.resolve().is_relative_to(sumo_tools().resolve()):
        return
    inside = target.parent.resolve().is_relative_to(sumo_tools().resolve())
    siblings = [str(Path(relative).parent / p.name) for p in target.parent.glob("*.*")] if inside else []
    expected = f"a file {elsewhere}below tools/ of eclipse-sumo"
    yield field, expected, relative, did_you_mean(relative, siblings) if siblings else ""


def _wrong_member(field: str, member: str) -> Iterator[tuple[str, str, object, str]]:
    if member and not member.startswith(wheel_folders()):
        hint = did_you_mean(member.split("/")[0], [folder.split("/")[0] for folder in wheel_folders()])
        yield field, f"a path that begins with {' or '.join(wheel_folders())}", member, hint


def _floats(value: object, where: tuple[str | int, ...]) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield dotted(where), value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _floats(item, (*where, key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _floats(item, (*where, index))
