"""Campaigns from a TOML, or from the options of a command line."""

import dataclasses
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from dsrc.closed_loop.campaign.check import check, without_effect
from dsrc.closed_loop.campaign.plan import OF_RADIO, Campaign, PerceptionSpec, with_engine
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.perception.open import (
    ALONE,
    CPMS,
    LATE,
    MODELLED,
    TOGETHER,
    WITHOUT_SENSOR,
    parse_perception,
)
from dsrc.detectors.texts import NO_COMMAND, kind_of
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import RENAMED
from sensors.corruptions import CLEAN
from sim.catalog.load import scenarios_in
from sim.errors import SettingsError, complaint, option
from sim.radio import IDEAL, Radio
from sim.scenario import Scenario
from sim.settings import convert, read_tables, read_toml

_PATIENT, _PATIENT_S = ("anticipating",), 30.0
"""Drivers that may arrive late, and the longest episodes of a plan with one, where it does not say it, s."""
_AS_GIVEN = ("severity", "family", "corrupted_agents", *OF_RADIO, "fault", "defence", "engine", "driver")
"""Options of `dsrc drive` that are fields of a campaign."""


def read_campaign(path: Path) -> Campaign:
    """Read and check the TOML of a campaign; its paths are resolved.

    Raises:
        SettingsError: the file is invalid; one line names the field.
    """
    plan = read_toml(path, Campaign, SettingsError, RENAMED)

    def found(name: str) -> str:
        beside = path.parent / name
        return str(beside if name and beside.exists() else name)

    def found_trace(radio: Radio) -> str:
        preset, _, file = radio.channel.partition(":")
        return dataclasses.replace(radio, channel=f"{preset}:{found(file)}").label

    perceptions = []
    for one in plan.perceptions:
        _, kind, file = parse_perception(one.kind)
        if kind_of(kind) == "pipe":
            raise SettingsError(complaint(path, f"perceptions.{one.name}", NO_COMMAND, kind))
        if file and one.checkpoint:
            field = f"perceptions.{one.name}.checkpoint"
            raise SettingsError(f"{path}: '{one.kind}' names a detector file already; leave out {field}")
        perceptions.append(replace(one, uses=kind, checkpoint=found(file or one.checkpoint)))
    for driver in plan.drivers:
        if kind_of(driver) == "pipe":
            raise SettingsError(complaint(path, "driver", NO_COMMAND, driver))
    listed = [one for name in plan.scenarios for one in _scenarios_of(name, path.parent)]
    files = [name.partition(".toml") for name in listed]
    scenarios = tuple(
        found(name + ending) + variant if ending or (path.parent / name / "scenario.toml").is_file() else name
        for name, ending, variant in files
    )
    radios = [(Radio.parse(name), name) for name in plan.channel]
    channels = tuple(found_trace(radio) if ":" in radio.channel else name for radio, name in radios)
    plan = replace(plan, perceptions=tuple(perceptions), scenarios=scenarios, channel=channels)
    given = read_tables(path, SettingsError)
    given |= {new: given[old] for old, new in RENAMED.items() if old in given}
    plan = _patient(plan, given.get("loop", {}))
    check(plan, str(path))
    for field, expected in without_effect(plan):
        if given.get(field) not in (None, [], [CLEAN], [IDEAL]):
            raise SettingsError(complaint(path, field, expected, f"{given[field]}"))
    return with_engine(plan)


def campaign_of(options: DriveOptions) -> Campaign:
    """Return the campaign of a command line: that of a TOML, or episodes of one scenario.

    Raises:
        SettingsError: invalid settings, or options beside a TOML.
    """
    given = {
        field.name: value
        for field in msgspec.structs.fields(DriveOptions)
        if field.name != "what" and (value := getattr(options, field.name)) != field.default
    }
    if options.what.endswith(".toml") and is_campaign(Path(options.what)):
        if given:
            (field, value), *_ = given.items()
            shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            expected = f"nothing: {options.what} describes the campaign"
            raise SettingsError(complaint("drive", field, expected, shown))
        return read_campaign(Path(options.what))
    checkpoint = str(options.checkpoint or "")
    asked = [parse_perception(text) for text in options.perception or ("truth",)]
    if all(one.kind in WITHOUT_SENSOR for one in asked):
        for field in ("corruption", *OF_RADIO):
            if given.get(field) not in (None, (CLEAN,), (IDEAL,)):
                raise SettingsError(f"drive: perception '{asked[0].name}' has no sensor; leave out {option(field)}")
    for field, numbers, expected, fits in (
        ("severity", options.severity, "1 to 5", range(1, 6)),
        ("seed", options.seed, "0 to 2^63 - 1", range(1 << 63)),
    ):
        for number in numbers:
            if number not in fits:
                raise SettingsError(complaint("drive", field, expected, str(number)))
    if repeated := [seed for seed in options.seed if options.seed.count(seed) > 1]:
        raise SettingsError(complaint("drive", "seed", "numbers that differ", str(repeated[0])))
    takers = [one.name for one in asked if not one.file and one.kind in (ALONE, TOGETHER, LATE, *CPMS, MODELLED)]
    if checkpoint and not takers:
        raise SettingsError(f"drive: perception '{asked[0].name}' takes no detector file; leave out --checkpoint")
    perceptions = tuple(
        PerceptionSpec(name=name, uses=kind, checkpoint=file or (checkpoint if name in takers else ""))
        for name, kind, file in asked
    )
    loop = {name: given[name] for name in LoopSettings.__struct_fields__ if name in given}
    seeds = options.seed or (0,)
    listed: dict[str, Any] = {
        "scenarios": scenarios_in(options.what),
        "name": options.what,
        "corruption": options.corruption or (CLEAN,),
        "clean_seeds": seeds,
        "seeds": seeds,
        "controls": False,
        "careful": False,
        "loop": loop,
        **{name: given[name] for name in _AS_GIVEN if name in given},
    }
    plan = convert({**listed, "perceptions": msgspec.to_builtins(perceptions)}, Campaign, "drive", SettingsError)
    plan = _patient(plan, loop)
    check(plan, "drive")
    for field, expected in without_effect(plan):
        if field in (*OF_RADIO, "engine") and given.get(field) not in (None, (IDEAL,)):
            raise SettingsError(complaint("drive", field, expected, f"{given[field]}"))
    return with_engine(plan)


def is_campaign(path: Path) -> bool:
    """Whether a TOML describes a campaign, not a scenario: it has a key, or nearly one, that no scenario has."""
    own = ("perceptions", "scenarios", "seeds", "clean_seeds", "corruptions", "severities", "corruption", "severity")
    try:
        keys = read_tables(path, SettingsError).keys() - set(Scenario.__struct_fields__)
        return any(get_close_matches(key, own, n=1, cutoff=0.8) for key in keys)
    except SettingsError:
        return False


def _scenarios_of(name: str, folder: Path) -> list[str]:
    """Return the scenarios that a name of a plan in a folder stands for, see `scenarios_in`."""
    found = scenarios_in(str(folder / name))
    return found if found != [str(folder / name)] else scenarios_in(name)


def _patient(plan: Campaign, loop: Mapping[str, Any]) -> Campaign:
    """Return a campaign whose episodes leave room for a slow driver, unless its settings of the loop say how long."""
    if "duration_s" in loop or not set(plan.drivers) & set(_PATIENT):
        return plan
    return replace(plan, loop=replace(plan.loop, duration_s=_PATIENT_S))
