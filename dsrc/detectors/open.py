"""The door of detectors: any detector by the text that `--checkpoint` takes."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from dsrc.data.sample import SampleDetector
from dsrc.detectors.classes import OwnDetector, class_hash, load_own
from dsrc.detectors.levelled import RECORDED, LevelledDetector, check_height, levelled
from dsrc.detectors.line import process_sha256
from dsrc.detectors.onnx_file import open_onnx, runtime_version
from dsrc.detectors.process import ProcessDetector
from dsrc.detectors.texts import kind_of
from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_student
from sim.errors import CheckpointError, SettingsError, complaint
from sim.files import file_sha256
from sim.settings import convert

Use = Mapping[str, bool | int | float | str]
"""Model settings that are changed in use."""


def open_detector(
    text: str | Path, device: Literal["cpu", "cuda"] = "cpu", engine: str = "fused", use: Use | None = None
) -> SampleDetector:
    """Open a detector.

    Args:
        text: a detector file, `FILE.onnx`, `module:Class` of one's own, `pipe:COMMAND ...` or `tcp://localhost:PORT`.
        device: of the network of a detector file.
        engine: execution of the network of a detector file, see `dsrc.models.storage.deploy.ENGINES`.
        use: changed settings of a detector file, see `dsrc.evaluation.config.MethodSpec`; `height` of any detector, see
            `dsrc.detectors.levelled`. With `messages` its agents detect alone.

    Raises:
        CheckpointError: a file is missing, damaged or a teacher's.
        SettingsError: a class does not load, a process is not named, a setting is out of its range or of a detector
            that has none.
        DataError: a process does not answer.
    """
    text, changes = str(text), dict(use or {})
    changes.pop("defence", None)  # the ego's, not the detector's
    height = check_height(text, changes.pop("height", RECORDED))
    return levelled(_opened(text, device, engine, changes), height)


def _opened(text: str, device: Literal["cpu", "cuda"], engine: str, use: Use) -> SampleDetector:
    kind = kind_of(text)
    if kind == "file":
        changes = dict(use)
        fusion = "late" if changes.pop("messages", None) else ""
        return _adjusted(load_student(Path(text), device, engine, fusion), text, changes)
    if use:
        raise SettingsError(complaint(text, "use", "none beside a detector of one's own", ", ".join(use)))
    if kind == "onnx":
        return open_onnx(Path(text))
    if kind == "class":
        return OwnDetector(load_own(text, "detector", "detect", "detect"), text)
    return ProcessDetector(text)


def _adjusted(detector: Detector, text: str, use: Use) -> Detector:
    if use:
        changed = {**msgspec.to_builtins(detector.settings), **use}
        settings = convert(changed, ModelSettings, f"{text}: use", SettingsError)
        try:
            detector.settings = settings
        except ValueError as error:
            raise SettingsError(f"{text}: use: {' '.join(str(error).split())}") from None
    return detector


def detector_sha256(text: str | Path, detector: SampleDetector | None = None) -> str:
    """Return the SHA-256 of all that tells a detector from others, for the keys of its results.

    It is that of a detector file; of an ONNX file, its external data and the version of its runtime; of the name of a
    class and its source; of the command or address of a process, the name that it says, and the files among the
    command's words.

    Args:
        detector: opened; needed of a process, which is opened where it is left out.
    """
    text, kind = str(text), kind_of(str(text))
    if kind == "class":
        return class_hash(text)
    if kind in ("file", "onnx"):
        if not Path(text).is_file():
            raise CheckpointError(f"{text}: no such checkpoint file")
        own = file_sha256(Path(text))
        return own if kind == "file" else _hash_of([own, _external_data(Path(text)), runtime_version()])
    inner = process_of(detector)
    opened = inner or ProcessDetector(text)
    if opened is not inner:
        opened.close()
    return process_sha256(text, opened.name)


def close_detector(detector: SampleDetector) -> None:
    """End the process of a detector that has one."""
    process = process_of(detector)
    if process is not None:
        process.close()


def process_of(detector: SampleDetector | None) -> ProcessDetector | None:
    """Return the detector that a process is, levelled or not; None of another."""
    inner = detector.inner if isinstance(detector, LevelledDetector) else detector
    return inner if isinstance(inner, ProcessDetector) else None


_LOCATION = re.compile(rb"\x0a\x08location\x12([\x01-\x7f])")
"""Entry of a tensor's external data, the key `location` and the length of its value, as onnx.proto has it."""


def _external_data(path: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that hold weights of an ONNX file, by their names."""
    content = path.read_bytes()
    places = {content[one.end() : one.end() + one[1][0]] for one in _LOCATION.finditer(content)}
    files = {name: path.parent / name for name in sorted(place.decode(errors="replace") for place in places)}
    return {name: file_sha256(file) for name, file in files.items() if file.is_file()}


def _hash_of(value: Any) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()
