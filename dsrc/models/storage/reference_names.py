"""Name mapping from the published checkpoints' tensors to ours.

Modules of the reference that never compute anything (a batch norm of its backbone, half of its reconstruction head)
are left out.
"""

import re
from collections.abc import Callable, Iterable, Mapping

from torch import Tensor

Rule = tuple[str, str | Callable[[re.Match[str]], str] | None]
"""Pattern of a published name and our name, None for a tensor that the published network never uses."""

AROUND_BACKBONE: tuple[Rule, ...] = (
    (r"pillar_vfe\.pfn_layers\.0\.linear\.(.*)", r"encoder.linear.\1"),
    (r"pillar_vfe\.pfn_layers\.0\.norm\.(.*)", r"encoder.norm.\1"),
    (r"backbone\.deblocks\.(.*)", r"decoder.\1"),
    (r"shrink_conv\.layers\.0\.double_conv\.(.*)", r"shrink.\1"),
    (r"(cls_head|reg_head)\.(.*)", r"\1.\2"),
)
"""Names that OpenCOOD and its forks share: pillars, decoder, shrink convolutions, heads."""
_DETECTOR: tuple[Rule, ...] = (
    *AROUND_BACKBONE,
    (r"backbone\.resnet\.layer([123])\.(.*)", lambda m: f"backbone.stages.{int(m[1]) - 1}.{m[2]}"),
)
_RECONSTRUCTION: tuple[Rule, ...] = (
    (r"pcr\.out_conv\.(.*)", r"expand.\1"),
    (r"pcr\.generator_1\.(.*)", r"generate.\1"),
    (r"pcr\.gen_out_4\.0\.(.*)", r"offset.\1"),
    (r"pcr\.gen_mask_4\.0\.(.*)", r"occupancy.\1"),
)


def detector_state(reference: Mapping[str, Tensor], teacher: bool = False) -> dict[str, Tensor]:
    """Rename a reference state to that of a `Detector`.

    Args:
        reference: tensors by the reference's names.
        teacher: take the modules with the suffix `_teacher` instead of the student's.
    """
    chosen = {}
    for name, tensor in reference.items():
        module, _, rest = name.partition(".")
        if module.endswith("_teacher") == teacher:
            chosen[f"{module.removesuffix('_teacher')}.{rest}"] = tensor
    return renamed_state(chosen, _DETECTOR)


def reconstruction_state(reference: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename a reference state to that of a `Reconstruction`."""
    return renamed_state(reference, _RECONSTRUCTION)


def renamed_state(tensors: Mapping[str, Tensor], rules: Iterable[Rule]) -> dict[str, Tensor]:
    """Rename tensors by the first rule that fits each; the others, and those that are never used, are left out."""
    found = ((renamed(name, rules), tensor) for name, tensor in tensors.items())
    return {name: tensor for name, tensor in found if name}


def renamed(name: str, rules: Iterable[Rule]) -> str | None:
    """Rename one tensor by the first rule that fits; None for one that is never used, an empty name if no rule fits."""
    for pattern, ours in rules:
        if match := re.fullmatch(pattern, name):
            return None if ours is None else ours(match) if callable(ours) else match.expand(ours)
    return ""
