"""The core of every evaluation: methods on drives, clean and under corruptions."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive, open_drive
from dsrc.data.executors import Progress
from dsrc.data.sample import Sample, inside_range, make_sample
from dsrc.evaluation.metrics.ap import FrameResult, Judged, join, judge, result_of
from dsrc.evaluation.results import CLEAN, Row, make_row, summary_rows
from dsrc.models.channel import Receiver
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sensors import corruptions as registry
from sensors.corruptions import Family, drive_seed
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.radio import ChannelSpec, Link

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
    """A detector, its name in tables, how many agents' clouds it gets, and through which channel.

    Attributes:
        name: in tables.
        detector: finds boxes.
        agents: it gets the clouds of so many at most, the ego's first; None for all that its settings take. What there
            is to find is the same for any number.
        channel: without one everything arrives at once and nothing is counted.
    """

    name: str
    detector: SampleDetector
    agents: int | None = None
    channel: ChannelSpec | None = None

    @property
    def listens(self) -> bool:
        """Whether messages go through a channel."""
        return self.channel is not None and self.agents != 1


@dataclass(frozen=True, slots=True)
class Condition:
    """What becomes of the sweeps: the corruption's kind, or `clean`, its severity, 0 for clean, and its family."""

    kind: str = CLEAN
    severity: int = 0
    family: Family = "physical"


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """What a method made of F frames.

    Attributes:
        judged: which of its detections hit what.
        ego_share: (N,) float32 of each true box the share of the ego's rays on it that nothing else stops; NaN unknown.
        seconds: (F,) that each detection took.
        traffic: (F, 4) see `make_row`; None without a channel.
    """

    judged: Judged
    ego_share: NDArray[np.float32]
    seconds: NDArray[np.float64]
    traffic: NDArray[np.float64] | None


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
    """Evaluate methods under the clean condition and under each corruption, see `evaluate_drive`.

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
    kinds = corruption_kinds(corruptions, family)
    conditions = [Condition(), *(Condition(kind, severity, family) for kind in kinds)]
    check_names([method.name for method in methods])
    check_numbers("evaluate", (severity,), seed, limit)
    readers = [open_drive(drive) for drive in drives]
    places = places_of(readers, limit)
    if any(method.channel is not None for method in methods):
        warn_of_slow_drives(readers)
    done, total = 0, sum(map(len, places)) * len(conditions)

    def tell() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    tallies: dict[tuple[Condition, str], list[Tally]] = {}
    for reader, positions in zip(readers, places, strict=True):
        for key, tally in evaluate_drive(reader, positions, dict.fromkeys(conditions, methods), seed, tell).items():
            tallies.setdefault(key, []).append(tally)
    rows = []
    for (condition, name), parts in tallies.items():
        whole = joined(parts)
        result = result_of(whole.judged)
        rows.append(make_row(name, condition.kind, condition.severity, result, whole.seconds, whole.traffic))
    return [*rows, *summary_rows(rows)]


def evaluate_drive(
    reader: Drive,
    positions: Sequence[int],
    work: Mapping[Condition, Sequence[Method]],
    seed: int,
    tell: Callable[[], None] = lambda: None,
) -> dict[tuple[Condition, str], Tally]:
    """Evaluate methods in frames of a drive under conditions.

    Each frame is read once and corrupted once per condition; all methods see the same sweeps. The ground truth is
    that of the clean frame: an object whose points a corruption took away is still there to be missed. Detections
    that are not wholly inside the detector's range are left out, as such ground truth is.

    Args:
        reader: of the drive.
        positions: of the frames.
        work: under each condition the methods, whose names differ.
        seed: of corruptions and channels.
        tell: called when a frame is done under a condition.

    Returns:
        By condition and method's name, in the order of the work.
    """
    name = reader.drive.name
    own_seed = drive_seed(seed, name)
    read = lru_cache(maxsize=3)(reader.read)
    records = {(condition, method.name): _Record() for condition, methods in work.items() for method in methods}
    receivers: dict[str, Receiver] = {}
    for methods in work.values():
        for method in methods:
            if method.channel is not None and method.listens and method.name not in receivers:
                settings = method.detector.settings
                receivers[method.name] = Receiver(method.channel, own_seed, interval_of(reader), settings)
    for i in positions:
        recorded = _Past(read, i)
        for condition, methods in work.items():
            past = _Past(recorded.at, i, partial(corrupted, condition=condition, seed=own_seed))
            samples: dict[tuple[GridSpec, int, int | None], Sample] = {}
            for method in methods:
                sample, record = _sample(past[0], method, samples, name), records[condition, method.name]
                if method.name in receivers:
                    grid = method.detector.settings.grid
                    sample, links = receivers[method.name].receive(past, i, sample, grid)
                    record.traffic.append(_traffic(links))
                start = time.perf_counter()
                found = method.detector.detect(sample)
                record.seconds.append(time.perf_counter() - start)
                judged = found[inside_range(found.boxes, method.detector.settings.grid)]
                record.results.append(FrameResult(judged, sample.boxes))
                record.ego_share.append(_ego_share(recorded[0], sample))
            tell()
    return {key: record.tally() for key, record in records.items()}


@dataclass(slots=True)
class _Record:
    """What a method has made of frames so far."""

    results: list[FrameResult] = field(default_factory=list)
    ego_share: list[NDArray[np.float32]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    traffic: list[tuple[float, float, float, float]] = field(default_factory=list)

    def tally(self) -> Tally:
        return Tally(
            judge(self.results),
            np.concatenate([np.zeros(0, np.float32), *self.ego_share]),
            np.array(self.seconds, np.float64),
            np.array(self.traffic, np.float64) if self.traffic else None,
        )


def joined(tallies: Sequence[Tally]) -> Tally:
    """Return what a method made of the frames of all its tallies, at least one."""
    traffic = [tally.traffic for tally in tallies if tally.traffic is not None]
    return Tally(
        join([tally.judged for tally in tallies]),
        np.concatenate([tally.ego_share for tally in tallies]),
        np.concatenate([tally.seconds for tally in tallies]),
        np.concatenate(traffic) if traffic else None,
    )


def _traffic(links: Sequence[Link]) -> tuple[float, float, float, float]:
    heard = [link.age_s for link in links if link.heard]
    return float(sum(link.bytes for link in links)), float(len(links)), float(len(heard)), float(sum(heard))


def _ego_share(frame: Frame, sample: Sample) -> NDArray[np.float32]:
    """Return (N,) of each of the sample's true boxes the share that the ego sees."""
    row = [agent.agent_id for agent in frame.agents].index(sample.agent_ids[0])
    return frame.visible_fraction[row][np.searchsorted(frame.truth.object_id, sample.boxes.object_id)]


def corruption_kinds(names: Sequence[str], family: Family = "physical", where: str = "evaluate") -> tuple[str, ...]:
    """Return corruptions by name, in the order of `CORRUPTIONS`.

    Args:
        names: kinds, `paper_six` for those of the paper's tables, `all` for all of the family, `clean` for none.
        family: of their settings.
        where: what asks, for messages.

    Raises:
        SettingsError: there is no such corruption or family, or the family has no model of it.
    """
    groups = {CLEAN: (), PAPER_TABLE: registry.PAPER_SIX, ALL: registry.kinds_of(family)}
    for name in names:
        if name not in (*groups, *registry.CORRUPTIONS):
            hint = did_you_mean(name, [*groups, *registry.CORRUPTIONS])
            raise SettingsError(complaint(where, "corruptions", "a corruption", name, hint))
        if name not in groups:
            try:
                registry.require_corruption(name, family=family)
            except SettingsError as error:
                raise SettingsError(f"{where}: corruptions: {error}") from None
    wanted = {kind for name in names for kind in groups.get(name, (name,))}
    return tuple(kind for kind in registry.CORRUPTIONS if kind in wanted)


def corrupted(frame: Frame, condition: Condition, seed: int) -> Frame:
    """Return the frame as the sensors deliver it under a condition; `seed` is the drive's."""
    if condition.kind == CLEAN:
        return frame
    return registry.corrupt_frame(frame, condition.kind, condition.severity, seed, condition.family)


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


def warn_of_slow_drives(readers: Sequence[Drive]) -> None:
    """Say which drives have no frames between that a channel could deliver."""
    for reader in readers:
        step_s = interval_of(reader)
        if step_s > _SENSOR_S + 1e-6:
            _log.warning(
                "%s: its frames are %g s apart: a message that is late by less than that is as old as the frame before",
                *(reader.drive, step_s),
            )


def interval_of(reader: Drive) -> float:
    """Return the time between the first two frames of a drive, s; 0.1 s where there is but one."""
    step = reader.read(1).time_s - reader.read(0).time_s if len(reader) > 1 else 0.0
    return step if step > 0.0 else _SENSOR_S


def check_names(names: Sequence[str]) -> None:
    """Raise SettingsError where a method's name comes twice."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise SettingsError(complaint("evaluate", "methods", "names that differ", repeated[0]))


def check_numbers(where: str, severities: Sequence[int], seed: int, limit: int | None) -> None:
    """Raise SettingsError where one is out of its range; `where` is for the message."""
    for severity in severities:
        if not 1 <= severity <= 5:
            raise SettingsError(complaint(where, "severity", "1 to 5", severity))
    if seed < 0:
        raise SettingsError(complaint(where, "seed", "at least 0", seed))
    if limit is not None and limit < 1:
        raise SettingsError(complaint(where, "limit", "at least 1 frame", limit))


def places_of(readers: Sequence[Drive], limit: int | None) -> list[list[int]]:
    """Return of each drive the positions of the frames to evaluate: all, or `limit` of them evenly spread over all.

    Raises:
        DataError: there is none.
    """
    places = [(k, i) for k, reader in enumerate(readers) for i in range(len(reader.frames))]
    if not places:
        raise DataError(complaint("evaluate", "drives", "at least one frame", "none"))
    if limit is not None and limit < len(places):
        places = [places[i] for i in np.linspace(0, len(places) - 1, limit).round().astype(int)]
    return [[i for drive, i in places if drive == k] for k in range(len(readers))]


def _sample(
    frame: Frame, method: Method, samples: dict[tuple[GridSpec, int, int | None], Sample], drive: str
) -> Sample:
    """Return what a method sees; methods with one grid and number of agents share it."""
    settings = method.detector.settings
    key = (settings.grid, getattr(settings, "max_agents", 5), method.agents)
    if key not in samples:
        if method.agents is None:
            sample = make_sample(frame, None, key[0], max_agents=key[1])
            samples[key] = replace(sample, key=f"{drive}/{sample.key}")
        else:
            whole = _sample(frame, replace(method, agents=None), samples, drive)
            samples[key] = first_agents(whole, method.agents)
    return samples[key]


def first_agents(sample: Sample, count: int) -> Sample:
    """Return what the ego has of itself and the first of its collaborators, `count` together; the truth stays."""
    return replace(
        sample,
        agent_ids=sample.agent_ids[:count],
        clouds=sample.clouds[:count],
        ego_from_agent=sample.ego_from_agent[:count],
        agent_boxes=sample.agent_boxes[:count],
        lost=sample.lost[:count],
    )
