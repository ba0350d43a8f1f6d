"""Study of episodes: the jobs of a campaign.

All that this module imports, at any depth, is hashed into the keys of episodes, see `sim.kept.code_hash`.
"""

import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from dsrc.closed_loop.driving.open import open_driver
from dsrc.closed_loop.driving.own.process import ProcessDriver
from dsrc.closed_loop.encounter import conflict_class
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.metrics.episode import episode_metrics
from dsrc.closed_loop.metrics.lies import lie_metrics
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Driver, Perception
from dsrc.data.jsonio import read_json
from dsrc.detectors.texts import kind_of
from dsrc.faults.fault import Faults, faults_text
from dsrc.messages.defences import Defence
from dsrc.runs.unit import Progress, Unit, key_of
from sensors.corruptions import CLEAN, EVERYONE, Condition
from sim.boxes import CLASSES
from sim.errors import DataError, complaint
from sim.files import write_file
from sim.scenario import Scenario


class EpisodeJob(msgspec.Struct, frozen=True, kw_only=True):
    """Episode to drive: everything that decides its log.

    Attributes:
        scenario: name or path of the scenario.
        content: settings of the scenario.
        files: SHA-256 of the scenario's own files by what they are: `file` of the network, `polygons`, `trips`.
        perception: name in tables.
        uses: `truth`, `sight`, `ego`, `team`, `late`, `model` or `module:Class`.
        checkpoint: detector file or error model; "" for the shipped one, or without one.
        detector: SHA-256 of the detector file, error model or module; "" without one.
        condition: of the sweeps.
        channel: name of the channel.
        radio: settings of the channel.
        seed: of the episode.
        engine: execution of the network.
        driver: text of `dsrc.closed_loop.driving.open.open_driver`.
        loop: intervals and limits of time.
        versions: of other packages that the code imports.
        code: hash of the code.
        faults: of the episode, beside condition and radio, which are there all the time.
        defence: against attacks.
        lies: whether what helpers told is measured too, as in a campaign with attacks or defences.
        driver_sha256: of a driver of one's own, see `dsrc.closed_loop.driving.open.driver_sha256`; "" of a shipped one.
    """

    scenario: str
    content: dict[str, Any]
    files: dict[str, str]
    perception: str
    uses: str
    checkpoint: str
    detector: str
    condition: Condition
    channel: str
    radio: dict[str, Any]
    seed: int
    engine: str
    driver: str
    loop: LoopSettings
    versions: dict[str, str]
    code: str
    faults: Faults = ()
    defence: Defence = ()
    lies: bool = False
    driver_sha256: str = ""


def decisive(job: EpisodeJob) -> dict[str, Any]:
    """Return what decides an episode, of plain values, without names and paths."""
    condition = job.condition.decisive()
    found = msgspec.to_builtins(replace(job, faults=())) | {"who": condition.pop("who", EVERYONE)}
    found |= {"condition": condition, "faults": [one.decisive() for one in job.faults]}
    left_out = ["scenario", "perception", "checkpoint", "channel", "lies"]
    left_out += [name for name in ("faults", "defence", "driver_sha256") if not getattr(job, name)]
    return {name: found[name] for name in found if name not in left_out}


def episode_key(job: EpisodeJob) -> str:
    """Return the name of an episode's cell, see `decisive`."""
    return key_of(decisive(job))


class EpisodeResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an episode, a line of results.csv.

    Attributes:
        scenario: name or path of the scenario.
        perception: name in tables.
        corruption: kind, `clean` without one.
        severity: 1 to 5, 0 without a corruption.
        family: of the corruption's settings, "" without one.
        who: agents whose sensors are corrupted.
        channel: name of the channel.
        seed: of the episode.
        road_user: class of the conflict actor, "" without one.
        detectable: the perception has this class, or there is none to have.
        outcome: see `dsrc.closed_loop.types.Outcome`.
        message: explanation of a failed perception or driver.
        key: name of its cell.
        metrics: see `dsrc.closed_loop.metrics.episode.EpisodeMetrics`, and `dsrc.closed_loop.metrics.lies.LieMetrics`
            in a campaign with attacks or defences; None where undefined.
        fault: faults beside corruption and channel, "" without any.
        defence: against attacks, names between commas, "" without any.
    """

    scenario: str
    perception: str
    corruption: str
    severity: int
    family: str
    who: str
    channel: str
    seed: int
    road_user: str
    detectable: bool
    outcome: str
    message: str
    key: str
    metrics: dict[str, float | None]
    fault: str = ""
    defence: str = ""

    @property
    def clean(self) -> bool:
        """Whether there is neither a corruption nor a fault nor a defence."""
        return self.corruption == CLEAN and not self.fault and not self.defence

    @property
    def title(self) -> str:
        """Title of what is wrong with it, but for the channel, and of what defends it."""
        defended = f", defended by {self.defence.replace(',', ' and ')}" if self.defence else ""
        return self.disturbance + defended

    @property
    def disturbance(self) -> str:
        """What is wrong with it, but for the channel."""
        return self.fault or self.condition.label

    @property
    def condition(self) -> Condition:
        """Condition of the sensors."""
        return Condition.of(self.corruption, self.severity, self.family or "physical", self.who)


def read_result(folder: Path, key: str) -> EpisodeResult:
    """Read the result of an episode; raises DataError where it, or its log, is missing or damaged."""
    path = folder / f"{key}.json"
    if not (folder / f"{key}.npz").is_file():
        raise DataError(complaint(folder / f"{key}.npz", "episode", "its log", "none"))
    return read_json(path, EpisodeResult)


class _Stored(msgspec.Struct, frozen=True):
    settings: dict[str, Any] | None = None


def stored_settings(folder: Path, key: str) -> dict[str, Any] | None:
    """Return what decided a stored episode, None of one that does not tell; raises DataError where it is damaged."""
    return read_json(folder / f"{key}.json", _Stored).settings


def drive_unit(unit: Unit[EpisodeJob], progress: Progress) -> None:
    """Drive episodes and write their logs and results."""
    for done, (key, job) in enumerate(unit.jobs.items(), start=1):
        log = drive_episode(job)
        log.save(unit.folder / f"{key}.npz")
        result = msgspec.to_builtins(result_of(key, job, log)) | {"settings": decisive(job)}
        for name in ("fault", "defence"):
            if not result[name]:
                del result[name]
        write_file(unit.folder / f"{key}.json", msgspec.json.encode(result, order="deterministic"))
        progress(done, len(unit.jobs))


def drive_episode(job: EpisodeJob, watch: Callable[[ClosedLoop], None] | None = None) -> EpisodeLog:
    """Return the log of one episode.

    Args:
        watch: called with the loop after every step.

    Raises:
        UserError: scenario, perception or driver cannot be opened.
    """
    scenario = msgspec.convert(job.content, Scenario)
    loop = ClosedLoop(scenario, _perception(job), _driver(job), job.loop)
    loop.run(job.seed, watch)
    condition = job.condition
    return loop.log(
        perception=job.uses,
        detector=job.detector,
        driver=job.driver,
        driver_sha256=job.driver_sha256,
        corruption=condition.kind,
        severity=condition.severity,
        family=condition.family,
        who=condition.agents_text,
        channel=job.channel,
        engine=job.engine,
        versions=job.versions,
        fault=faults_text(job.faults),
        defence=",".join(job.defence),
    )


def probe_s(job: EpisodeJob, steps: int = 4) -> float:
    """Return the time of a step of an episode on this machine, s; the first step, which compiles, does not count."""
    loop = ClosedLoop(msgspec.convert(job.content, Scenario), _perception(job), _driver(job), job.loop)
    try:
        loop.start(job.seed)
        if loop.outcome is None:  # a perception may fail at once
            loop.advance()
        began = time.perf_counter()
        for _ in range(steps):
            if loop.outcome is None:
                loop.advance()
        return (time.perf_counter() - began) / steps
    finally:
        loop.close()


def result_of(key: str, job: EpisodeJob, log: EpisodeLog) -> EpisodeResult:
    """Return the result of an episode, computed from its log and the classes of its perception alone."""
    condition = job.condition
    road_user = conflict_class(log.settings.scenario, log.settings.seed)
    values = msgspec.to_builtins(episode_metrics(log)) | (msgspec.to_builtins(lie_metrics(log)) if job.lies else {})
    return EpisodeResult(
        scenario=job.scenario,
        perception=job.perception,
        corruption=condition.kind,
        severity=condition.severity,
        family="" if condition.kind == CLEAN else condition.family,
        who=condition.agents_text,
        channel=job.channel,
        seed=job.seed,
        road_user=road_user,
        detectable=not road_user or road_user in getattr(_perception(job), "classes", CLASSES),
        outcome=log.outcome.value,
        message=log.message,
        key=key,
        # As results.csv has them, so that tables of a campaign and of its file are the same.
        metrics={name: None if value != value else float(f"{value:.6g}") for name, value in values.items()},
        fault=faults_text(job.faults),
        defence=",".join(job.defence),
    )


def _driver(job: EpisodeJob) -> Driver:
    """Return the driver of an episode: a new one, but for a process, which is told where an episode begins."""
    limit_s = job.loop.perception_limit_s
    if kind_of(job.driver) in ("pipe", "tcp"):
        return _process(job.driver, job.driver_sha256, limit_s)
    return open_driver(job.driver, limit_s)


@lru_cache(maxsize=2)
def _process(text: str, _sha256: str, limit_s: float) -> ProcessDriver:
    return ProcessDriver(text, limit_s)


def _perception(job: EpisodeJob) -> Perception:
    return _opened(
        job.uses,
        job.checkpoint,
        job.detector,
        job.condition,
        job.channel,
        job.loop.detect_every_s,
        job.loop.look_ahead_s,
        job.engine,
        job.faults,
        job.defence,
    )


@lru_cache(maxsize=2)
def _opened(
    uses: str,
    checkpoint: str,
    _detector: str,  # another file under the same name is opened anew
    condition: Condition,
    channel: str,
    interval_s: float,
    look_ahead_s: float,
    engine: str,
    faults: Faults,
    defence: Defence,
) -> Perception:
    return open_perception(
        uses,
        checkpoint=Path(checkpoint) if checkpoint else None,
        corruption=condition,
        channel=channel,
        interval_s=interval_s,
        look_ahead_s=look_ahead_s,
        engine=engine,
        fault=faults,
        defence=defence,
    )
