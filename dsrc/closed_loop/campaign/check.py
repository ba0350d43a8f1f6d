"""Checks of a campaign before anything is driven: what is wrong in it, or would act on nothing."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path

from dsrc.closed_loop.campaign.jobs import acts_on
from dsrc.closed_loop.campaign.plan import OF_RADIO, Campaign
from dsrc.closed_loop.driving.open import open_driver
from dsrc.closed_loop.encounter import encounter_agents
from dsrc.closed_loop.perception.open import (
    MODELLED,
    TELLING,
    WHO_IS_LIED_TO,
    WHO_TELLS,
    WITHOUT_SENSOR,
    open_perception,
)
from dsrc.detectors.texts import kind_of
from dsrc.faults.condition import settled
from dsrc.faults.fault import Faults, fault_parts, faults_text, parse_faults
from dsrc.faults.kinds import REPLAY
from dsrc.messages.defences import parse_defence
from dsrc.options.told import NO_DEFENCE
from sensors.corruptions import conditions_of
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario
from sim.errors import SettingsError, complaint
from sim.radio import get_channel


def check(plan: Campaign, where: str) -> None:
    """Raise UserError for repeated names, unknown scenarios, corruptions and channels, or missing detector files."""
    for field, names in (
        ("scenarios", list(plan.scenarios)),
        ("perceptions", [one.name for one in plan.perceptions]),
        ("corruption", list(plan.corruption)),
        ("severity", list(map(str, plan.severity))),
        ("channel", list(plan.channel)),
        ("clean_seeds", [] if isinstance(plan.clean_seeds, int) else list(map(str, plan.clean_seeds))),
        ("seeds", [] if isinstance(plan.seeds, int) else list(map(str, plan.seeds))),
    ):
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise SettingsError(complaint(where, field, "names that differ", repeated[0]))
    for one in plan.perceptions:
        if not one.name.strip() or set("|\n") & set(one.name):
            expected = "a name, without | and line ends"
            raise SettingsError(complaint(where, "perceptions.name", expected, f"'{one.name}'"))
    conditions_of(plan.corruption, plan.severity, (plan.family,), plan.corrupted_agents, where)
    _check_faults(plan, where)
    _check_defences(plan, where)
    _check_agents(plan, where)
    if plan.loop.look_ahead_s and not any(one.has_detector for one in plan.perceptions):
        expected = f"0 with perception '{plan.perceptions[0].name}', which has no detector whose range could be shifted"
        raise SettingsError(complaint(where, "look_ahead_s", expected, f"{plan.loop.look_ahead_s:g}"))
    for scenario in plan.scenarios:
        load_scenario(scenario)
    for channel in plan.radios:
        try:
            get_channel(channel)
        except SettingsError as error:
            raise SettingsError(f"{where}: {error}") from None
    for driver in plan.drivers:
        if kind_of(driver) not in ("pipe", "tcp"):  # whose names are asked for later
            try:
                open_driver(driver)
            except SettingsError as error:
                raise SettingsError(f"{where}: {error}") from None
    for one in plan.perceptions:
        if one.kind in WITHOUT_SENSOR and one.checkpoint:
            expected = f"none with '{one.kind}' (no detector)"
            raise SettingsError(complaint(where, f"perceptions.{one.name}.checkpoint", expected, one.checkpoint))
        if one.checkpoint and not Path(one.checkpoint).is_file():
            raise SettingsError(complaint(where, f"perceptions.{one.name}.checkpoint", "a file", one.checkpoint))
        if one.kind == MODELLED:
            for condition, channel, faults in (each for name in plan.radios for each in plan.disturbed(name)):
                open_perception(
                    MODELLED,
                    checkpoint=Path(one.checkpoint) if one.checkpoint else None,
                    corruption=condition,
                    channel=channel,
                    fault=faults,
                )


def without_effect(plan: Campaign) -> Iterator[tuple[str, str]]:
    """Yield the fields that would change no episode of a plan, with what is expected of each."""
    no_sensor = all(one.kind in WITHOUT_SENSOR for one in plan.perceptions)
    if no_sensor or len(plan.conditions) == 1:
        for field in (*(() if plan.fault else ("seeds",)), "severity", "family", "corrupted_agents"):
            yield field, f"none, since no episode is corrupted{': clean_seeds' if field == 'seeds' else ''}"
    if no_sensor:
        yield "corruption", "none, since no perception has a sensor"
    if not any(one.has_detector for one in plan.perceptions):
        yield "engine", "none, since no perception has a detector"
    if not any(one.has_helpers for one in plan.perceptions):
        for field in OF_RADIO:
            yield field, "none, since no perception has helpers"


def _check_faults(plan: Campaign, where: str) -> None:
    """Raise SettingsError for a wrong fault, one that is there twice, or one that acts on no perception or never."""
    found = [faults_text(parse_faults(text, where)) for text in plan.fault]
    if repeated := [text for text in found if found.count(text) > 1]:
        raise SettingsError(complaint(where, "fault", "texts that differ", repeated[0]))

    for part in (part for text in plan.fault for part in fault_parts(text)):
        (fault,) = parse_faults(part, where)
        if fault.from_s >= plan.loop.duration_s:
            expected = f"a begin before the end of the longest episode, {plan.loop.duration_s:g} s"
            raise SettingsError(complaint(where, f"fault '{part}'", expected, f"{fault.from_s:g} s"))

    def acts(faults: Faults) -> bool:
        each = settled(faults, plan.radios[0])
        return any(acts_on(each, plan.radios, one, one.has_helpers) for one in plan.perceptions)

    for text in found:
        faults = parse_faults(text, where)
        if not acts(faults):
            names = ", ".join(one.name for one in plan.perceptions)
            idle = next((f"'{fault.text}'" for fault in faults if not acts((fault,))), "all of it")
            expected = f"a perception that {idle} acts on, such as team"
            if attacks := [one for one in faults if one.attack]:
                replayed = any(one.kind == REPLAY for one in attacks)
                expected = WHO_TELLS if replayed else WHO_IS_LIED_TO
            raise SettingsError(complaint(where, f"fault '{text}'", expected, names))
    driven = [each for channel in plan.radios for each in plan.disturbed(channel)]
    for each in driven:
        if driven.count(each) > 1:
            expected = "a fault that no corruption, channel or other fault is already"
            raise SettingsError(complaint(where, "fault", expected, f"{each.condition.label}, {each.channel}"))


def _check_defences(plan: Campaign, where: str) -> None:
    """Raise SettingsError for a wrong defence, one that is there twice, or one of a perception without messages."""
    found = [",".join(parse_defence(text, where)) or NO_DEFENCE for text in plan.defence]
    if repeated := [text for text in found if found.count(text) > 1]:
        raise SettingsError(complaint(where, "defence", "texts that differ", repeated[0]))
    if set(found) - {NO_DEFENCE} and not any(one.kind in TELLING for one in plan.perceptions):
        names = ", ".join(one.name for one in plan.perceptions)
        raise SettingsError(complaint(where, f"defence '{plan.defence[0]}'", WHO_TELLS, names))


def _check_agents(plan: Campaign, where: str) -> None:
    """Raise SettingsError for an id of a fault or corruption that is an agent in no episode.

    Only the agents of encounters are known before the traffic runs.
    """
    asked = {"corrupted_agents": plan.conditions[-1].agents} if len(plan.conditions) > 1 else {}
    parts = [part for text in plan.fault for part in fault_parts(text)]
    asked |= {f"fault '{part}'": one.agents for part in parts for one in parse_faults(part, where)}
    named = [(field, one) for field, agents in asked.items() if not isinstance(agents, str) for one in agents]
    agents: set[int] = set()
    for name, seed in product(plan.scenarios, plan.all_seeds):
        if not named or (scenario := load_scenario(name)).conflict is None:
            return
        agents |= set(encounter_agents(with_proven_encounter(scenario, seed), seed))
        named = [(field, one) for field, one in named if one not in agents]
    for field, unknown in named:
        listed = ", ".join(map(str, sorted(agents, key=lambda one: (one < 0, abs(one)))))
        raise SettingsError(complaint(where, field, f"ids among the agents {listed}", unknown))
