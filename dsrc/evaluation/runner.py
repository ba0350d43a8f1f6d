"""Runs a benchmark: cells that are missing are made, by any number of processes; rows are made of cells.

A benchmark that was killed goes on, and a method that was added costs its own cells alone. A unit of work is some
frames of a drive under one condition: each frame is read and corrupted once for all detectors that lack it.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import torch

from dsrc.data.drive_folder import locked
from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.executors import Pool, Progress
from dsrc.evaluation.benchmark import Condition, Method, Tally, evaluate_drive, joined, places_of, warn_of_slow_drives
from dsrc.evaluation.cache import (
    CellSettings,
    code_hash,
    described,
    has_cell,
    of_channel,
    read_cell,
    relevant_versions,
    write_cell,
)
from dsrc.evaluation.config import Benchmark, Case, cases_of
from dsrc.evaluation.metrics.ap import metric_name, result_of
from dsrc.evaluation.metrics.intervals import Hits
from dsrc.evaluation.results import Row, make_row
from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_student, read_meta
from sim.errors import SettingsError, UserError, complaint
from sim.files import file_sha256
from sim.radio import ChannelSpec

Device = Literal["cpu", "cuda"]

CHUNK = 50
"""Frames of a unit of work: so many are lost at most when a process is killed."""

VISIBILITY = {"hidden": (0.0, 0.1), "partly": (0.1, 0.6), "open": (0.6, 1.01)}
"""Classes of true boxes by the share of the ego's rays on them that nothing else stops; what is so far away that not
even a free view has a ray on it is hidden."""


@dataclass(frozen=True, slots=True)
class Trained:
    """A detector of a method.

    Attributes:
        path: its file.
        sha256: of the file.
        settings: of the network, as it is used.
        seed: of its training; None where the file does not say.
        use: see `MethodSpec`.
        recipe: of its training; "" where the file does not say.
    """

    path: Path
    sha256: str
    settings: ModelSettings
    seed: int | None
    use: dict[str, bool | int | float]
    recipe: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """A row of the result.

    Attributes:
        case: what it is of.
        row: the numbers.
        cells: keys of what it was made of.
        hits: detections, of a method whose differences are asked for and where nothing is swept; else None.
    """

    case: Case
    row: Row
    cells: tuple[str, ...]
    hits: Hits | None = field(default=None, compare=False, repr=False)

    @property
    def digest(self) -> str:
        """Hash of the cells' keys, and so of all settings of the row."""
        return hashlib.sha256("".join(self.cells).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a benchmark found.

    Attributes:
        plan: what was asked for.
        trained: by method its detectors.
        drives: by dataset its drives and their hashes.
        frames: by dataset the evaluated frames of each drive.
        entries: the rows.
        made: cells that were made in this run.
    """

    plan: Benchmark
    trained: dict[str, list[Trained]]
    drives: dict[str, dict[str, str]]
    frames: dict[str, tuple[int, ...]]
    entries: list[Entry]
    made: int


@dataclass(frozen=True, slots=True)
class Job:
    """One cell to make: which detector, how many agents, through which channel."""

    settings: CellSettings
    path: Path
    agents: int | None
    channel: ChannelSpec | None


@dataclass(frozen=True, slots=True)
class Unit:
    """Cells of the same frames under the same condition, made together.

    Attributes:
        folder: of the cells.
        drive: its path.
        positions: of the frames.
        condition: of the sweeps.
        seed: of corruptions and channels.
        device: of the networks.
        jobs: the cells.
    """

    folder: Path
    drive: Path
    positions: tuple[int, ...]
    condition: Condition
    seed: int
    device: Device
    jobs: tuple[Job, ...]


def run_plan(
    plan: Benchmark, out: Path, workers: int = 1, device: Device = "cpu", progress: Progress | None = None
) -> Outcome:
    """Make the cells that are missing in `out/cells`, and rows of all.

    Args:
        plan: see `dsrc.evaluation.config.check`.
        out: folder of the benchmark.
        workers: processes, of one thread each; the cells are the same for any number.
        device: of the networks.
        progress: called with detections done and those that were missing at the start.

    Raises:
        UserError: a file, a drive or a setting is wrong. What is not concerned has been done.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise SettingsError(complaint("benchmark", "device", "a GPU that torch can use", "none", "; use cpu"))
    trained = {m.name: [_trained(Path(path), m.use) for path in m.detectors] for m in plan.methods}
    for name, several in trained.items():
        for other in several[1:]:
            if other.settings != several[0].settings:
                raise SettingsError(
                    complaint(other.path, "settings", f"those of {several[0].path}, which is '{name}' too", "others")
                )
    datasets = {d.name: [r for folder in d.drives for r in _readers(folder)] for d in plan.datasets}
    places = {name: places_of(readers, plan.limit) for name, readers in datasets.items()}
    drives = {name: {str(r.drive): r.digest() for r in readers} for name, readers in datasets.items()}
    cases = cases_of(plan)
    folder = out / "cells"
    with locked(out, what="benchmark"):
        plans = [_jobs(plan, case, trained, datasets, places, drives, device) for case in cases]
        if any(job.channel is not None and job.channel.medium != "perfect" for jobs in plans for job, *_ in jobs):
            warn_of_slow_drives([reader for readers in datasets.values() for reader in readers])
        units = _units(folder, plan.seed, device, zip(cases, plans, strict=True))
        _make(units, workers, progress)
        told_apart = {name for pair in plan.differences for name in (pair.method, pair.baseline)}
        entries = [
            _entry(case, folder, [job.settings.key for job, *_ in jobs], case.method in told_apart and not case.swept)
            for case, jobs in zip(cases, plans, strict=True)
        ]
    named = {name: {Path(p).name: digest for p, digest in listed.items()} for name, listed in drives.items()}
    frames = {name: tuple(map(len, positions)) for name, positions in places.items()}
    return Outcome(plan, trained, named, frames, entries, sum(len(unit.jobs) for unit in units))


def _trained(path: Path, use: dict[str, bool | int | float]) -> Trained:
    settings, meta = load_used(path, use).settings, read_meta(path)
    seed, recipe = meta.get("seed"), meta.get("settings")
    for name in ("recipe", "name"):
        recipe = recipe.get(name) if isinstance(recipe, Mapping) else None
    seed, recipe = seed if isinstance(seed, int) else None, recipe if isinstance(recipe, str) else ""
    return Trained(path, file_sha256(path), settings, seed, use, recipe)


def load_used(path: Path, use: Mapping[str, bool | int | float]) -> Detector:
    """Read a detector file for use with some of its settings changed.

    Raises:
        CheckpointError: the file is missing, damaged or a teacher's.
        SettingsError: a setting is out of its range, or does not go with the others.
    """
    detector = load_student(path)
    if use:
        try:
            detector.settings = msgspec.convert({**msgspec.to_builtins(detector.settings), **use}, ModelSettings)
        except (msgspec.ValidationError, ValueError) as error:
            raise SettingsError(f"{path}: use: {' '.join(str(error).split())}") from None
    return detector


def _readers(folder: str) -> list[Drive]:
    return [open_drive(drive) for drive in list_drives(Path(folder))]


Piece = tuple[Job, Path, tuple[int, ...]]


def _jobs(
    plan: Benchmark,
    case: Case,
    trained: dict[str, list[Trained]],
    datasets: dict[str, list[Drive]],
    places: dict[str, list[list[int]]],
    drives: dict[str, dict[str, str]],
    device: Device,
) -> list[Piece]:
    """Return the cells of a row, with their drives and frames."""
    one = trained[case.method][case.training]
    most = 1 if one.settings.fusion == "none" else one.settings.max_agents
    agents = min(case.agents or most, most)
    # Who is alone gets no messages: the same through every channel.
    channel = case.spec() if agents > 1 else None
    condition, listed = described(case.condition), None if channel is None else of_channel(channel)
    pieces = []
    for reader, positions in zip(datasets[case.dataset], places[case.dataset], strict=True):
        for start in range(0, len(positions), CHUNK):
            chunk = tuple(positions[start : start + CHUNK])
            settings = CellSettings(
                detector=one.sha256,
                use=one.use,
                drive=reader.drive.name,
                data=drives[case.dataset][str(reader.drive)],
                positions=chunk,
                seed=plan.seed,
                agents=agents,
                device=device,
                versions=relevant_versions(),
                code=code_hash(),
                condition=condition,
                channel=listed,
            )
            limit = None if agents == one.settings.max_agents else agents
            pieces.append((Job(settings, one.path, limit, channel), reader.drive, chunk))
    return pieces


def _units(folder: Path, seed: int, device: Device, planned: Iterable[tuple[Case, list[Piece]]]) -> list[Unit]:
    """Return the work that is left: cells that are missing or damaged, by frames and condition."""
    groups: dict[tuple[Path, tuple[int, ...], Condition], dict[str, Job]] = {}
    for case, pieces in planned:
        for job, drive, positions in pieces:
            if not has_cell(folder, job.settings.key):
                groups.setdefault((drive, positions, case.condition), {})[job.settings.key] = job
    return [
        Unit(folder, drive, positions, condition, seed, device, tuple(jobs.values()))
        for (drive, positions, condition), jobs in groups.items()
    ]


def _make(units: Sequence[Unit], workers: int, progress: Progress | None) -> None:
    """Make the cells of all units; the first user's error is raised when the others are done."""
    total = sum(len(unit.positions) * len(unit.jobs) for unit in units)
    done = [0] * len(units)

    def tell(row: int, frames: int, wanted: int) -> None:
        done[row] = frames * len(units[row].jobs)
        if progress is not None:
            progress(sum(done), total)

    if progress is not None:
        progress(0, total)
    errors: list[UserError] = []
    with Pool(workers).open() as executor:
        for result in executor.run(make_unit, units, tell):
            if result.error is not None:
                errors.append(result.error)
    if errors:
        raise errors[0]


def make_unit(unit: Unit, report: Progress) -> None:
    """Make the cells of a unit: a task of an executor."""
    methods = [Method(job.settings.key, _detector(job, unit.device), job.agents, job.channel) for job in unit.jobs]
    frames = 0

    def tell() -> None:
        nonlocal frames
        frames += 1
        report(frames, len(unit.positions))

    with _one_thread():
        tallies = evaluate_drive(_reader(unit.drive), unit.positions, {unit.condition: methods}, unit.seed, tell)
    for job in unit.jobs:
        write_cell(unit.folder, job.settings, tallies[unit.condition, job.settings.key])


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch work on one thread: with the number of threads the last digits of a network's numbers change."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _detector(job: Job, device: Device) -> Detector:
    return _loaded(job.path, job.settings.detector, tuple(sorted(job.settings.use.items())), device)


@lru_cache(maxsize=64)
def _loaded(path: Path, sha256: str, use: tuple[tuple[str, bool | int | float], ...], device: Device) -> Detector:
    """Return a detector; the hash is there so that a file that has changed is read again."""
    return load_used(path, dict(use)).to(device)


@lru_cache(maxsize=4)
def _reader(drive: Path) -> Drive:
    return open_drive(drive)


def _entry(case: Case, folder: Path, keys: list[str], keeps_hits: bool) -> Entry:
    tally = joined([read_cell(folder, key) for key in keys])
    result = result_of(tally.judged)
    row = make_row(case.method, case.condition.kind, case.condition.severity, result, tally.seconds, tally.traffic)
    # Who is alone was sent nothing.
    sent = 0.0 if row.bytes_per_frame is None else row.bytes_per_frame
    metrics = {**row.metrics, **by_visibility(tally)}
    row = replace(row, metrics=metrics, bytes_per_frame=sent, result=None)
    return Entry(case, row, tuple(keys), Hits.of(tally.judged) if keeps_hits else None)


def by_visibility(tally: Tally) -> dict[str, float]:
    """Return the average precision of each class of `VISIBILITY`; nothing where nobody knows what the ego sees."""
    if not np.isfinite(tally.ego_share).any():
        return {}
    share = np.nan_to_num(tally.ego_share, nan=0.0)
    named = {}
    for name, (low, high) in VISIBILITY.items():
        result = result_of(tally.judged, (share >= low) & (share < high))
        for threshold in (0.5, 0.7):
            named[f"{metric_name('bev', threshold)}_{name}"] = result.curves["bev", threshold].ap
    return named
