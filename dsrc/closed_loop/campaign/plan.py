"""Settings of a campaign, a TOML: scenarios x perceptions x corruptions x severities x channels x seeds.

    name = "which corruption kills"
    scenarios = ["ima_building", "ped_dartout"]
    corruption = ["paper_six"]        # clean episodes are always driven
    severity = [3]
    channel = ["ideal"]
    clean_seeds = 20                  # episodes of a cell of the tables, the same seeds for everybody
    seeds = 10

    [[perceptions]]
    name = "truth"

    [[perceptions]]
    name = "ego alone"
    uses = "ego"
    checkpoint = "runs/dsrc_s0/student/detector.pt"

Paths are relative to the file, or else to the current folder.
"""

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from dsrc.closed_loop.campaign.episode import EpisodeJob
from dsrc.closed_loop.driving.open import driver_sha256, open_driver
from dsrc.closed_loop.encounter import encounter_agents
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.perception.error_model.model import read_model
from dsrc.closed_loop.perception.open import (
    ALONE,
    CPMS,
    LATE,
    MODELLED,
    TELLING,
    TOGETHER,
    WHO_IS_LIED_TO,
    WHO_TELLS,
    WITHOUT_SENSOR,
    hears,
    open_perception,
    parse_perception,
)
from dsrc.closed_loop.perception.senses import sensed_every_s
from dsrc.detectors.classes import source_hash
from dsrc.detectors.texts import NO_COMMAND, SHIPPED_DETECTOR, kind_of
from dsrc.faults.condition import Disturbance, settled
from dsrc.faults.fault import Faults, fault_parts, faults_text, parse_faults
from dsrc.faults.kinds import REPLAY
from dsrc.messages.defences import Defence, parse_defence
from dsrc.options.detection import AutoEngine
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import RENAMED, changed_radios
from dsrc.options.told import NO_DEFENCE
from sensors.corruptions import CLEAN, EVERYONE, PAPER_TABLE, Condition, Family, conditions_of
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario, scenarios_in
from sim.encounters import ENCOUNTERS
from sim.errors import SettingsError, complaint, option
from sim.files import file_sha256
from sim.kept.code_hash import code_hash, package_versions
from sim.radio import IDEAL, Radio, get_channel
from sim.scenario import Scenario
from sim.settings import convert, read_tables, read_toml

LOG = logging.getLogger(__name__)
CONTROLS = ("no_occluder", "no_conflict")
COMPUTED_BY = "dsrc.closed_loop.campaign.episode"
"""Module whose sources and imports are hashed into the keys of episodes."""

_OF_RADIO = ("channel", "loss", "delay_s", "pose_error")
_IDEAL_RADIO: dict[str, Any] = {"channel": (IDEAL,), "loss": None, "delay_s": None, "pose_error": None}
_PATIENT, _PATIENT_S = ("anticipating",), 30.0
"""Drivers that may arrive late, and the longest episodes of a plan with one, where it does not say it, s."""
_AS_GIVEN = ("severity", "family", "corrupted_agents", *_OF_RADIO, "fault", "defence", "engine", "driver")
"""Options of `dsrc drive` that are fields of a campaign."""

Seeds = Annotated[int, Meta(ge=1)] | Annotated[tuple[Annotated[int, Meta(ge=0)], ...], Meta(min_length=1)]
_Names = Annotated[tuple[str, ...], Meta(min_length=1)]


class PerceptionSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Perception of a campaign, a line of its tables.

    Attributes:
        name: in tables.
        uses: `truth`, `sight` (truth in the ego's line of sight), `team-sight` (in any agent's), `ego` (detector
            without helpers), `team` (detector with helpers), `late` (their detections joined), `model` (errors of a
            detector, from the JSON of `dsrc model fit`), or `module:Class` of one's own; "": the name.
        checkpoint: detector file, or the JSON of `model`; "": the shipped detector.
        driver: of these episodes, as that of the campaign; "": that one.
    """

    name: str
    uses: str = ""
    checkpoint: str = ""
    driver: str = ""

    @property
    def kind(self) -> str:
        """What it uses."""
        return self.uses or self.name


class Campaign(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a campaign.

    Attributes:
        scenarios: names or paths.
        perceptions: lines of the tables, in their order.
        name: of the campaign.
        corruption: kinds, `paper_six`, `all` or `clean`; clean episodes are always driven.
        severity: of each corruption, 1 to 5.
        family: of the corruptions' settings.
        corrupted_agents: agents whose sensors are corrupted: `ego`, `helpers`, `all`, or ids such as `1002,-1`.
        channel: radio channels of perceptions with helpers.
        loss: share of packets lost, in place of the channels' own.
        delay_s: delay of messages, s, likewise.
        pose_error: pose error of the helpers, m and deg, likewise.
        fault: faults, each text a row of the tables, see `dsrc.faults.fault`: `fog:3 from 4 s on helpers + loss:0.3`.
        defence: defences against helpers that lie, each text in episodes of its own: names between commas, or `none`;
            perceptions whose helpers tell no boxes are driven without. See `dsrc.messages.defences`.
        clean_seeds: seeds of each scenario and perception without a corruption: a number of them, from 0, or a list.
        seeds: those of each scenario, perception, corruption, severity or fault, and channel; the same for all.
        engine: execution of the networks, see `dsrc.models.storage.deploy.ENGINES`; `auto` becomes the fastest that
            serves all detectors of the campaign, see `with_engine`.
        driver: `planning`, `anticipating` what it cannot see, `evading` by steering too, `careful` for the reference
            driver of UN R157, or one's own, `module:Class` or `tcp://localhost:PORT`, see
            `dsrc.closed_loop.driving.open`.
        loop: intervals and limits of time.
        controls: drive the controls of encounters with the truth first, and refuse to continue where one fails.
        careful: drive the reference driver of UN R157 with the truth too: crashes that it avoids are avoidable.
    """

    scenarios: _Names
    perceptions: Annotated[tuple[PerceptionSpec, ...], Meta(min_length=1)]
    name: str = "campaign"
    corruption: tuple[str, ...] = (PAPER_TABLE,)
    severity: Annotated[tuple[Annotated[int, Meta(ge=1, le=5)], ...], Meta(min_length=1)] = (3,)
    family: Family = "physical"
    corrupted_agents: str = EVERYONE
    channel: _Names = (IDEAL,)
    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None
    fault: tuple[str, ...] = ()
    defence: tuple[str, ...] = ()
    clean_seeds: Seeds = 20
    seeds: Seeds = 10
    engine: AutoEngine = "auto"
    driver: str = "planning"
    loop: LoopSettings = LoopSettings()
    controls: bool = True
    careful: bool = True

    @property
    def drivers(self) -> tuple[str, ...]:
        """Drivers of the perceptions, each once."""
        return tuple(dict.fromkeys(one.driver or self.driver for one in self.perceptions))

    @property
    def conditions(self) -> list[Condition]:
        """Clean, then every corruption at every severity."""
        return conditions_of(self.corruption, self.severity, (self.family,), self.corrupted_agents, "campaign")

    @property
    def radios(self) -> tuple[str, ...]:
        """Radio channels with their changes."""
        return changed_radios(self.channel, self.loss, self.delay_s, self.pose_error)

    @property
    def defences(self) -> tuple[Defence, ...]:
        """Defences, each in episodes of its own."""
        return tuple(parse_defence(text, "campaign") for text in self.defence or (NO_DEFENCE,))

    @property
    def lies(self) -> bool:
        """Whether it has attacks or defences, so that what helpers told is measured."""
        return any(self.defences) or any(one.attack for text in self.fault for one in parse_faults(text, "campaign"))

    def disturbed(self, channel: str) -> list[Disturbance]:
        """Return what the episodes of a channel are driven in: clean, each corruption, each text of faults."""
        own = [Disturbance(condition, channel) for condition in self.conditions]
        return [*own, *(settled(parse_faults(text, "campaign"), channel) for text in self.fault)]


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
    for field, expected in _without_effect(plan):
        if given.get(field) not in (None, [], [CLEAN], [IDEAL]):
            raise SettingsError(complaint(path, field, expected, f"{given[field]}"))
    return with_engine(plan)


def _scenarios_of(name: str, folder: Path) -> list[str]:
    """Return the scenarios that a name of a plan in a folder stands for, see `scenarios_in`."""
    found = scenarios_in(str(folder / name))
    return found if found != [str(folder / name)] else scenarios_in(name)


def _patient(plan: Campaign, loop: Mapping[str, Any]) -> Campaign:
    """Return a campaign whose episodes leave room for a slow driver, unless its settings of the loop say how long."""
    if "duration_s" in loop or not set(plan.drivers) & set(_PATIENT):
        return plan
    return replace(plan, loop=replace(plan.loop, duration_s=_PATIENT_S))


def with_engine(plan: Campaign) -> Campaign:
    """Return a campaign whose engine is no longer `auto`: one for all its detectors, so that they compare.

    It is `bf16` where the processor computes it and all detector files are as good in it, else `fused`.
    """
    if plan.engine != "auto":
        return plan
    paths = {Path(one.checkpoint or SHIPPED_DETECTOR) for one in plan.perceptions if _has_file(one)}
    if not paths:
        return replace(plan, engine="fused")
    from dsrc.models.storage.deploy import engine_for  # torch takes seconds to import

    found = {engine_for(path) for path in sorted(paths)}
    if len(found) > 1:
        LOG.info("engine fused for all detectors of the campaign, so that they compare")
    return replace(plan, engine=found.pop() if len(found) == 1 else "fused")


def _without_effect(plan: Campaign) -> Iterator[tuple[str, str]]:
    """Yield the fields that would change no episode of a plan, with what is expected of each."""
    no_sensor = all(one.kind in WITHOUT_SENSOR for one in plan.perceptions)
    if no_sensor or len(plan.conditions) == 1:
        for field in (*(() if plan.fault else ("seeds",)), "severity", "family", "corrupted_agents"):
            yield field, f"none, since no episode is corrupted{': clean_seeds' if field == 'seeds' else ''}"
    if no_sensor:
        yield "corruption", "none, since no perception has a sensor"
    if not any(_has_detector(one) for one in plan.perceptions):
        yield "engine", "none, since no perception has a detector"
    if not any(_has_helpers(one) for one in plan.perceptions):
        for field in _OF_RADIO:
            yield field, "none, since no perception has helpers"


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
        for field in ("corruption", *_OF_RADIO):
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
    for field, expected in _without_effect(plan):
        if field in (*_OF_RADIO, "engine") and given.get(field) not in (None, (IDEAL,)):
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
    if plan.loop.look_ahead_s and not any(_has_detector(one) for one in plan.perceptions):
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
        return any(_acts(each, plan.radios, one, _has_helpers(one)) for one in plan.perceptions)

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
    for name, seed in product(plan.scenarios, dict.fromkeys([*_listed(plan.clean_seeds), *_listed(plan.seeds)])):
        if not named or (scenario := load_scenario(name)).conflict is None:
            return
        agents |= set(encounter_agents(with_proven_encounter(scenario, seed), seed))
        named = [(field, one) for field, one in named if one not in agents]
    for field, unknown in named:
        listed = ", ".join(map(str, sorted(agents, key=lambda one: (one < 0, abs(one)))))
        raise SettingsError(complaint(where, field, f"ids among the agents {listed}", unknown))


def episodes_of(plan: Campaign) -> list[EpisodeJob]:
    """Return all episodes, seed by seed of a scenario, so that its world and proof are made once.

    A perception without a sensor drives clean episodes only, one without helpers through the first channel only.
    """
    plan, lies = with_engine(plan), plan.lies
    code, versions = code_hash(COMPUTED_BY), package_versions(COMPUTED_BY)
    hashes = {one.name: detector_hash(one.kind, one.checkpoint) for one in plan.perceptions}
    helped = {one.name: _has_helpers(one) for one in plan.perceptions}
    drivers = {text: driver_sha256(text) for text in plan.drivers}
    found = []
    for scenario in plan.scenarios:
        loaded = load_scenario(scenario)
        content, files = msgspec.to_builtins(loaded), _files_of(loaded)
        for seed in dict.fromkeys([*_listed(plan.clean_seeds), *_listed(plan.seeds)]):
            for one in plan.perceptions:
                cells = list(_cells(plan, one, seed, helped[one.name]))
                defences = plan.defences if one.kind in TELLING else ((),)
                for (condition, channel, faults), defence in product(cells, defences):
                    found.append(
                        EpisodeJob(
                            scenario=scenario,
                            content=content,
                            files=files,
                            perception=one.name,
                            uses=one.kind,
                            checkpoint=one.checkpoint,
                            detector=hashes[one.name],
                            condition=condition,
                            channel=channel,
                            radio=get_channel(channel).decisive(),
                            seed=seed,
                            engine=plan.engine if _has_detector(one) else "fused",
                            driver=one.driver or plan.driver,
                            loop=plan.loop,
                            versions=versions,
                            code=code,
                            faults=faults,
                            defence=defence,
                            lies=lies,
                            driver_sha256=drivers[one.driver or plan.driver],
                        )
                    )
    return found


def _files_of(scenario: Scenario) -> dict[str, str]:
    """Return the SHA-256 of a scenario's own files, by what they are; those of packages have their versions."""
    named = {"file": scenario.network.file, "polygons": scenario.network.polygons, "trips": scenario.demand.trips}
    paths = {name: Path(text) for name, text in named.items() if text}
    return {name: file_sha256(path) for name, path in paths.items() if path.is_absolute() and path.is_file()}


def late_messages(plan: Campaign) -> Iterator[tuple[str, float, float, float]]:
    """Yield name, delay, s, interval of measurements, s, and age, s, of channels whose messages are older than that."""
    if any(_has_detector(one) and _has_helpers(one) for one in plan.perceptions):
        for name in plan.radios:
            delay_s = get_channel(name).delay_s
            every_s = sensed_every_s(plan.loop.detect_every_s, at_once=delay_s == 0.0)
            age_s = math.ceil(delay_s / every_s - 1e-6) * every_s
            if age_s > delay_s + 1e-9:
                yield name, delay_s, every_s, age_s


def controls_of(plan: Campaign) -> Campaign | None:
    """Return the campaign of the controls of all encounters with the truth; None without an encounter."""
    shipped = [name for name in plan.scenarios if name.partition(":")[0] in ENCOUNTERS or len(Path(name).parts) > 1]
    bare = [name for name in shipped if (conflict := load_scenario(name).conflict) is not None and not conflict.control]
    if not bare:
        return None
    return replace(
        plan,
        scenarios=tuple(f"{name}:{control}" for name in bare for control in CONTROLS),
        perceptions=(PerceptionSpec(name="truth"),),
        corruption=(CLEAN,),
        **_IDEAL_RADIO,
        fault=(),
        defence=(),
        clean_seeds=_driven(plan),
        controls=False,
    )


def careful_of(plan: Campaign) -> Campaign:
    """Return the campaign of the reference driver of UN R157: the truth on all seeds that a plan drives, clean."""
    seeds = _driven(plan)
    return replace(
        plan,
        perceptions=(PerceptionSpec(name="truth"),),
        corruption=(CLEAN,),
        **_IDEAL_RADIO,
        fault=(),
        defence=(),
        clean_seeds=seeds,
        seeds=seeds,
        driver="careful",
        controls=False,
    )


def _driven(plan: Campaign) -> tuple[int, ...]:
    """Return the seeds that a plan drives."""
    return tuple(dict.fromkeys(job.seed for job in episodes_of(plan)))


def _listed(seeds: int | tuple[int, ...]) -> tuple[int, ...]:
    return tuple(range(seeds)) if isinstance(seeds, int) else seeds


def _cells(plan: Campaign, one: PerceptionSpec, seed: int, helped: bool) -> Iterator[Disturbance]:
    channels = plan.radios if helped else plan.radios[:1]
    for row in zip(*(plan.disturbed(channel) for channel in channels), strict=True):
        clean = row[0].condition.kind == CLEAN and not row[0].faults and row[0].channel == channels[0]
        if seed in _listed(plan.clean_seeds if clean else plan.seeds):
            yield from (each for each in row if _acts(each, channels, one, helped))


def _acts(disturbance: Disturbance, channels: tuple[str, ...], one: PerceptionSpec, helped: bool) -> bool:
    """Whether a perception is driven in a disturbance.

    All of it must act on a perception without a sensor, and some of it on one without helpers; every attack must act.
    """
    condition, channel, faults = disturbance
    needs = {fault.needs for fault in faults}
    if not all(hears(one.kind, fault) for fault in faults if fault.attack):
        return False
    if one.kind in WITHOUT_SENSOR:
        return condition.kind == CLEAN and channel in channels and not needs & {"sensor", "radio"}
    return helped or condition.kind != CLEAN or bool(needs - {"radio"}) or (not faults and channel in channels)


def _has_detector(one: PerceptionSpec) -> bool:
    return one.kind not in (*WITHOUT_SENSOR, MODELLED)


def _has_file(one: PerceptionSpec) -> bool:
    """Whether a perception runs the network of a detector file."""
    return _has_detector(one) and ":" not in one.kind


def _has_helpers(one: PerceptionSpec) -> bool:
    if one.kind == MODELLED:
        return read_model(Path(one.checkpoint)).cooperative
    return one.kind not in (*WITHOUT_SENSOR, ALONE)


def detector_hash(kind: str, checkpoint: str) -> str:
    """SHA-256 of the file that a perception is opened from: detector, error model or module; "" of the truth.

    Args:
        kind: of a `PerceptionSpec`.
    """
    if kind in WITHOUT_SENSOR:
        return ""
    if kind_of(kind) in ("pipe", "tcp"):
        from dsrc.detectors.open import detector_sha256

        return detector_sha256(kind)
    return source_hash(kind) if ":" in kind else file_sha256(Path(checkpoint or SHIPPED_DETECTOR))
