"""Error model of recordings on disk: logs of episodes, or results with stored detections; one model per perception."""

from collections import defaultdict
from pathlib import Path

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.error_model.fit import classes_found, fit_errors
from dsrc.closed_loop.perception.error_model.model import ErrorModel
from dsrc.closed_loop.perception.error_model.percepts import (
    FRAME_S,
    Observed,
    observed_episode,
    observed_table,
)
from dsrc.evaluation.stored import has_index, read_index, read_run
from dsrc.runs.executors import Progress
from sensors.corruptions import Condition
from sim.errors import DataError, complaint, did_you_mean

_ALONE = ("truth", "sight", "ego")

Sequences = dict[tuple[Condition, str], list[list[Observed]]]
"""Percepts by condition of the sweeps and channel."""


def fit_model(
    data: Path,
    perception: str | None = None,
    *,
    seeds: tuple[int, ...] = (),
    progress: Progress | None = None,
) -> ErrorModel:
    """Fit an error model to what one perception has found, condition by condition.

    Args:
        data: log of an episode, folder of logs, folder of a campaign; or of `dsrc evaluate` or `dsrc benchmark`.
        perception: name of the perception in the logs or of the method; None where there is one alone.
        seeds: of the episodes that are used; none for all.
        progress: called with recordings read and recordings in all.

    Raises:
        DataError: there are no such recordings, one is damaged, or they differ in perception, detector or interval.
    """
    return (_of_results if has_index(data) else _of_logs)(
        data, perception, seeds, progress or (lambda done, total: None)
    )


def _of_logs(data: Path, perception: str | None, seeds: tuple[int, ...], progress: Progress) -> ErrorModel:
    paths = _logs(data)
    kept: list[EpisodeLog] = []
    names: set[str] = set()
    for done, path in enumerate(paths, start=1):
        log = EpisodeLog.load(path)
        names.add(log.settings.perception)
        if perception in (None, log.settings.perception) and (not seeds or log.settings.seed in seeds):
            kept.append(log)
        progress(done, len(paths))
    if not kept:
        wanted = perception or "any perception"
        of = f" and seeds {' '.join(map(str, seeds))}" if seeds else ""
        hint = did_you_mean(perception or "", names)
        raise DataError(complaint(data, "logs", f"an episode of {wanted}{of}", f"none in {len(paths)} logs", hint))
    settings = kept[0].settings
    for field, values in (
        ("perception", {log.settings.perception for log in kept}),
        ("detector", {log.settings.detector[:12] for log in kept}),
        ("detect_every_s", {f"{_interval(log):g}" for log in kept}),
        ("look_ahead_s", {f"{log.settings.loop.get('look_ahead_s', 0.0):g}" for log in kept}),
    ):
        if len(values) > 1:
            hint = "; name one with --perception" if field == "perception" else ""
            raise DataError(complaint(data, field, "the same in all episodes", ", ".join(sorted(values)), hint))
    cooperative = settings.perception not in _ALONE and not settings.perception.startswith("ego=")
    sequences: Sequences = defaultdict(list)
    for log in kept:
        one = log.settings
        condition = Condition.of(one.corruption, one.severity, one.family, one.who)
        sequences[condition, one.channel].append(list(observed_episode(log, cooperative)))
    scenarios = tuple(sorted({log.settings.scenario.name for log in kept}))
    return _model(settings.perception, settings.detector, cooperative, _interval(kept[0]), scenarios, sequences)


def _of_results(data: Path, method: str | None, seeds: tuple[int, ...], progress: Progress) -> ErrorModel:
    index = read_index(data)
    if seeds:
        raise DataError(f"{data}: stored detections are of no episodes and have no seeds; leave out --seed")
    runs = [run for run in index.runs if not run.swept and run.training == 0 and method in (None, run.method)]
    names = {run.method for run in index.runs}
    if len({run.method for run in runs}) != 1:
        expected = "one method, named with --perception"
        hint = did_you_mean(method or "", names)
        raise DataError(complaint(data, "runs", expected, f"{len({run.method for run in runs})} methods", hint))
    sequences: Sequences = defaultdict(list)
    for done, run in enumerate(runs, start=1):
        for cells in run.cells:
            if cells:
                sequences[run.condition, run.channel].append(
                    list(observed_table(read_run(data, cells), run.agents > 1))
                )
        progress(done, len(runs))
    drives = tuple(sorted({drive.name for drive in index.drives}))
    return _model(runs[0].method, runs[0].detector, runs[0].agents > 1, FRAME_S, drives, sequences)


def _model(
    perception: str,
    detector: str,
    cooperative: bool,
    interval_s: float,
    scenarios: tuple[str, ...],
    sequences: Sequences,
) -> ErrorModel:
    conditions = tuple(
        fit_errors(
            found,
            interval_s,
            corruption=condition.kind,
            severity=condition.severity,
            family=condition.family,
            who=condition.agents_text,
            channel=channel,
        )
        for (condition, channel), found in sorted(sequences.items(), key=lambda item: (*item[0][0].key, item[0][1]))
    )
    return ErrorModel(
        perception=perception,
        detector=detector,
        cooperative=cooperative,
        interval_s=interval_s,
        classes=classes_found(conditions),
        scenarios=scenarios,
        conditions=conditions,
    )


def _interval(log: EpisodeLog) -> float:
    return float(log.settings.loop.get("detect_every_s", log.settings.scenario.step_s))


def _logs(data: Path) -> list[Path]:
    """Return the logs of a folder, or of its folder `episodes`, by name."""
    if data.is_file():
        return [data]
    paths = sorted(data.glob("*.npz")) or sorted((data / "episodes").glob("*.npz"))
    if not paths:
        found = "none" if data.is_dir() else "no such folder"
        raise DataError(complaint(data, "logs", "logs of episodes (.npz), as dsrc drive --out writes them", found))
    return paths
