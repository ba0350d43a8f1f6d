"""Computation of cells: detectors on some frames of a drive under one condition, the unit of work of a benchmark.

All that this module imports, at any depth, is hashed into the keys of cells, see `sim.kept.code_hash`.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, cast

from dsrc.data.drives import Drive, open_drive
from dsrc.data.sample import SampleDetector
from dsrc.detectors.open import detector_sha256, open_detector, process_of
from dsrc.evaluation.cache import CellSettings, write_cell
from dsrc.evaluation.detect import Method, evaluate_drive
from dsrc.messages.defences import NO_DEFENCE, parse_defence
from dsrc.models.device import one_thread
from dsrc.runs.unit import Progress, Unit
from sensors.corruptions import Condition
from sim.errors import DataError, complaint
from sim.radio import ChannelSpec

_Device = Literal["cpu", "cuda"]


@dataclass(frozen=True, slots=True)
class CellJob:
    """One cell to compute.

    Attributes:
        settings: of the cell.
        text: detector, as `open_detector` takes it.
        drive: path of the drive.
        condition: of the sweeps.
        agents: most agents that take part; None for the detector's own number.
        channel: radio channel; None where no message is sent.
    """

    settings: CellSettings
    text: str
    drive: Path
    condition: Condition
    agents: int | None
    channel: ChannelSpec | None


def make_cells(unit: Unit[CellJob], progress: Progress) -> None:
    """Compute and write cells of the same frames under the same condition: each frame is corrupted once for all."""
    methods = [_method(key, job) for key, job in unit.jobs.items()]
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


def _method(key: str, job: CellJob) -> Method:
    use = job.settings.use
    defence = parse_defence(str(use.get("defence", NO_DEFENCE)), "evaluate")
    return Method(key, detector_of(job), job.agents, job.channel, str(use.get("messages", "")), defence)


def detector_of(job: CellJob) -> SampleDetector:
    """Return the detector of a cell, opened once per process."""
    settings, use = job.settings, tuple(sorted(job.settings.use.items()))
    detector = _opened(job.text, settings.detector, use, settings.engine, cast(_Device, settings.device))
    process = process_of(detector)
    if process is not None and detector_sha256(job.text, process) != settings.detector:
        raise DataError(complaint(job.text, "name", "that with which the evaluation began", process.name))
    return detector


@lru_cache(maxsize=64)
def _opened(
    text: str,
    sha256: str,
    use: tuple[tuple[str, bool | int | float | str], ...],
    engine: str,
    device: _Device,
) -> SampleDetector:
    """Return a detector; the key has its hash, so that a changed one is opened again."""
    return open_detector(text, device, engine, dict(use))


@lru_cache(maxsize=4)
def drive_of(path: Path) -> Drive:
    """Return the reader of a drive, opened once per process while it is used."""
    return open_drive(path)
