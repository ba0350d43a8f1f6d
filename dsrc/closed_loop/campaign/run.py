"""Runner of a campaign: drives missing episodes on any number of workers, and collects their results.

A campaign resumes: an episode is a cell under the hash of all that decides it. An episode whose perception fails is a
result, not an end. Where a control of an encounter fails with the truth, the driver is at fault and no other crash
means anything: the campaign refuses to run.
"""

import csv
import io
import math
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Self

import msgspec

from dsrc.closed_loop.campaign.episode import (
    EpisodeJob,
    EpisodeResult,
    decisive,
    drive_unit,
    episode_key,
    probe_s,
    read_result,
    stored_settings,
)
from dsrc.closed_loop.campaign.jobs import careful_of, controls_of, detector_hash, episodes_of
from dsrc.closed_loop.campaign.plan import Campaign, with_engine
from dsrc.closed_loop.campaign.read import campaign_of
from dsrc.closed_loop.driving.open import driver_sha256, is_own, open_driver
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.episode import EpisodeMetrics
from dsrc.closed_loop.perception.open import open_perception, parse_perception
from dsrc.closed_loop.replay import replay
from dsrc.closed_loop.types import Outcome
from dsrc.faults.fault import faults_text, parse_faults
from dsrc.messages.defences import NO_DEFENCE, parse_defence
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.lock import locked
from dsrc.runs.study import Study, signature
from dsrc.tables.files import csv_text
from sensors.corruptions import CLEAN, DEFAULT_SEVERITY, Condition
from sim.errors import DataError, SettingsError, complaint, option
from sim.files import write_file
from sim.machine import core_count
from sim.radio import IDEAL
from sim.reading import parsing, read_text

_COLUMNS = tuple(name for name in EpisodeResult.__struct_fields__ if name != "metrics")
_SELDOM = ("fault", "defence")
"""Columns that are there where an episode has them."""
_REUSED = "reused.csv"
"""Results of earlier runs in a campaign's folder."""

EPISODES: Study[EpisodeJob, EpisodeResult] = Study(
    task=drive_unit,
    alike=lambda job: (job.scenario, job.seed, job.uses),  # they share a world and a proof
    steps=lambda _: 1,
    endings=(".npz", ".json"),
    read=read_result,
    settings=decisive,
    stored=stored_settings,
)


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """Results of a campaign.

    Attributes:
        plan: the campaign.
        results: of all episodes, in the plan's order.
        controls: of all controls.
        careful: of the reference driver of UN R157 with the truth.
        made: number of episodes driven in this run.
        seconds: time of this run, s.
    """

    plan: Campaign
    results: tuple[EpisodeResult, ...]
    controls: tuple[EpisodeResult, ...]
    careful: tuple[EpisodeResult, ...]
    made: int
    seconds: float


@takes_fields(DriveOptions)
def drive_episodes(
    options: DriveOptions, /, out: Path | str, *, pool: Pool = SERIAL, progress: Progress | None = None
) -> CampaignResult:
    """Drive the episodes or the campaign of a command line, see `run_campaign`.

    Args:
        options: of `dsrc drive`.
        progress: called with episodes done and episodes missing at the start.

    Raises:
        UserError: a file or a setting is wrong.
    """
    return run_campaign(campaign_of(options), Path(out), pool, progress)


def run_campaign(
    plan: Campaign,
    out: Path,
    pool: Pool = SERIAL,
    progress: Progress | None = None,
    known: Mapping[str, EpisodeResult] | None = None,
) -> CampaignResult:
    """Drive the episodes missing in `out/episodes`, and write results.csv and controls.csv.

    Args:
        plan: a valid campaign, see `dsrc.closed_loop.campaign.check`.
        pool: workers; the results are the same for any.
        progress: called with episodes done and episodes missing at the start.
        known: results of episodes that are not driven again, by key, see `read_results`; `out` keeps them.

    Raises:
        SettingsError: a control fails with the truth.
        UserError: a file or a setting is wrong; all episodes that can be driven are there.
    """
    began, plan = time.monotonic(), with_engine(plan)
    controls_plan = controls_of(plan) if plan.controls else None
    with locked(out, what="campaign"):
        folder = out / "episodes"
        folder.mkdir(parents=True, exist_ok=True)
        controls: tuple[EpisodeResult, ...] = ()
        made = 0
        episodes = _Episodes.of(out, known)
        if episodes.known:
            write_file(out / _REUSED, results_csv(episodes.known.values()))
        guards = [] if controls_plan is None else episodes_of(controls_plan)
        own, reference = episodes_of(plan), _reference(plan)
        wanted = 0 if progress is None else episodes.missing([*guards, *own, *reference])

        def report(done: int, _: int) -> None:
            if progress is not None:
                progress(made + done, wanted)

        if guards:
            controls, driven = episodes.drive(guards, pool, report)
            write_file(out / "controls.csv", results_csv(controls))
            _require_controls(controls, out)
            made += driven
        both, more = episodes.drive([*own, *reference], pool, report)
        results, careful = both[: len(own)], both[len(own) :]
        write_file(out / "plan.json", msgspec.json.format(msgspec.json.encode(plan)))
        write_file(out / "results.csv", results_csv(results))
        if careful:
            write_file(out / "careful.csv", results_csv(careful))
    return CampaignResult(plan, results, controls, careful, made + more, time.monotonic() - began)


def _reference(plan: Campaign) -> list[EpisodeJob]:
    return episodes_of(careful_of(plan)) if plan.careful else []


def results_csv(results: Iterable[EpisodeResult]) -> str:
    """Return results as CSV, a line per episode and a column per metric."""
    results = list(results)
    columns = [name for name in _COLUMNS if name not in _SELDOM or any(getattr(result, name) for result in results)]
    metrics = sorted({name for result in results for name in result.metrics})
    rows = []
    for result in results:
        known = {name: f"{value:.6g}" for name, value in result.metrics.items() if value is not None}
        rows.append({**{name: getattr(result, name) for name in columns}, **known})
    return csv_text(rows, [*columns, *metrics])


def read_results(paths: Iterable[Path], whole: bool = True, field: str = "reuse") -> dict[str, EpisodeResult]:
    """Return the results of results.csv, controls.csv or careful.csv of other runs by key, with six digits each.

    Args:
        whole: every metric of today must be there; without it those of another version of the code may be missing.
        field: option that names the files.

    Raises:
        DataError: a file is none of these, one line names its line and field; two results of one key differ.
    """
    found: dict[str, EpisodeResult] = {}
    for path in paths:
        if not path.exists():
            raise DataError(complaint(path, field, "a folder of a campaign, or its results.csv", "nothing there"))
        text = read_text(path, "results.csv")
        with parsing(path, "results.csv"):
            rows = list(csv.reader(io.StringIO(text)))
        heads = rows[0] if rows else []
        kept = tuple(name for name in _COLUMNS if name not in _SELDOM)
        needed = (*kept, *EpisodeMetrics.__struct_fields__) if whole else kept
        if lacking := [name for name in needed if name not in heads]:
            raise DataError(complaint(path, "columns", "those of results.csv", f"none named {lacking[0]}"))
        for number, row in enumerate(rows[1:], start=2):
            where = f"result {number - 1}"
            if len(row) != len(heads):
                raise DataError(complaint(path, where, f"{len(heads)} fields", f"{len(row)}"))
            given = dict(zip(heads, row, strict=True))
            try:
                own = {name: given.pop(name) for name in _COLUMNS if name in given}
                metrics = {name: float(value) if value else None for name, value in given.items()}
                result = msgspec.convert(own | {"metrics": metrics}, EpisodeResult, strict=False)
                Outcome(result.outcome)
            except ValueError as error:
                raise DataError(complaint(path, where, "one of a campaign", str(error))) from None
            if infinite := [name for name, value in metrics.items() if value is not None and not math.isfinite(value)]:
                raise DataError(complaint(path, f"{where}: {infinite[0]}", "a finite number", given[infinite[0]]))
            if found.setdefault(result.key, result).metrics != metrics:
                raise DataError(complaint(path, where, "the same as before", "another result of the same episode"))
    return found


def take_episodes(plan: Campaign, out: Path, folders: Iterable[Path]) -> int:
    """Copy missing episodes from folders of earlier campaigns that differ in code and versions alone; return how many.

    Raises:
        DataError: a folder has no episodes.
    """
    with locked(out, what="campaign"):
        jobs = {episode_key(job): job for job in _all_jobs(plan)}
        (out / "episodes").mkdir(exist_ok=True)
        before = len(EPISODES.missing(out / "episodes", jobs))
        EPISODES.reuse(out / "episodes", jobs, folders)
        return before - len(EPISODES.missing(out / "episodes", jobs))


def engines_there(plan: Campaign, folders: Iterable[Path]) -> Counter[str]:
    """Count a campaign's missing episodes that folders of earlier campaigns have by another engine, by its name.

    Args:
        folders: the first is the campaign's own.
    """
    places = [folder / "episodes" for folder in folders]
    jobs = {episode_key(job): job for job in _all_jobs(plan)}
    missing = {_but_engine(decisive(job)): job.engine for job in EPISODES.missing(places[0], jobs).values()}
    found: dict[str, str] = {}
    for place in places if missing else []:
        for path in sorted(place.glob("*.json")):
            settings = stored_settings(place, path.stem)
            if settings is not None and missing.get(known := _but_engine(settings), own := settings["engine"]) != own:
                found[known] = own
    return Counter(found.values())


def _but_engine(settings: dict[str, Any]) -> str:
    return signature(settings | {"engine": ""})


def _all_jobs(plan: Campaign) -> list[EpisodeJob]:
    """Return the episodes of a campaign, its controls and its reference driver."""
    controls = controls_of(plan) if plan.controls else None
    return [*(episodes_of(controls) if controls else []), *episodes_of(plan), *_reference(plan)]


def reused(plan: Campaign, known: Mapping[str, EpisodeResult]) -> int:
    """Return the number of results that are of a campaign's episodes, its controls and its reference driver counted."""
    return len({episode_key(job) for job in _all_jobs(plan)} & known.keys())


@dataclass(frozen=True, slots=True)
class _Episodes:
    """Results of a campaign: in its folder, and known from elsewhere."""

    folder: Path
    known: Mapping[str, EpisodeResult]

    @classmethod
    def of(cls, out: Path, known: Mapping[str, EpisodeResult] | None) -> Self:
        """Return the results of a campaign's folder, with those that it was given in an earlier run."""
        listed = out / _REUSED
        before = read_results([listed]) if listed.is_file() else {}
        return cls(out / "episodes", before | dict(known or {}))

    def find(self, key: str) -> EpisodeResult | None:
        """Return the result of an episode; None where it is missing or damaged."""
        return EPISODES.find(self.folder, key) or self.known.get(key)

    def missing(self, jobs: Sequence[EpisodeJob]) -> int:
        """Return the number of episodes that are to be driven."""
        keyed = {key: job for job in jobs if (key := episode_key(job)) not in self.known}
        return len(EPISODES.missing(self.folder, keyed))

    def drive(
        self, jobs: Sequence[EpisodeJob], pool: Pool, progress: Progress | None
    ) -> tuple[tuple[EpisodeResult, ...], int]:
        """Drive the episodes that are missing; return all results and the number driven."""
        keyed = {episode_key(job): job for job in jobs}
        made = EPISODES.run(self.folder, {k: job for k, job in keyed.items() if k not in self.known}, pool, progress)
        return tuple(self._named(episode_key(job), job) for job in jobs), made

    def _named(self, key: str, job: EpisodeJob) -> EpisodeResult:
        """Return a result under the names of this campaign: two names may share an episode."""
        result = self.find(key)
        if result is None:
            raise DataError(complaint(self.folder / f"{key}.json", "episode", "a whole one", "a damaged one"))
        return msgspec.structs.replace(result, scenario=job.scenario, perception=job.perception, channel=job.channel)


def _require_controls(controls: Sequence[EpisodeResult], out: Path) -> None:
    failed = [one for one in controls if one.outcome != Outcome.ARRIVED.value]
    if failed:
        listed = ", ".join(f"{one.scenario} seed {one.seed}: {one.outcome}" for one in failed[:3])
        more = f" and {len(failed) - 3} more" if len(failed) > 3 else ""
        hint = f"; see {out / 'controls.csv'}, controls = false drives all the same"
        expected = "controls that the driver finishes with the truth"
        raise SettingsError(complaint("campaign", "controls", expected, f"{listed}{more}", hint))


def estimate_s(
    plan: Campaign, out: Path, pool: Pool, known: Mapping[str, EpisodeResult] | None = None
) -> tuple[int, float]:
    """Return the number of episodes missing and the estimated time to drive them, s, by a probe of each perception.

    Controls and the reference driver count. An episode lasts as long as those that are there did, else as its scenario.

    Args:
        known: results of episodes that are not driven again, by key.
    """
    episodes = _Episodes.of(out, known)
    jobs = _all_jobs(plan)
    found = {key: episodes.find(key) for key in dict.fromkeys(map(episode_key, jobs))}
    missing = [job for job in {episode_key(job): job for job in jobs}.values() if found[episode_key(job)] is None]
    driven = [one.metrics["duration_s"] for one in found.values() if one is not None]
    known_s = [seconds for seconds in driven if seconds is not None]
    total = 0.0
    for _, group in groupby(sorted(missing, key=_probed), key=_probed):
        several = list(group)
        step_s = probe_s(several[0])
        for job in several:
            longest_s = min(plan.loop.duration_s, job.content["duration_s"])
            seconds = sum(known_s) / len(known_s) if known_s else longest_s
            total += step_s * seconds / job.content["step_s"]
    workers = core_count() if pool.workers is None else pool.workers
    return len(missing), total / max(min(workers, core_count()), 1)


def _probed(job: EpisodeJob) -> tuple[str, str]:
    return job.uses, job.checkpoint


def replay_at(path: Path, options: DriveOptions) -> tuple[EpisodeLog, EpisodeLog]:
    """Return the log of an episode, and another with the percepts of the perception of a command line.

    Without a perception in the options it is the log's own: both logs are then the same. With a perception, a
    corruption, a channel, faults or a defence in the options, what they leave out of the others is none and ideal, not
    the log's.

    Raises:
        UserError: the log or a setting is wrong, or the log's own detector is not the file that is given.
    """
    radios = options.radios
    for field in ("perception", "corruption", "severity", "channel", "fault", "defence"):
        if len(values := getattr(options, field)) > 1:
            raise SettingsError(complaint("drive", option(field), "one value for a log", " ".join(map(str, values))))
    former = EpisodeLog.load(path)
    settings = former.settings
    uses = options.perception[0] if options.perception else settings.perception
    if not options.perception and ":" in parse_perception(uses).kind:
        # A log is data: code that it names runs for whoever asks for it.
        raise SettingsError(
            f"drive: {path} names code of its own, which runs only when asked for; add --perception {uses}"
        )
    if options.driver is None and is_own(settings.driver):
        raise SettingsError(
            f"drive: {path} names a driver of its own, which runs only when asked for; add --driver {settings.driver}"
        )
    if not options.perception and settings.detector:
        checkpoint = str(options.checkpoint or "")
        if detector_hash(uses, checkpoint) != settings.detector:
            expected = f"the detector of the log, SHA-256 {settings.detector[:12]}"
            raise SettingsError(complaint("drive", "checkpoint", expected, checkpoint or f"that of '{uses}'"))
    asked = options.perception or options.corruption or radios or options.fault or options.defence
    corruption = (options.corruption or (CLEAN if asked else settings.corruption,))[0]
    if corruption == CLEAN:
        for field in ("severity", "corrupted_agents", "family"):
            if getattr(options, field):
                raise SettingsError(f"drive: {option(field)} says how sensors are corrupted; add --corruption")
    severity = (options.severity or (settings.severity or DEFAULT_SEVERITY,))[0]
    condition = Condition.of(
        corruption,
        severity,
        options.family or settings.family,
        options.corrupted_agents or settings.who,  # type: ignore[arg-type]
    )
    faults = parse_faults(options.fault[0]) if options.fault else ()
    if not asked and settings.fault:
        faults = parse_faults(settings.fault, str(path))
    own = "" if asked else settings.defence
    defence = parse_defence(options.defence[0] if options.defence else own or NO_DEFENCE)
    used: dict[str, Any] = {
        "channel": (radios or (IDEAL if asked else settings.channel,))[0],
        # A perception that is driven again keeps its engine.
        "engine": options.engine if asked or options.engine != "auto" else settings.engine,
    }
    perception = open_perception(
        uses,
        checkpoint=options.checkpoint,
        corruption=condition,
        fault=faults,
        defence=defence,
        interval_s=settings.loop.get("detect_every_s", settings.scenario.step_s),
        look_ahead_s=settings.loop.get("look_ahead_s", 0.0) if options.look_ahead_s is None else options.look_ahead_s,
        **used,
    )
    used["engine"] = getattr(perception, "engine", settings.engine)
    driver = options.driver or settings.driver
    again = replay(former, perception, uses, open_driver(driver))
    if options.perception or options.checkpoint:
        asked_for = parse_perception(uses)
        used["detector"] = detector_hash(asked_for.kind, asked_for.file or str(options.checkpoint or ""))
    if options.look_ahead_s is not None:
        used["loop"] = settings.loop | {"look_ahead_s": options.look_ahead_s}
    again.settings = msgspec.structs.replace(
        again.settings,
        corruption=condition.kind,
        severity=condition.severity,
        family=condition.family,
        who=condition.agents_text,
        driver=driver,
        driver_sha256=driver_sha256(driver),
        fault=faults_text(faults),
        defence=",".join(defence),
        **used,
    )
    return former, again
