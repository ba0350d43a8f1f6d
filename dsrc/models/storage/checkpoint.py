"""Detector files: weights, settings and provenance, loaded without running code from the file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import torch
from msgspec.structs import replace

from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.deploy import ENGINES
from dsrc.models.storage.tensors import is_plain, read_tensors
from sim.errors import CheckpointError, SettingsError, complaint, did_you_mean
from sim.files import replacing

FORMAT = "dsrc-detector-1"
_MOST_BLOCKS = 1000


def save_detector(path: Path, detector: Detector, meta: Mapping[str, Any] | None = None, half: bool = True) -> None:
    """Write a detector file atomically.

    Args:
        path: the file.
        detector: detector whose weights and settings are stored.
        meta: provenance of the weights; values that are not plain are stored as text.
        half: store floats in half precision: half the size, and differences far below those of two trainings.
    """
    state = {name: _stored(tensor, half) for name, tensor in detector.state_dict().items()}
    content = {"format": FORMAT, "settings": msgspec.to_builtins(detector.settings), "state": state}
    content["meta"] = msgspec.to_builtins(dict(meta or {}), enc_hook=str)
    # By way of an open file: PyTorch keeps the name of a path in the archive.
    with replacing(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def load_detector(path: Path, device: str = "cpu") -> Detector:
    """Read a detector file, in evaluation mode and full precision.

    Raises:
        CheckpointError: the file is missing, damaged, not a detector, or of another version of the network.
    """
    content = _content(Path(path))
    state = content.get("state")
    try:
        settings = msgspec.convert(content["settings"], ModelSettings)
        if max(settings.stage_blocks) > _MOST_BLOCKS:
            raise ValueError(f"a stage of {max(settings.stage_blocks)} blocks")
        with torch.device("meta"):  # sizes without memory: settings may ask for any
            wanted = Detector(settings).state_dict()
    except Exception as error:  # of the parts, which check their own settings
        raise CheckpointError(complaint(path, "settings", "those of a detector", str(error))) from None
    if not isinstance(state, dict) or set(state) != set(wanted):
        name = next(iter(sorted(set(wanted) ^ set(state if isinstance(state, dict) else {}))))
        raise CheckpointError(complaint(path, "state", "the tensors of its settings", f"{name} missing or too many"))
    for name, tensor in wanted.items():
        shape = tuple(getattr(state[name], "shape", (-1,)))
        if shape != tuple(tensor.shape):
            raise CheckpointError(complaint(path, f"state.{name}", f"shape {tuple(tensor.shape)}", shape))
        if not is_plain(state[name]):
            raise CheckpointError(complaint(path, f"state.{name}", "a dense tensor", "another layout"))
        if tensor.is_floating_point() and not bool(torch.isfinite(state[name]).all()):
            raise CheckpointError(complaint(path, f"state.{name}", "finite numbers", "NaN or infinity"))
    detector = Detector(settings)
    detector.load_state_dict({name: state[name].to(tensor.dtype) for name, tensor in wanted.items()})
    return detector.to(device).eval()


def load_student(path: Path, device: str = "cpu", engine: str = "fused") -> Detector:
    """Read a student for inference, optimised by `dsrc.models.storage.deploy`.

    Args:
        path: the file.
        device: device of its tensors.
        engine: key of `ENGINES`.

    Raises:
        CheckpointError: as `load_detector`, or the file holds a teacher.
        SettingsError: the engine is unknown, or missing on this machine.
    """
    if engine not in ENGINES:
        raise SettingsError(f"engine: unknown '{engine}'{did_you_mean(engine, ENGINES)}")
    detector = load_detector(path, device)
    if detector.settings.role != "student":
        hint = "; a teacher reads clouds that are made with ground truth"
        raise CheckpointError(complaint(path, "settings.role", "student", detector.settings.role, hint))
    return ENGINES[engine](detector)


def with_fusion(detector: Detector, fusion: str) -> Detector:
    """Copy a detector with another fusion method and the same weights.

    Attention, maximum and none have no weights: a teacher trained on the ego's cloud alone reads all agents' clouds
    with either of the first two.

    Args:
        detector: detector of `load_detector`; weights of `deployed` ones have other names.
        fusion: key of `FUSIONS`.

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


def _content(path: Path) -> dict[str, Any]:
    content = read_tensors(path, f"a {FORMAT} checkpoint")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format", "none") if isinstance(content, dict) else type(content).__name__
        hint = "; the deployable file of a training is its detector.pt"
        raise CheckpointError(complaint(path, "format", FORMAT, found, hint))
    return content


def _stored(tensor: torch.Tensor, half: bool) -> torch.Tensor:
    tensor = tensor.detach().cpu().contiguous()
    # Vectors stay: they are small, and a running variance can exceed what half precision holds.
    return tensor.half() if half and tensor.is_floating_point() and tensor.ndim > 1 else tensor
