"""Computation of cells: detectors on some frames of a drive under one condition, the unit of work of a benchmark.

All that this module imports, at any depth, is hashed into the keys of cells, see `sim.kept.code_hash`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec

from dsrc.data.drives import Drive, open_drive
from dsrc.evaluation.cache import CellSettings, write_cell
from dsrc.evaluation.detect import Method, evaluate_drive
from dsrc.models.detector import Detector
from dsrc.models.device import one_thread
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_student
from dsrc.runs.unit import Progress, Unit
from sensors.corruptions import Condition
from sim.errors import SettingsError
from sim.radio import ChannelSpec
from sim.settings import convert


@dataclass(frozen=True, slots=True)
class CellJob:
    """One cell to compute.

    Attributes:
        settings: of the cell.
        path: detector file.
        drive: path of the drive.
        condition: of the sweeps.
        agents: most agents that take part; None for the detector's own number.
        channel: radio channel; None where no message is sent.
    """

    settings: CellSettings
    path: Path
    drive: Path
    condition: Condition
    agents: int | None
    channel: ChannelSpec | None


def make_cells(unit: Unit[CellJob], progress: Progress) -> None:
    """Compute and write cells of the same frames under the same condition: each frame is corrupted once for all."""
    methods = [Method(key, detector_of(job), job.agents, job.channel) for key, job in unit.jobs.items()]
    first, frames = next(iter(unit.jobs.values())), 0
    positions = first.settings.positions

    def count_frame() -> None:
        nonlocal frames
        frames += 1
        progress(frames, len(positions))

    with one_thread():
        work = {first.condition: methods}
        results = evaluate_drive(drive_of(first.drive), positions, work, first.settings.seed, count_frame)
    for key, job in unit.jobs.items():
        write_cell(unit.folder, job.settings, results[first.condition, key])


def load_adjusted(path: Path, use: Mapping[str, bool | int | float | str], engine: str = "fused") -> Detector:
    """Load a detector file, with some of its settings changed.

    Args:
        use: changes, see `MethodSpec`.
        engine: one of `dsrc.models.storage.deploy.ENGINES`.

    Raises:
        CheckpointError: the file is missing, damaged or a teacher's.
        SettingsError: a setting is out of its range, contradicts the others, or the engine is unknown.
    """
    detector = load_student(path, engine=engine)
    if use:
        changed = {**msgspec.to_builtins(detector.settings), **use}
        settings = convert(changed, ModelSettings, f"{path}: use", SettingsError)
        try:
            detector.settings = settings
        except ValueError as error:
            raise SettingsError(f"{path}: use: {' '.join(str(error).split())}") from None
    return detector


def detector_of(job: CellJob) -> Detector:
    """Return the detector of a cell, loaded once per process."""
    settings, use = job.settings, tuple(sorted(job.settings.use.items()))
    return _loaded(job.path, settings.detector, use, settings.engine).to(settings.device)


@lru_cache(maxsize=64)
def _loaded(path: Path, sha256: str, use: tuple[tuple[str, bool | int | float | str], ...], engine: str) -> Detector:
    """Return a detector; the key has the file's hash, so that a changed file is loaded again."""
    return load_adjusted(path, dict(use), engine)


@lru_cache(maxsize=4)
def drive_of(path: Path) -> Drive:
    """Return the reader of a drive, opened once per process while it is used."""
    return open_drive(path)
