"""Published state dicts: their tensors read without running code, checked one by one and given to a detector."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.tensors import is_plain, read_tensors
from sim.errors import CheckpointError, complaint

_WRAPPERS = ("state_dict", "model_state_dict", "model")


def published_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a file by their published names.

    Raises:
        CheckpointError: the file is missing, damaged, or not a state dict of dense tensors.
    """
    content = read_tensors(path, "a state dict", "; only tensors are read, no pickled objects")
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not all(map(is_plain, content.values())):
        raise CheckpointError(complaint(path, "file", "a state dict of dense tensors", type(content).__name__))
    return {str(name).removeprefix("module."): tensor for name, tensor in content.items()}


def filled(path: Path, settings: ModelSettings, state: Mapping[str, tuple[str, Tensor]]) -> Detector:
    """Make a detector of settings and tensors, in evaluation mode.

    Args:
        state: published name and tensor, by the detector's names, in the order of the file.

    Raises:
        CheckpointError: names the first tensor that is missing, unknown, of another shape or not finite.
    """
    try:
        with torch.device("meta"):  # sizes without memory: empty tensors may ask for any
            wanted = Detector(settings).state_dict()
    except Exception as error:  # of the parts, which check their own settings
        raise CheckpointError(complaint(path, "state", "tensors of one network", str(error))) from None
    for name, (published, tensor) in state.items():
        if name not in wanted:
            raise CheckpointError(complaint(path, "state", "no further tensor", f"{published} {_shape(tensor)}"))
        if tensor.shape != wanted[name].shape:
            expected = f"shape {_shape(wanted[name])}"
            raise CheckpointError(complaint(path, f"state: {published}", expected, _shape(tensor)))
        if not bool(torch.isfinite(tensor.float()).all()):
            raise CheckpointError(complaint(path, f"state: {published}", "finite numbers", "NaN or infinity"))
    for name, tensor in wanted.items():
        if name not in state:
            raise CheckpointError(complaint(path, "state", f"a tensor for {name} {_shape(tensor)}", "none"))
    detector = Detector(settings)
    detector.load_state_dict({name: state[name][1].to(tensor.dtype) for name, tensor in wanted.items()})
    return detector.eval()


def described(detector: Detector) -> list[str]:
    """Return what a detector is, a line each: method, grid, widths, strides, heads, frame of its training."""

    def listed(values: Iterable[float], between: str = "/") -> str:
        return between.join(f"{value:g}" for value in values)

    settings = detector.settings
    low, high = settings.grid.range_m[:3], settings.grid.range_m[3:]
    anchor = detector.anchors[0, 0, 0, 3:6]
    lines = [
        f"method: {settings.fusion}, at most {settings.max_agents} agents",
        f"range: {listed(low, ', ')} to {listed(high, ', ')} m",
        f"pillars: {settings.grid.cell_m:g} m, {settings.pillar_channels} channels",
        f"backbone: {settings.backbone_name}, {listed(settings.stage_channels)} channels"
        f" in {listed(settings.stage_blocks)} blocks",
        f"decoder: {listed(settings.decoder_widths)} channels",
        "shrink: none"
        if not settings.shrink_channels
        else f"shrink: {settings.shrink_channels} channels, kernel {settings.shrink_kernel}",
        f"heads: a cell per {settings.head_stride} pillars, anchors of {listed(anchor, ' x ')} m"
        + (", directions" if settings.direction else ""),
        f"trained: {'left' if settings.left_handed else 'right'}-handed, intensities "
        + ("as they are" if settings.intensity_steps is None else f"in {settings.intensity_steps} steps"),
    ]
    return lines + ([f"compression: {settings.compress} channels to 1"] if settings.compress > 1 else [])


def _shape(tensor: Tensor) -> str:
    return str(tuple(tensor.shape))
