"""Search for faults and parameters that crash the ego: what is tried, what crashes, its cause and its smallest fault.

Episodes are cells of the study of campaigns, each under the key of all that decides it: a search that was interrupted
asks for the same episodes again and finds them.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from dsrc.closed_loop.campaign.check import check
from dsrc.closed_loop.campaign.episode import EpisodeJob, EpisodeResult, episode_key
from dsrc.closed_loop.campaign.jobs import episodes_of
from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.read import campaign_of
from dsrc.closed_loop.campaign.run import EPISODES
from dsrc.closed_loop.causes.episodes import crash_causes
from dsrc.closed_loop.falsification.optimizers import ROUND, Optimizer, open_optimizer
from dsrc.closed_loop.falsification.smallest import neighbours, smallest
from dsrc.closed_loop.falsification.space import Candidate, Dimension, Space, Template, parameters_of, tidy
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Outcome
from dsrc.faults.condition import settled
from dsrc.faults.fault import Faults, faults_text
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import takes_fields
from dsrc.options.search import OptimizerName, SearchOptions
from dsrc.runs.executors import SERIAL, Executor, Pool, Progress
from dsrc.runs.lock import locked
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError, SettingsError, complaint
from sim.radio import get_channel

CALM_S = 10.0
"""Time to collision from which on an episode is not critical at all, s."""
SAME_M = 5.0
"""Distance between the places of the ego at two crashes of one failure, m."""
_ALONE = dataclasses.replace(EPISODES, alike=episode_key)
"""The study of episodes, each a unit of its own: an encounter that cannot be is the end of its own episode alone."""
_WHERE = "search"
_SILENT = (Outcome.DESYNCHRONISED.value, Outcome.PERCEPTION_FAILED.value, Outcome.DRIVER_FAILED.value)
"""Outcomes that say nothing of how close a crash was."""


class Trial(msgspec.Struct, frozen=True, kw_only=True):
    """Episode that was tried.

    Attributes:
        optimizer: that asked for it; `judge` of one that the perception drove after a fast search.
        number: of the optimiser's episodes, from 1.
        candidate: the episode.
        size: of its faults, 0 to 1, as a share of their ranges.
        outcome: see `dsrc.closed_loop.types.Outcome`; "impossible" where no draw of the encounter has its occlusion.
        value: what the optimiser makes small: a crash by the size of its faults less 1, all else by the smallest time
            to collision as a share of `CALM_S`.
        key: name of its cell.
    """

    optimizer: str
    number: int
    candidate: Candidate
    size: float
    outcome: str
    value: float
    key: str

    @property
    def crashed(self) -> bool:
        """Whether it crashed."""
        return self.outcome == Outcome.CRASHED.value


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """Crashes of one scenario with one cause at one place.

    Attributes:
        first: the crash with the smallest fault among them.
        cause: kind of their cause.
        sentence: the cause of the first in words.
        place: (x, y) of the ego at the first crash, m.
        trials: all of them, the smallest fault first.
        fault: smallest fault that still crashes, "" where none is needed; None where it was not looked for.
        key: cell of the episode with it.
        near: episodes with one number changed by a tenth.
        still: of these, those that crash.
    """

    first: Trial
    cause: str
    sentence: str
    place: tuple[float, float]
    trials: tuple[Trial, ...]
    fault: str | None = None
    key: str = ""
    near: int = 0
    still: int = 0


@dataclass(frozen=True, slots=True)
class Falsification:
    """Result of a search.

    Attributes:
        options: of the search.
        trials: of each optimiser, in their order.
        judged: by the perception after a fast search.
        failures: distinct ones, the smallest fault first.
        results: of all episodes that were driven, the neighbours included.
        plan: of the perception that tells what is a crash.
        made: episodes driven in this run.
        seconds: time of this run, s.
    """

    options: SearchOptions
    trials: dict[str, tuple[Trial, ...]]
    judged: tuple[Trial, ...]
    failures: tuple[Failure, ...]
    results: tuple[EpisodeResult, ...]
    plan: Campaign
    made: int
    seconds: float

    def found_by(self, optimizer: str) -> list[Failure]:
        """Return the failures that an optimiser's episodes are among; after a fast search those that it proposed."""
        proposed = {one.candidate for one in self.trials[optimizer]}
        return [one for one in self.failures if any(trial.candidate in proposed for trial in one.trials)]


@takes_fields(SearchOptions)
def search_failures(
    options: SearchOptions, /, out: Path | str, *, pool: Pool = SERIAL, progress: Progress | None = None
) -> Falsification:
    """Search for faults and parameters that crash the ego; episodes that are in the folder are not driven again.

    Args:
        options: of `dsrc search`.
        out: folder of the episodes.
        pool: workers; the results are the same for any.
        progress: called with episodes done and episodes known to be needed.

    Raises:
        UserError: a file or a setting is wrong, or the package of an optimiser is missing.
    """
    began, out = time.monotonic(), Path(out)
    plan, space = _plan(options, options.perception), _space(options)
    fast = plan if options.fast is None else _plan(options, options.fast)
    for one in (plan, fast):
        _check_faults(one, space)
    optimizers = {name: open_optimizer(name, space, options.budget, options.search_seed) for name in options.optimizer}
    with locked(out, what="search"), pool.open(ROUND) as workers:
        folder, judges = out / "episodes", fast is not plan
        folder.mkdir(parents=True, exist_ok=True)
        count = _Count(options.budget * len(options.optimizer) + (options.judge if judges else 0), progress)
        first = _Episodes(fast, space, folder, workers, count)
        trials: dict[str, tuple[Trial, ...]] = {
            name: _searched(first, name, one, options.budget) for name, one in optimizers.items()
        }
        driven = _Episodes(plan, space, folder, workers, count) if judges else first
        judged = _judged(driven, trials, options.judge) if judges else ()
        told = judged if judges else [one for own in trials.values() for one in own]
        failures = _failures(driven, [one for one in told if one.crashed])
        failures = [_shrunk(driven, one) if row < options.failures else one for row, one in enumerate(failures)]
        count.end()
    results, made = tuple(driven.results.values()), driven.made + (first.made if judges else 0)
    return Falsification(options, trials, judged, tuple(failures), results, plan, made, time.monotonic() - began)


def _plan(options: SearchOptions, perception: str) -> Campaign:
    """Return the campaign whose episodes a search changes."""
    if not options.scenario:
        raise SettingsError(complaint(_WHERE, "scenario", "at least one", "none"))
    shared = ("checkpoint", "seed", "driver", "duration_s", "detect_every_s")
    given: dict[str, Any] = {name: getattr(options, name) for name in shared}
    if given["checkpoint"] is not None and perception != options.perception:
        given["checkpoint"] = None
    channel = () if options.channel == "ideal" else (options.channel,)
    first, *_ = options.scenario
    plan = campaign_of(DriveOptions(what=first, perception=(perception,), channel=channel, **given))
    plan = replace(plan, scenarios=options.scenario)
    check(plan, _WHERE)
    return plan


def _space(options: SearchOptions) -> Space:
    for name, least in (("budget", 1), ("judge", 1), ("failures", 0), ("search_seed", 0)):
        if (number := getattr(options, name)) < least:
            raise SettingsError(complaint(_WHERE, f"--{name.replace('_', '-')}", f"at least {least}", number))
    if repeated := [name for name in options.optimizer if options.optimizer.count(name) > 1]:
        raise SettingsError(complaint(_WHERE, "--optimizer", "names that differ", repeated[0]))
    templates = tuple(Template.parse(text, _WHERE) for text in options.fault or ("",))
    scenarios = {name: load_scenario(name) for name in options.scenario}
    space = Space(options.scenario, options.seed, templates, parameters_of(options.parameter, scenarios))
    if len(space.choices) == 1 and not space.dimensions(space.choices[0]):
        expected = "a fault or a parameter with a range LOW..HIGH, or several seeds"
        raise SettingsError(complaint(_WHERE, "--fault", expected, "".join(options.fault) or "none"))
    return space


def _check_faults(plan: Campaign, space: Space) -> None:
    """Raise SettingsError for a fault that does not act on the perception, at any end of its ranges."""
    for template in space.templates:
        for text in dict.fromkeys(faults_text(template.faults(units)) for units in template.corners()):
            check(replace(plan, fault=(text,) if text else ()), _WHERE)


class _Count:
    """Progress over all stages."""

    def __init__(self, wanted: int, progress: Progress | None) -> None:
        self.done, self.wanted, self._progress = 0, wanted, progress

    def add(self, episodes: int, unplanned: bool = False) -> None:
        self.done += episodes
        self.wanted += episodes if unplanned else 0
        self._show(max(self.wanted, self.done + 1))

    def end(self) -> None:
        self._show(self.done)

    def _show(self, wanted: int) -> None:
        if self._progress is not None:
            self._progress(self.done, wanted)


@dataclass(slots=True)
class _Episodes:
    """Episodes of a search by one perception.

    Attributes:
        plan: of the perception.
        results: by key.
        made: number driven in this run.
    """

    plan: Campaign
    space: Space
    folder: Path
    workers: Executor
    count: _Count
    results: dict[str, EpisodeResult] = field(default_factory=dict)
    made: int = 0
    _bases: dict[tuple[str, int], EpisodeJob] = field(default_factory=dict)
    _impossible: set[str] = field(default_factory=set)

    def job(self, one: Candidate) -> EpisodeJob:
        """Return the job of a candidate."""
        if not self._bases:
            self._bases = {(job.scenario, job.seed): job for job in episodes_of(self.plan)}
        base, faults = self._bases[one.scenario, one.seed], one.faults
        each = settled(faults, self.plan.radios[0])
        content = base.content
        if one.parameters:
            conflict = content["conflict"]
            content = content | {
                "conflict": conflict | {"parameters": conflict.get("parameters", {}) | dict(one.parameters)}
            }
        return replace(
            base,
            content=content,
            condition=each.condition,
            channel=each.channel,
            radio=get_channel(each.channel).decisive(),
            faults=each.faults,
            lies=any(fault.attack for fault in faults),
        )

    def drive(self, candidates: Sequence[Candidate], unplanned: bool = False) -> list[tuple[str, EpisodeResult | None]]:
        """Drive the candidates that are missing; return key and result of each, None for an impossible one."""
        jobs = [self.job(one) for one in candidates]
        keys = [episode_key(job) for job in jobs]
        wanted = {key: job for key, job in zip(keys, jobs, strict=True) if key not in self._impossible}
        varied = any(one.parameters for one in candidates)
        before = len(EPISODES.missing(self.folder, wanted))
        try:
            _ALONE.run(self.folder, wanted, self.workers)
        except ScenarioError:
            if not varied:
                raise
        left = EPISODES.missing(self.folder, wanted)
        self._impossible |= left.keys()
        self.made += before - len(left)
        self.count.add(len(candidates), unplanned)
        found = {key: EPISODES.read(self.folder, key) for key in wanted if key not in left}
        self.results |= found
        return [(key, found.get(key)) for key in keys]

    def crashes(self, like: Candidate, faults: Faults) -> bool:
        """Whether an episode with other faults crashes."""
        ((_, result),) = self.drive([replace(like, fault=faults_text(faults))], unplanned=True)
        return result is not None and result.outcome == Outcome.CRASHED.value


def value_of(result: EpisodeResult | None, size: float) -> float:
    """Return what a search makes small, see `Trial.value`; 1 for an episode that says nothing."""
    if result is None or result.outcome in _SILENT:
        return 1.0
    if result.outcome == Outcome.CRASHED.value:
        return size - 1.0
    ttc_s = result.metrics["min_ttc_s"]
    return 1.0 if ttc_s is None else min(ttc_s, CALM_S) / CALM_S


def _searched(driven: _Episodes, name: OptimizerName, optimizer: Optimizer, budget: int) -> tuple[Trial, ...]:
    """Return the trials of an optimiser."""
    space, trials = driven.space, list[Trial]()
    while len(trials) < budget:
        points = optimizer.ask(min(ROUND, budget - len(trials)))
        candidates, sizes = [space.candidate(point) for point in points], [space.size(point) for point in points]
        for one, size, (key, result) in zip(candidates, sizes, driven.drive(candidates), strict=True):
            trials.append(_trial(name, len(trials) + 1, one, size, key, result))
        optimizer.tell([one.value for one in trials[-len(points) :]])
    return tuple(trials)


def _trial(name: str, number: int, one: Candidate, size: float, key: str, result: EpisodeResult | None) -> Trial:
    outcome, value = "impossible" if result is None else result.outcome, value_of(result, size)
    return Trial(optimizer=name, number=number, candidate=one, size=size, outcome=outcome, value=value, key=key)


def _judged(judge: _Episodes, trials: Mapping[str, Sequence[Trial]], most: int) -> tuple[Trial, ...]:
    """Return what the perception makes of the episodes of a fast search that came closest to a crash."""
    every = sorted((one for own in trials.values() for one in own), key=lambda one: one.value)
    worst = list({one.candidate: one for one in every if one.outcome != "impossible"}.values())[:most]
    found: list[Trial] = []
    for start in range(0, len(worst), ROUND):
        part = worst[start : start + ROUND]
        for one, (key, result) in zip(part, judge.drive([each.candidate for each in part]), strict=True):
            found.append(_trial("judge", len(found) + 1, one.candidate, one.size, key, result))
    return tuple(found)


def _failures(driven: _Episodes, crashed: Sequence[Trial]) -> list[Failure]:
    """Return the distinct failures among crashes: of one scenario and cause, and close to the smallest of them."""
    crashed = sorted(crashed, key=lambda one: (one.size, one.number))
    causes = crash_causes(driven.plan, [driven.results[one.key] for one in crashed], driven.folder)
    groups: list[tuple[str, np.ndarray, list[Trial]]] = []
    for one in crashed:
        kind = causes[one.key].kind
        last = EpisodeLog.load(driven.folder / f"{one.key}.npz").ticks[-1]
        place = last.ego.box.center[0, :2]
        for known, there, own in groups:
            same = known == kind and own[0].candidate.scenario == one.candidate.scenario
            if same and float(np.linalg.norm(there - place)) <= SAME_M:
                own.append(one)
                break
        else:
            groups.append((kind, place, [one]))
    return [
        Failure(
            first=own[0],
            cause=kind,
            sentence=causes[own[0].key].sentence,
            place=(round(float(place[0]), 1), round(float(place[1]), 1)),
            trials=tuple(own),
        )
        for kind, place, own in groups
    ]


def _shrunk(driven: _Episodes, failure: Failure) -> Failure:
    """Return a failure with its smallest fault and its neighbourhood."""
    one = failure.first.candidate
    log = EpisodeLog.load(driven.folder / f"{failure.first.key}.npz")
    end_s = log.actors.step_s * len(log)
    least = smallest(one.faults, partial(driven.crashes, one), end_s) if one.fault else ()
    small = replace(one, fault=faults_text(least))
    around = [replace(small, fault=faults_text(faults)) for faults in neighbours(least)]
    around += [replace(small, parameters=near) for near in _near(one.parameters, driven.space.parameters)]
    around = list(dict.fromkeys(around))
    ((key, _),) = driven.drive([small], unplanned=True)
    found = [result for _, result in driven.drive(around, unplanned=True) if result is not None]
    still = sum(result.outcome == Outcome.CRASHED.value for result in found)
    return dataclasses.replace(failure, fault=small.fault, key=key, near=len(found), still=still)


def _near(values: Sequence[tuple[str, float]], dimensions: Sequence[Dimension]) -> list[tuple[tuple[str, float], ...]]:
    """Return parameters with one changed by a tenth to either side, within its range."""
    found: list[tuple[tuple[str, float], ...]] = []
    for row, ((name, value), dimension) in enumerate(zip(values, dimensions, strict=True)):
        for factor in (0.9, 1.1):
            near = round(factor * value) if dimension.whole else tidy(factor * value)
            near = min(max(float(near), dimension.low), dimension.high)
            if near != value:
                found.append((*values[:row], (name, near), *values[row + 1 :]))
    return found
