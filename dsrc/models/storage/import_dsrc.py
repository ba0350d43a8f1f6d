"""Import of checkpoints of DSRC's published code, which is a fork of OpenCOOD."""

import re
from collections.abc import Mapping
from pathlib import Path

from msgspec.structs import replace
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.names import detector_state
from dsrc.models.storage.published import filled, published_tensors
from dsrc.ops.grid import GridSpec
from sim.errors import CheckpointError, complaint

_UNUSED = re.compile(r"backbone(_teacher)?\.resnet\.bn1\..*|pcr\..*")
"""Unused tensors: norms that never compute anything, and the reconstruction head, which no detector needs."""

RELEASED_WIDTH = 26
"""Base width of the published Res2Net; other widths are only guessed where it does not fit."""


def import_detector(path: Path, grid: GridSpec, teacher: bool = False, left_handed: bool = True) -> Detector:
    """Import a state dict of the published code.

    Sizes are those of the tensors, all else is as released: padded slots take part in the pillars' batch norm and
    maximum, 32 points per pillar, 70,000 pillars, a score threshold of 0.25, boxes longer than 6 m along x or y
    dropped, regression maps with sizes in the order height, width, length, intensities of 8 bits, and agents of the
    first five folders.

    Args:
        path: `net_epoch....pth` of the base model, of a student or of a teacher.
        grid: range and cells that it was trained for.
        teacher: take the teacher's half of a student's or a teacher's file.
        left_handed: it was trained on clouds with y to the right, as OPV2V's and V2XSet's are; the detector mirrors its
            input and its boxes. V2V4Real's and DAIR-V2X-C's are right-handed.

    Raises:
        CheckpointError: the file is missing, damaged or not one of these, or tensors are missing, unknown or of
            inconsistent shapes.
    """
    reference = published_tensors(path)
    has_teacher = any(name.partition(".")[0].endswith("_teacher") for name in reference)
    if teacher and not has_teacher:
        raise CheckpointError(complaint(path, "state", "a teacher's tensors (pillar_vfe_teacher...)", "none"))
    state = detector_state(reference, teacher)
    if not state:
        hint = "; it is a teacher's file: ask for the teacher" if has_teacher and not teacher else ""
        expected = "the tensors of DSRC's published code (pillar_vfe..., backbone.resnet...)"
        raise CheckpointError(complaint(path, "state", expected, next(iter(sorted(reference)), "nothing"), hint))
    known = detector_state(reference, True) if has_teacher else {}
    _check_unknown_tensors(
        path, reference, len(state) + len(known if not teacher else detector_state(reference, False))
    )
    try:
        settings = _settings(state, grid, teacher, designed=has_teacher or any(n.startswith("pcr.") for n in reference))
    except KeyError as error:
        raise CheckpointError(complaint(path, "state", f"a tensor {error.args[0]}", "none")) from None
    except (ValueError, IndexError) as error:
        raise CheckpointError(complaint(path, "state", "tensors of one network", str(error))) from None
    return filled(path, replace(settings, left_handed=left_handed), {name: (name, t) for name, t in state.items()})


def _check_unknown_tensors(path: Path, reference: Mapping[str, Tensor], known: int) -> None:
    """Reject unknown tensors: the file is of another network."""
    rest = [name for name in reference if not _UNUSED.fullmatch(name)]
    if len(rest) == known:
        return
    stranger = next(
        n for n in rest if not (detector_state({n: reference[n]}) or detector_state({n: reference[n]}, True))
    )
    hint = "; networks of OpenCOOD, CoAlign and ERMVP need --family opencood"
    raise CheckpointError(complaint(path, "state", "tensors of DSRC's published networks", stranger, hint))


def _settings(state: Mapping[str, Tensor], grid: GridSpec, teacher: bool, designed: bool) -> ModelSettings:
    channels = tuple(len(state[f"backbone.stages.{k}.0.conv3.weight"]) for k in range(3))
    widths = [len(state[f"backbone.stages.{k}.0.conv1.weight"]) // 4 for k in range(3)]
    fitting = [w for w in (RELEASED_WIDTH, *range(1, 257)) if [c * w // 64 for c in channels] == widths]
    if not fitting:
        raise ValueError(f"splits of {widths} channels in stages of {channels}")
    blocks = tuple(
        1 + max(int(name.split(".")[3]) for name in state if name.startswith(f"backbone.stages.{k}.")) for k in range(3)
    )
    linear = state["encoder.linear.weight"]
    first, second, third = (state[f"decoder.{k}.0.weight"].shape[1] for k in range(3))
    return ModelSettings(
        grid=grid,
        role="teacher" if teacher else "student",
        intensity_steps=255,
        box_order="hwl",
        sdd=designed,
        pcp=linear.shape[1] == 11 if teacher else designed,
        rec=False,
        padded_slots=True,
        pillar_channels=len(linear),
        stage_channels=channels,  # type: ignore[arg-type]
        stage_blocks=blocks,  # type: ignore[arg-type]
        base_width=fitting[0],
        decoder_channels=first if first == second == third else (first, second, third),
        shrink_channels=len(state["shrink.0.weight"]),
        team_by="folders",
        score_threshold=0.25,
        max_extent_m=6.0,
    )
