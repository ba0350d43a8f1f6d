"""Name mapping from the published checkpoints' tensors to ours.

Modules of the reference that never compute anything (a batch norm of its backbone, half of its reconstruction head)
are left out.
"""

import re
from collections.abc import Mapping

from torch import Tensor

_DETECTOR = (
    (r"pillar_vfe\.pfn_layers\.0\.linear\.(.*)", r"encoder.linear.\1"),
    (r"pillar_vfe\.pfn_layers\.0\.norm\.(.*)", r"encoder.norm.\1"),
    (r"backbone\.resnet\.layer([123])\.(.*)", lambda m: f"backbone.stages.{int(m[1]) - 1}.{m[2]}"),
    (r"backbone\.deblocks\.(.*)", r"decoder.\1"),
    (r"shrink_conv\.layers\.0\.double_conv\.(.*)", r"shrink.\1"),
    (r"(cls_head|reg_head)\.(.*)", r"\1.\2"),
)
_RECONSTRUCTION = (
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
    return _renamed(chosen, _DETECTOR)


def reconstruction_state(reference: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename a reference state to that of a `Reconstruction`."""
    return _renamed(reference, _RECONSTRUCTION)


def _renamed(tensors: Mapping[str, Tensor], rules: tuple) -> dict[str, Tensor]:
    renamed = {}
    for name, tensor in tensors.items():
        for pattern, replacement in rules:
            if match := re.fullmatch(pattern, name):
                renamed[replacement(match) if callable(replacement) else match.expand(replacement)] = tensor
    return renamed
