"""Benchmark runner: methods on drives, clean and under corruptions."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dsrc.channel import Receiver
from dsrc.data.drives import Drive, open_drive
from dsrc.data.sample import GridSpec, Sample, inside_range, make_sample
from dsrc.detections import Detections
from dsrc.evaluation.ap import FrameResult, evaluate
from dsrc.evaluation.rows import CLEAN, Row, make_row, summary_rows
from sensors import corruptions as registry
from sensors.corruptions import Family, drive_seed
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.v2x import ChannelSpec, Link

Progress = Callable[[int, int], None]

_SENSOR_S = 0.1
_log = logging.getLogger(__name__)

ALL = "all"
"""Every corruption of a family."""
PAPER_TABLE = "paper_six"
"""The six corruptions of the paper's tables."""


class SampleDetector(Protocol):
    """What the benchmark needs of a detector; its `settings.grid` says what it looks at."""

    @property
    def settings(self) -> Any:
        """Settings with at least `grid`; `max_agents`, when there, limits the collaborators."""
        ...

    def detect(self, sample: Sample) -> Detections:
        """Return detections in the ego LiDAR's frame."""
        ...


@dataclass(frozen=True, slots=True)
class Method:
    """A detector, its name in tables, whether it gets the collaborators' clouds, and through which channel.

    Without a channel everything arrives at once and nothing is counted.
    """

    name: str
    detector: SampleDetector
    cooperative: bool = True
    channel: ChannelSpec | None = None


def run_benchmark(
    methods: Sequence[Method],
    drives: Sequence[Path],
    corruptions: Sequence[str] = (PAPER_TABLE,),
    severity: int = 3,
    seed: int = 0,
    limit: int | None = None,
    progress: Progress | None = None,
    family: Family = "physical",
) -> list[Row]:
    """Evaluate methods under the clean condition and under each corruption.

    Each frame is read once and corrupted once per corruption; all methods see the same sweeps. The ground truth is
    that of the clean frame: an object whose points a corruption took away is still there to be missed. Detections
    that are not wholly inside the detector's range are left out, as such ground truth is.

    Args:
        methods: detectors with names that differ.
        drives: folders of drives.
        corruptions: see `corruption_kinds`; the clean condition is always there.
        severity: 1 to 5.
        seed: of the corruptions; every drive has its own weather and faults.
        limit: evaluate at most this many frames, evenly spread over all drives.
        progress: called with frames done and frames in all, conditions counted separately.
        family: of the corruptions' settings.

    Returns:
        Rows by condition and method, then `mean_ap` and `mce` of each method.

    Raises:
        SettingsError: an unknown corruption, a severity, seed or limit out of range, two methods of one name.
        DataError: a drive cannot be read, or there is no frame.
    """
    conditions = [CLEAN, *corruption_kinds(corruptions, family)]
    _check(methods, severity, seed, limit)
    places = _places([open_drive(drive) for drive in drives], limit)
    if not places:
        raise DataError(complaint("evaluate", "drives", "at least one frame", "none"))
    if any(method.channel is not None for method in methods):
        _warn_of_slow_drives([reader for reader, i in places if i == 1])
    results: dict[tuple[str, str], list[FrameResult]] = {(c, m.name): [] for c in conditions for m in methods}
    links: dict[tuple[str, str], list[Link]] = {key: [] for key in results}
    seconds = dict.fromkeys(results, 0.0)
    done, total = 0, len(places) * len(conditions)
    for reader, i in places:
        own_seed = drive_seed(seed, reader.drive.name)
        recorded = _Past(reader.read, i)
        for condition in conditions:
            seen = partial(corrupted, condition=condition, severity=severity, seed=own_seed, family=family)
            past = _Past(recorded.at, i, seen)
            samples: dict[tuple[GridSpec, int, bool], Sample] = {}
            for method in methods:
                sample = _sample(past[0], method, samples, reader.drive.name)
                if method.channel is not None and method.cooperative:
                    receiver = Receiver(method.channel, own_seed, interval_of(past), method.detector.settings)
                    sample, heard = receiver.receive(past, i, sample, method.detector.settings.grid)
                    links[condition, method.name].extend(heard)
                start = time.perf_counter()
                found = method.detector.detect(sample)
                seconds[condition, method.name] += time.perf_counter() - start
                judged = found[inside_range(found.boxes, method.detector.settings.grid)]
                results[condition, method.name].append(FrameResult(judged, sample.boxes))
            done += 1
            if progress is not None:
                progress(done, total)
    through = {method.name: method.channel is not None and method.cooperative for method in methods}
    rows = [
        make_row(
            name,
            condition,
            0 if condition == CLEAN else severity,
            evaluate(frames),
            seconds[condition, name],
            links[condition, name] if through[name] else None,
        )
        for (condition, name), frames in results.items()
    ]
    return [*rows, *summary_rows(rows)]


def corruption_kinds(names: Sequence[str], family: Family = "physical") -> tuple[str, ...]:
    """Return corruptions by name, in the order of `CORRUPTIONS`.

    Args:
        names: kinds, `paper_six` for those of the paper's tables, `all` for all of the family, `clean` for none.
        family: of their settings.

    Raises:
        SettingsError: there is no such corruption or family, or the family has no model of it.
    """
    groups = {CLEAN: (), PAPER_TABLE: registry.PAPER_SIX, ALL: registry.kinds_of(family)}
    for name in names:
        if name not in (*groups, *registry.CORRUPTIONS):
            hint = did_you_mean(name, [*groups, *registry.CORRUPTIONS])
            raise SettingsError(complaint("evaluate", "corruptions", "a corruption", name, hint))
        if name not in groups:
            registry.check_corruption(name, family=family)
    wanted = {kind for name in names for kind in groups.get(name, (name,))}
    return tuple(kind for kind in registry.CORRUPTIONS if kind in wanted)


def corrupted(frame: Frame, condition: str, severity: int, seed: int, family: Family = "physical") -> Frame:
    """Return the frame as the sensors deliver it under a condition; `seed` is the drive's."""
    return frame if condition == CLEAN else registry.corrupt_frame(frame, condition, severity, seed, family)


class _Past(Sequence[Frame]):
    """The frames of a drive from one back to the first, made when they are looked at, once.

    Args:
        read: gives the frame at a position in the drive.
        position: of the first.
        seen: what becomes of a frame.
    """

    def __init__(
        self, read: Callable[[int], Frame], position: int, seen: Callable[[Frame], Frame] | None = None
    ) -> None:
        self._read, self._position, self._seen = read, position, seen
        self._frames: dict[int, Frame] = {}

    def __len__(self) -> int:
        return self._position + 1

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[k] for k in range(*which.indices(len(self)))]
        if not 0 <= which < len(self):
            raise IndexError(which)
        if which not in self._frames:
            frame = self._read(self._position - which)
            self._frames[which] = frame if self._seen is None else self._seen(frame)
        return self._frames[which]

    def at(self, position: int) -> Frame:
        """Return the frame at a position in the drive."""
        return self[self._position - position]


def _warn_of_slow_drives(readers: Sequence[Drive]) -> None:
    """Say which drives have no frames between that a channel could deliver."""
    for reader in readers:
        step_s = interval_of([reader.read(1), reader.read(0)])
        if step_s > _SENSOR_S + 1e-6:
            _log.warning(
                "%s: its frames are %g s apart: a message that is late by less than that is as old as the frame before",
                *(reader.drive, step_s),
            )


def interval_of(past: Sequence[Frame]) -> float:
    """Return the time between the frames of a drive, s; 0.1 s for its first frame."""
    step = past[0].time_s - past[1].time_s if len(past) > 1 else 0.0
    return step if step > 0.0 else 0.1


def _check(methods: Sequence[Method], severity: int, seed: int, limit: int | None) -> None:
    names = [method.name for method in methods]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise SettingsError(complaint("evaluate", "methods", "names that differ", repeated[0]))
    if not 1 <= severity <= 5:
        raise SettingsError(complaint("evaluate", "severity", "1 to 5", severity))
    if seed < 0:
        raise SettingsError(complaint("evaluate", "seed", "at least 0", seed))
    if limit is not None and limit < 1:
        raise SettingsError(complaint("evaluate", "limit", "at least 1 frame", limit))


def _places(readers: Sequence[Drive], limit: int | None) -> list[tuple[Drive, int]]:
    """Return the frames to evaluate, all or `limit` of them evenly spread, as (drive, position)."""
    places = [(reader, i) for reader in readers for i in range(len(reader.frames))]
    if limit is None or limit >= len(places):
        return places
    chosen = np.linspace(0, len(places) - 1, limit).round().astype(int)
    return [places[i] for i in chosen]


def _sample(frame: Frame, method: Method, samples: dict[tuple[GridSpec, int, bool], Sample], drive: str) -> Sample:
    """Return what a method sees; methods with one grid and one company share it."""
    settings = method.detector.settings
    key = (settings.grid, getattr(settings, "max_agents", 5), method.cooperative)
    if key not in samples:
        sample = make_sample(frame, None, key[0], max_agents=key[1], cooperative=key[2])
        samples[key] = replace(sample, key=f"{drive}/{sample.key}")
    return samples[key]
