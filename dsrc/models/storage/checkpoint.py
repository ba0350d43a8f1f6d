"""Detector files: weights, settings and provenance, loaded without running code from the file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import torch
from msgspec.structs import replace

from dsrc.models.detector import Detector
from dsrc.models.joined import JoinedDetectors
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.deploy import ENGINES, engine_for
from dsrc.models.storage.published import filled
from dsrc.models.storage.tensors import is_plain, read_tensors
from dsrc.ops.anchors import ANCHORS
from sim.errors import CheckpointError, complaint
from sim.files import replacing

FORMAT = "dsrc-detector-1"
JOINED = "dsrc-detectors-1"
"""Format of a file of several detectors of different road users."""
_MOST_BLOCKS = 1000


def save_detector(path: Path, detector: Detector, meta: Mapping[str, object] | None = None, half: bool = True) -> None:
    """Write a detector file atomically.

    Args:
        detector: detector whose weights and settings are stored.
        meta: provenance of the weights; values that are not plain are stored as text.
        half: store floats in half precision: half the size, and differences far below those of two trainings.
    """
    state = {name: _stored(tensor, half) for name, tensor in detector.state_dict().items()}
    content = {"format": FORMAT, "settings": msgspec.to_builtins(detector.settings), "state": state}
    content["meta"] = msgspec.to_builtins(dict(meta or {}), enc_hook=str)
    _save(path, content)


def _save(path: Path, content: Mapping[str, object]) -> None:
    # By way of an open file: PyTorch keeps the name of a path in the archive.
    with replacing(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def join_files(paths: Sequence[Path], out: Path) -> None:
    """Join detector files of different road users into one, which `load_joined` reads.

    Raises:
        CheckpointError: a file is missing, damaged or not one student.
        SettingsError: the detectors do not go together, see `JoinedDetectors`.
    """
    contents = [_content(Path(path)) for path in paths]
    JoinedDetectors([_student(path, part, "cpu", "plain") for path, part in zip(paths, contents, strict=True)])
    _save(out, {"format": JOINED, "detectors": contents})


def load_detector(path: Path, device: str = "cpu", engine: str = "plain") -> Detector:
    """Read a detector file, in evaluation mode.

    Args:
        engine: `plain` for the network as it is trained, else for inference alone: `auto` for the fastest, or a key of
            `ENGINES`, see `engine_for`.

    Raises:
        CheckpointError: the file is missing, damaged, not a detector, or of another version of the network.
        SettingsError: the engine is unknown, or missing on this machine.
    """
    detector = _detector(path, _content(Path(path))).to(device)
    return ENGINES[engine_for(path, engine, device)](detector)


def _detector(path: Path, content: Mapping[str, object]) -> Detector:
    state = content.get("state")
    try:
        settings = msgspec.convert(content["settings"], ModelSettings)
        if max(settings.stage_blocks) > _MOST_BLOCKS:
            raise ValueError(f"a stage of {max(settings.stage_blocks)} blocks")
    except Exception as error:  # of the parts, which check their own settings
        raise CheckpointError(complaint(path, "settings", "those of a detector", str(error))) from None
    if not isinstance(state, dict) or not all(map(is_plain, state.values())):
        raise CheckpointError(complaint(path, "state", "dense tensors by name", "something else"))
    return filled(path, settings, {name: (name, tensor) for name, tensor in state.items()})


def load_student(path: Path, device: str = "cpu", engine: str = "fused", fusion: str = "") -> Detector:
    """Read a student for inference, optimised by `dsrc.models.storage.deploy`.

    Args:
        engine: key of `ENGINES`, or `auto`, see `engine_for`.
        fusion: fusion method in place of its own, see `with_fusion`; "" for its own.

    Raises:
        CheckpointError: as `load_detector`, or the file holds a teacher.
        SettingsError: the engine is unknown, or missing on this machine.
    """
    return _student(path, _content(Path(path)), device, engine, fusion)


def load_joined(path: Path, device: str = "cpu", engine: str = "fused", fusion: str = "") -> Detector | JoinedDetectors:
    """Read the students of a detector file, one or several that are joined; arguments and errors as `load_student`.

    Args:
        fusion: fusion method in place of theirs, see `with_fusion`; "" for theirs.

    Raises:
        SettingsError: the detectors do not go together.
    """
    content = _content(Path(path), (FORMAT, JOINED))
    parts = content.get("detectors") if content["format"] == JOINED else [content]
    if not isinstance(parts, list) or not 1 <= len(parts) <= len(ANCHORS):
        found = len(parts) if isinstance(parts, list) else type(parts).__name__
        raise CheckpointError(complaint(path, "detectors", f"1 to {len(ANCHORS)} detectors", found))
    students = [_student(path, _checked(path, part), device, engine, fusion) for part in parts]
    return students[0] if len(students) == 1 else JoinedDetectors(students)


def _student(path: Path, content: Mapping[str, object], device: str, engine: str, fusion: str = "") -> Detector:
    chosen = ENGINES[engine_for(path, engine, device)]
    detector = _detector(path, content).to(device)
    if detector.settings.role != "student":
        hint = "; a teacher reads clouds that are made with ground truth"
        raise CheckpointError(complaint(path, "settings.role", "student", detector.settings.role, hint))
    # Weights of optimised networks have other names: first the fusion is exchanged.
    return chosen(with_fusion(detector, fusion) if fusion else detector)


def with_fusion(detector: Detector, fusion: str) -> Detector:
    """Copy a detector with another fusion method and the same weights.

    Attention, maximum and none have no weights: a teacher trained on the ego's cloud alone reads all agents' clouds
    with either of the first two.

    Args:
        detector: detector of `load_detector`; weights of `deployed` ones have other names.

    Raises:
        CheckpointError: the fusion needs other weights than the detector has.
    """
    try:
        other = Detector(replace(detector.settings, fusion=fusion))
    except ValueError as error:  # the settings do not go together
        raise CheckpointError(complaint("detector", "fusion", "one that goes with the settings", str(error))) from None
    state = detector.state_dict()
    shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
    wanted = {name: tuple(tensor.shape) for name, tensor in other.state_dict().items()}
    if shapes != wanted:
        name = min(name for name in shapes.keys() | wanted.keys() if shapes.get(name) != wanted.get(name))
        expected = f"one with the weights of '{detector.settings.fusion}'"
        found = f"'{fusion}', where {name} is {wanted.get(name, 'missing')} for {shapes.get(name, 'missing')}"
        raise CheckpointError(complaint("detector", "fusion", expected, found))
    other.load_state_dict(state)
    return other.to(detector.cls_head.weight.device).train(detector.training)


def read_meta(path: Path) -> dict[str, Any]:
    """Return the provenance of a detector file's weights.

    Raises:
        CheckpointError: the file is missing, damaged or not a detector.
    """
    meta = _content(Path(path)).get("meta", {})
    if not isinstance(meta, dict):
        raise CheckpointError(complaint(path, "meta", "what a training has written", type(meta).__name__))
    return meta


def _content(path: Path, formats: Sequence[str] = (FORMAT,)) -> dict[str, Any]:
    return _checked(path, read_tensors(path, f"a {FORMAT} checkpoint"), formats)


def _checked(path: Path, content: object, formats: Sequence[str] = (FORMAT,)) -> dict[str, Any]:
    if not isinstance(content, dict) or content.get("format") not in formats:
        found = content.get("format", "none") if isinstance(content, dict) else type(content).__name__
        hint = "; the deployable file of a training is its detector.pt; dsrc model import makes one of others' files"
        if found == JOINED:
            hint = "; only `dsrc drive` reads joined detectors, other commands the files that they were joined from"
        raise CheckpointError(complaint(path, "format", " or ".join(formats), found, hint))
    return content


def _stored(tensor: torch.Tensor, half: bool) -> torch.Tensor:
    tensor = tensor.detach().cpu().contiguous()
    # Vectors stay: they are small, and a running variance can exceed what half precision holds.
    return tensor.half() if half and tensor.is_floating_point() and tensor.ndim > 1 else tensor
