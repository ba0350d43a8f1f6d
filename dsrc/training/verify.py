"""Verification of a run folder: its detector against the recorded hashes, settings, versions and metrics."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from dsrc.data.drives import drive_hashes, list_drives
from dsrc.models.detector import Detector
from dsrc.models.device import BFLOAT16
from dsrc.models.inputs.batch import Batch
from dsrc.models.storage.checkpoint import load_detector, read_meta
from dsrc.models.storage.deploy import ENGINES
from dsrc.runs.provenance import versions
from dsrc.training.datamodule import DetectionData
from dsrc.training.recipes import Recipe, of_today
from dsrc.training.run_folder import DETECTOR, RESULT, SETTINGS, Record, RecordedSettings
from dsrc.training.validation import best_device, frames_named, validate
from sim.errors import CheckpointError, DataError, complaint
from sim.files import file_sha256
from sim.reading import read_bytes

AP_TOLERANCE = 0.002
"""Tolerance of average precisions: other processors sum in another order, and detections cross thresholds."""
BFLOAT16_TOLERANCE = 0.015
"""Tolerance of average precisions in bfloat16, as of one condition in `studies/bf16_gate.py`."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of a recorded value with the one found."""

    name: str
    recorded: object
    found: object
    agrees: bool

    def __str__(self) -> str:
        if self.agrees:
            return f"agrees   {self.name}: {self.recorded}"
        return f"differs  {self.name}: recorded {self.recorded}, found {self.found}"


class _Meta(msgspec.Struct, frozen=True):
    """Provenance in a detector file; empty in one of another origin."""

    settings: RecordedSettings | None = None
    seed: int | None = None
    teacher: str | None = None
    init: dict[str, Any] | None = None
    epoch: int | None = None


class _Result(msgspec.Struct, frozen=True):
    """Result of a run, `result.json`."""

    detector: str
    epoch: int
    metrics: dict[str, float]


Document = TypeVar("Document", Record, _Result)


def runs_in(folder: Path) -> list[Path]:
    """List the run folders of a training: the folder itself, or one per stage.

    Raises:
        DataError: there is no run folder.
    """
    found = [folder] if (folder / SETTINGS).is_file() else sorted(path.parent for path in folder.glob(f"*/{SETTINGS}"))
    if not found:
        raise DataError(complaint(folder, SETTINGS, "the run folder of a training", "none here or one folder below"))
    return found


def verify(
    run: Path,
    data: Path | None = None,
    validation: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Comparison]:
    """Evaluate a run's detector on its validation frames again and compare everything with the record.

    Without validation drives and a hold-out these are training frames, and the comparison says so.

    Compared are the hash and the settings of the detector file, the hashes of the data, package versions, teacher,
    start and epoch if recorded, and the average precisions within `AP_TOLERANCE`. A student on a CPU is also run as it
    is used: fused, and in bfloat16 where the processor computes it, there within `BFLOAT16_TOLERANCE`.

    Args:
        data: folder of its training drives, if they have moved.
        validation: folder of its validation drives, if they have moved.
        progress: called with the numbers of finished and of all frames.

    Raises:
        DataError: the folder is not a finished run, or the data is missing.
        CheckpointError: the detector is missing or damaged.
    """
    record, result = _read(run / SETTINGS, Record), _read(run / RESULT, _Result)
    try:
        recipe = msgspec.convert(of_today(record.settings.recipe), Recipe)
    except (msgspec.ValidationError, KeyError, TypeError) as error:
        raise DataError(complaint(run / SETTINGS, "recipe", "one of this version", str(error))) from None
    settings = recipe.settings(record.settings.stage)
    detector = load_detector(run / DETECTOR, best_device())
    meta = _meta(run / DETECTOR)
    drives = _drives(run, "data", data, record.folders.get("data"))
    held = None
    if record.validation is not None:
        held = _drives(run, "validate", validation, record.folders.get("validate"))
    loaders = DetectionData(recipe, settings, drives, held, record.seed)
    checks = [
        _same("detector.pt, SHA-256", result.detector, file_sha256(run / DETECTOR)),
        *_fields("model", _plain(settings), _plain(detector.settings)),
        *_fields("recipe", record.settings.recipe, meta.settings.recipe if meta.settings else {}),
        _same("seed", record.seed, meta.seed),
        *_fields("teacher", _known(sha256=record.teacher), _known(sha256=meta.teacher)),
        *_fields("start", record.init or {}, meta.init or {}),
        *([] if meta.epoch is None else [_same("epoch", result.epoch, meta.epoch)]),
        *_fields("data", record.data, drive_hashes(drives)),
        *_fields("validation data", record.validation or {}, drive_hashes(held or [])),
        *_fields("version", record.versions, versions()),
    ]
    unseen = loaders.validates_on_unseen
    before = _bare(result.metrics)
    engines = _engines(detector)
    batches = loaders.validation_batches()
    for turn, (engine, tolerance) in enumerate(engines.items()):
        counted = _counted(batches, turn * len(batches), len(engines) * len(batches), progress)
        found = _bare(validate(ENGINES[engine](detector), counted, unseen))
        for name in {**found, **before}:
            recorded, now = before.get(name), found.get(name)
            agrees = recorded is not None and now is not None and abs(recorded - now) <= tolerance
            where = f"{name} on {frames_named(unseen)}{'' if engine == 'plain' else f', engine {engine}'}"
            checks.append(Comparison(where, _rounded(recorded), _rounded(now), agrees))
    return checks


def _engines(detector: Detector) -> dict[str, float]:
    """Return the engines that a detector can run by here, each with the tolerance of its average precisions."""
    if detector.settings.role != "student" or detector.cls_head.weight.device.type != "cpu":
        return {"plain": AP_TOLERANCE}
    half = {"bf16": BFLOAT16_TOLERANCE} if BFLOAT16 else {}
    return {"plain": AP_TOLERANCE, "fused": AP_TOLERANCE} | half


def _meta(path: Path) -> _Meta:
    try:
        return msgspec.convert(_plain(read_meta(path)), _Meta)
    except (TypeError, ValueError, msgspec.ValidationError) as error:
        raise CheckpointError(complaint(path, "meta", "what a training has written", str(error))) from None


def _read(path: Path, kind: type[Document]) -> Document:
    if not path.is_file():
        raise DataError(
            complaint(path, "file", "that of a finished training", "none", "; `dsrc model train` resumes it")
        )
    try:
        return msgspec.json.decode(read_bytes(path, "record of a training"), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(complaint(path, "file", "what a training has written", str(error))) from None


def _drives(run: Path, option: str, given: Path | None, recorded: str | None) -> list[Path]:
    """List the drives of the given or else the recorded folder."""
    folder = given or (Path(recorded) if recorded else None)
    if folder is None or not _is_there(folder):
        raise DataError(complaint(run, option, "the folder of its drives", folder, f"; say where it is: --{option}"))
    return list_drives(folder)


def _is_there(folder: Path) -> bool:
    try:
        return folder.exists()
    except OSError:  # a name too long for the system
        return False


def _same(name: str, recorded: object, found: object) -> Comparison:
    return Comparison(name, recorded, found, recorded == found)


def _fields(name: str, recorded: dict[str, Any], found: dict[str, Any]) -> list[Comparison]:
    """Compare two tables: one comparison if they agree, else one per entry that differs."""
    differ = [key for key in {**recorded, **found} if recorded.get(key) != found.get(key)]
    if not differ:
        return [Comparison(name, f"all {len(recorded)}", None, True)] if recorded else []
    return [_same(f"{name} {key}", recorded.get(key), found.get(key)) for key in differ]


def _plain(settings: object) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(settings))
    return plain


def _bare(metrics: dict[str, float]) -> dict[str, float]:
    """Return metrics by name alone: a run's frames follow from its record, not from how it called them."""
    return {name.rpartition("/")[2]: value for name, value in metrics.items()}


def _rounded(value: float | None) -> str:
    return "nothing" if value is None else f"{value:.4f}"


def _known(**values: object) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _counted(
    batches: Iterable[Batch], before: int, total: int, progress: Callable[[int, int], None]
) -> Iterator[Batch]:
    for done, batch in enumerate(batches, start=before + 1):
        yield batch
        progress(done, total)


def agree(checks: Sequence[Comparison]) -> bool:
    """Return whether all comparisons agree."""
    return all(check.agrees for check in checks)
