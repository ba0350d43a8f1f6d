"""Scenario: what a drive is made of, as frozen validated values, and the loader of `scenario.toml` files."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from sim.boxes import CLASSES
from sim.errors import ScenarioError, complaint, did_you_mean
from sim.roads.wheels import wheel_folders
from sim.tomlfile import dotted, read_toml

NonNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]
Area = tuple[float, float, float, float]

ROOT = Path(__file__).resolve().parents[1] / "scenarios"
"""Folder of the shipped scenarios."""

MOTOR_CLASSES = tuple(name for name in CLASSES if name not in ("bicycle", "pedestrian"))

SIGNAL_LETTERS = "rugGyYosO"
"""States of one signal in SUMO: red, red and yellow, green that yields, green, yellow (2), blinking, arrow, off."""


class SignalProgram(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A fixed-time program that replaces the one in the network.

    Attributes:
        junction: id of the traffic light in the network.
        phases: (duration in s, one letter of `SIGNAL_LETTERS` per signal index) in their order.
        offset_s: shift of the cycle, s.
    """

    junction: str
    phases: tuple[tuple[Positive, str], ...]
    offset_s: float = 0.0


class NetworkSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A road network: exactly one of `shipped`, `generate`, `file`, `wheel` or `highway_env`.

    Attributes:
        shipped: path of a .net.xml(.gz) below `tools/` of the eclipse-sumo package.
        generate: netgenerate arguments as a table of option -> value.
        file: path of a .net.xml; relative ones are looked up beside the scenario file.
        wheel: path of a .net.xml, or of a map with what stands beside its roads, inside one of
            `sim.roads.wheels.WHEELS`.
        highway_env: id of an environment of highway-env whose roads these are, one of
            `sim.traffic.highway.roads.ENVIRONMENTS`; nothing of SUMO is needed then.
        city_mesh: path of a 3DS city mesh below `tools/` with its placement, or "".
        polygons: path of a .poly.xml with outlines of buildings, as SUMO's polyconvert writes it, beside the scenario
            file or below `tools/`, or "". Without a city mesh, polygons and a map, houses are made up.
        area_m: (x_min, y_min, x_max, y_max) part of the network that is meshed and may carry agents; left out: all.
        signals: programs that replace those of the network.
        round: build the junctions of a shipped network or a file anew and round the bends of its streets, so that
            nobody turns at once or races through a junction; false takes the network as it is.
        front_gardens: share of the street fronts of a town where a hedge or a fence is made up, 0 to 1.
    """

    shipped: str = ""
    generate: dict[str, str | int | float | bool] = {}
    file: str = ""
    wheel: str = ""
    highway_env: str = ""
    city_mesh: str = ""
    polygons: str = ""
    area_m: Area | None = None
    signals: tuple[SignalProgram, ...] = ()
    round: bool = True
    front_gardens: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


class DemandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Seeded random trips. Rates are insertions per hour over the whole network.

    Attributes:
        vehicles_per_hour: motor vehicles, split into classes by `type_mix`.
        bicycles_per_hour: bicycles, on the lanes that allow them.
        persons_per_hour: pedestrians, on sidewalks and footways.
        through_area: trips touch `network.area_m` and begin and end close around it.
        focus_m: trips prefer to pass near this point, m; left out: the centre of the area.
        max_vehicles: no insertion while this many vehicles are on the road.
        type_mix: class name -> weight.
        trips: path of a .rou.xml(.gz) with recorded vehicles or trips, beside the scenario file, below `tools/` of
            eclipse-sumo or inside a wheel: they drive instead of `vehicles_per_hour`, in bodies of `type_mix`.
        trips_s: from when to when the trips are, s; each seed begins at another time of it.
        parked_per_km: cars and vans that stand parked, per km of kerb where there is room for them.
    """

    vehicles_per_hour: NonNegative = 1200.0
    bicycles_per_hour: NonNegative = 0.0
    persons_per_hour: NonNegative = 0.0
    through_area: bool = True
    focus_m: tuple[float, float] | None = None
    max_vehicles: Annotated[int, Meta(ge=1)] = 150
    type_mix: dict[str, NonNegative] = msgspec.field(
        default_factory=lambda: {"car": 0.72, "van": 0.12, "truck": 0.08, "bus": 0.03, "motorcycle": 0.05}
    )
    trips: str = ""
    trips_s: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    parked_per_km: NonNegative = 0.0


class RoadsideUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A roadside LiDAR: world position (z above local ground), heading and sensor."""

    xyz_m: tuple[float, float, float]
    yaw_deg: Angle = 0.0
    pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    lidar: str = "dair-roadside"


class AgentRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which actors carry a LiDAR.

    Attributes:
        vehicles: how many vehicles are connected.
        lidar: sensor preset of the vehicles.
        mount_xyz_m: where their sensors sit in the body frame, m, from the middle of the footprint on the road; left
            out: the preset's place, lifted clear of tall roofs.
        mount_pitch_deg: tilt of their sensors, positive looks down.
        within_m: those are chosen that spend the most of the drive within this distance of the ego, m.
        named: names of the connected vehicles in the traffic, ego first; left out: `vehicles` of them are drawn.
        roadside: roadside units.
    """

    vehicles: Annotated[int, Meta(ge=0)] = 3
    lidar: str = "opv2v-64"
    mount_xyz_m: tuple[float, float, float] | None = None
    mount_pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    within_m: Positive = 60.0
    named: tuple[str, ...] = ()
    roadside: tuple[RoadsideUnit, ...] = ()


CONTROLS = ("no_occluder", "no_conflict", "ghost")
"""Changes of a conflict that show what it was good for, see `ConflictSpec`."""


class ConflictSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A scripted encounter in which the ego cannot see in time what it would collide with; see `sim.encounters`.

    Attributes:
        kind: which encounter, one of `sim.encounters.KINDS`.
        parameters: name -> a value, or [low, high] of what is drawn; the others are drawn from ranges of their own.
        streets: on a network that the scenario names: role -> the lanes of its way before and after the junction.
        control: what is changed to see what it was good for: nothing, or the occluder is away (`no_occluder`), the
            conflict actor is away (`no_conflict`), or it is away and a helper claims it all the same (`ghost`).
        draw: number of the draw of the parameters; the proof by rays advances it, see `sensors.recording.encounter_check`.
        draws: most draws that are tried.
    """

    kind: str
    parameters: dict[str, float | tuple[float, float]] = {}
    streets: dict[str, tuple[str, ...]] = {}
    control: Literal["", "no_occluder", "no_conflict", "ghost"] = ""
    draw: Annotated[int, Meta(ge=0)] = 0
    draws: Annotated[int, Meta(ge=1)] = 40


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One scenario file; times in s. A conflict brings its own roads and actors, others have a network and a demand.

    `attribution` says whose data the place is made of, where their terms ask for it.
    """

    name: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")]
    description: str
    network: NetworkSpec = msgspec.field(default_factory=NetworkSpec)
    demand: DemandSpec = msgspec.field(default_factory=DemandSpec)
    agents: AgentRule
    conflict: ConflictSpec | None = None
    warmup_s: NonNegative = 60.0
    duration_s: Positive = 60.0
    step_s: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    attribution: str = ""


def list_scenarios() -> list[str]:
    """Return the names of the shipped scenarios."""
    return sorted(path.parent.name for path in ROOT.glob("*/scenario.toml"))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a shipped scenario by name, or any scenario by the path of its .toml (or of the folder that holds it).

    A control of a conflict is asked for as `NAME:CONTROL`, such as `ima_building:no_occluder`.

    Raises:
        ScenarioError: the scenario is unknown, or its file is not valid; one line says what and where.
    """
    if isinstance(name_or_path, str) and ":" in name_or_path and not Path(name_or_path).exists():
        return _controlled(name_or_path)
    path = _locate(name_or_path)
    scenario = read_toml(path, Scenario, ScenarioError)
    for field, expected, found, hint in _wrong_values(scenario, path):
        raise ScenarioError(complaint(path, field, expected, found, hint))
    network = _beside(scenario.network, ("file", "polygons"), path.parent)
    return msgspec.structs.replace(scenario, network=network, demand=_beside(scenario.demand, ("trips",), path.parent))


def _controlled(name: str) -> Scenario:
    """Return the control NAME:CONTROL of a scenario with a conflict, under a name of its own.

    Raises:
        ScenarioError: there is no such scenario or control.
    """
    base, _, control = name.rpartition(":")
    scenario = load_scenario(base)
    if scenario.conflict is None:
        raise ScenarioError(complaint(name, "scenario", "a control of a conflict", f"'{base}', which has none"))
    if control not in CONTROLS:
        raise ScenarioError(
            complaint(name, "control", "a known control", f"'{control}'", did_you_mean(control, CONTROLS))
        )
    conflict = msgspec.structs.replace(scenario.conflict, control=control)
    return msgspec.structs.replace(scenario, name=f"{scenario.name}-{control}", conflict=conflict)


def _beside(table: Any, names: tuple[str, ...], folder: Path) -> Any:
    """Replace the names of files that lie beside the scenario file by their full paths."""
    named = {name: getattr(table, name) for name in names}
    found = {name: str((folder / value).resolve()) for name, value in named.items() if (folder / value).is_file()}
    return msgspec.structs.replace(table, **found)


def _locate(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.is_dir() and (path / "scenario.toml").is_file():
        return path / "scenario.toml"
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise ScenarioError(complaint(path, "scenario", "an existing .toml file", "no such file"))
        return path
    shipped = ROOT / str(name_or_path) / "scenario.toml"
    if str(name_or_path) in ("", ".", "..") or not shipped.is_file():
        hint = did_you_mean(str(name_or_path), list_scenarios())
        raise ScenarioError(f"unknown scenario '{name_or_path}'{hint}")
    return shipped


def _wrong_values(scenario: Scenario, path: Path) -> Iterator[tuple[str, str, object, str]]:
    """Yield (field, expected, found, hint) for values that types and ranges cannot exclude."""
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
        from sim.traffic.highway.roads import ENVIRONMENTS

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
    if demand.vehicles_per_hour > 0 and sum(demand.type_mix.values()) <= 0:
        yield "demand.type_mix", "a positive weight", dict(demand.type_mix), ""
    if scenario.conflict is not None:
        yield from _wrong_conflict(scenario.conflict, ", ".join(given))
    for index, unit in enumerate(scenario.agents.roadside):
        if unit.xyz_m[2] <= 0:
            yield f"agents.roadside[{index}].xyz_m", "a height above the ground > 0", list(unit.xyz_m), ""


def _wrong_conflict(conflict: ConflictSpec, given: str) -> Iterator[tuple[str, str, object, str]]:
    from sim.encounters import KINDS

    if conflict.kind not in KINDS:
        yield "conflict.kind", "a known encounter", conflict.kind, did_you_mean(conflict.kind, KINDS)
        return
    roles = KINDS[conflict.kind].roles
    if given and not roles:
        mapped = ", ".join(name for name, kind in KINDS.items() if kind.roles)
        yield "network", f"none for {conflict.kind}; on a map there are {mapped}", given, ""
    elif set(conflict.streets) != (set(roles) if given else set()):
        expected = f"the lanes of {', '.join(roles)}" if given else "none without a network"
        yield "conflict.streets", expected, ", ".join(conflict.streets) or "none", ""
    known = {parameter.name: parameter for parameter in KINDS[conflict.kind].parameters}
    for name, value in conflict.parameters.items():
        field = f"conflict.parameters.{name}"
        if name not in known:
            yield "conflict.parameters", f"parameters of {conflict.kind}", f"'{name}'", did_you_mean(name, known)
            continue
        low, high = value if isinstance(value, tuple) else (value, value)
        parameter = known[name]
        if not parameter.low <= low <= high <= parameter.high:
            expected = f"{parameter.low:g} to {parameter.high:g}, or [low, high] of them"
            yield field, expected, list(value) if isinstance(value, tuple) else value, ""
        elif parameter.whole and not (low == round(low) and high == round(high)):
            yield field, "whole numbers", list(value) if isinstance(value, tuple) else value, ""


def _wrong_tools_path(field: str, relative: str, elsewhere: str = "") -> Iterator[tuple[str, str, object, str]]:
    if not relative:
        return
    from sim.roads.tools import sumo_tools

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
