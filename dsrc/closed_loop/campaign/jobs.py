"""Episodes that a campaign asks for: its own, those of its controls, and those of the reference driver."""

import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from dsrc.closed_loop.campaign.episode import EpisodeJob
from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec, listed, with_engine
from dsrc.closed_loop.driving.open import driver_sha256
from dsrc.closed_loop.perception.open import TELLING, WITHOUT_SENSOR, hears
from dsrc.closed_loop.perception.senses import sensed_every_s
from dsrc.detectors.classes import source_hash
from dsrc.detectors.texts import SHIPPED_DETECTOR, kind_of
from dsrc.faults.condition import Disturbance
from sensors.corruptions import CLEAN
from sim.catalog.load import load_scenario
from sim.encounters import ENCOUNTERS
from sim.files import file_sha256
from sim.kept.code_hash import code_hash, package_versions
from sim.radio import IDEAL, get_channel
from sim.scenario import Scenario

CONTROLS = ("no_occluder", "no_conflict")
COMPUTED_BY = "dsrc.closed_loop.campaign.episode"
"""Module whose sources and imports are hashed into the keys of episodes."""
_IDEAL_RADIO: dict[str, Any] = {"channel": (IDEAL,), "loss": None, "delay_s": None, "pose_error": None}


def episodes_of(plan: Campaign) -> list[EpisodeJob]:
    """Return all episodes, seed by seed of a scenario, so that its world and proof are made once.

    A perception without a sensor drives clean episodes only, one without helpers through the first channel only.
    """
    plan, lies = with_engine(plan), plan.lies
    code, versions = code_hash(COMPUTED_BY), package_versions(COMPUTED_BY)
    hashes = {one.name: detector_hash(one.kind, one.checkpoint) for one in plan.perceptions}
    helped = {one.name: one.has_helpers for one in plan.perceptions}
    drivers = {text: driver_sha256(text) for text in plan.drivers}
    found = []
    for scenario in plan.scenarios:
        loaded = load_scenario(scenario)
        content, files = msgspec.to_builtins(loaded), _files_of(loaded)
        for seed in plan.all_seeds:
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
                            engine=plan.engine if one.has_detector else "fused",
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


def late_messages(plan: Campaign) -> Iterator[tuple[str, float, float, float]]:
    """Yield name, delay, s, interval of measurements, s, and age, s, of channels whose messages are older than that."""
    if any(one.has_detector and one.has_helpers for one in plan.perceptions):
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


def _cells(plan: Campaign, one: PerceptionSpec, seed: int, helped: bool) -> Iterator[Disturbance]:
    channels = plan.radios if helped else plan.radios[:1]
    for row in zip(*(plan.disturbed(channel) for channel in channels), strict=True):
        clean = row[0].condition.kind == CLEAN and not row[0].faults and row[0].channel == channels[0]
        if seed in listed(plan.clean_seeds if clean else plan.seeds):
            yield from (each for each in row if acts_on(each, channels, one, helped))


def acts_on(disturbance: Disturbance, channels: tuple[str, ...], one: PerceptionSpec, helped: bool) -> bool:
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
