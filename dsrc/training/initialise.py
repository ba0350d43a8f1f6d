"""Weights that a training starts from, and the teacher that it learns from."""

import logging
from pathlib import Path

import torch

from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_detector, with_fusion
from sim.errors import CheckpointError, complaint
from sim.files import file_sha256

LOG = logging.getLogger(__name__)
_SHARED = (
    "grid", "users", "anchor_lwh", "sdd", "pcp", "stage_channels", "shrink_channels", "box_order", "left_handed",
    "intensity_steps", "height",
)  # fmt: skip
"""Settings in which a teacher equals its student."""
_FIRST = "encoder.linear.weight"


def load_teacher(path: Path | None, student: ModelSettings) -> Detector:
    """Load a teacher whose features a student can be distilled from, with the student's fusion.

    A teacher of single clouds would see the ego's alone, and teach that there is nothing where only a collaborator has
    points.

    Raises:
        CheckpointError: the teacher is missing, or its settings or fusion differ from the student's.
    """
    if path is None:
        raise CheckpointError("teacher: a student with sdd or pcp needs a teacher's detector.pt; train it first")
    teacher = load_detector(path)
    wanted = {"role": "teacher"} | {name: getattr(student, name) for name in _SHARED}
    for name, value in wanted.items():
        if getattr(teacher.settings, name) != value:
            raise CheckpointError(complaint(path, name, f"{value} as the student's", getattr(teacher.settings, name)))
    try:
        return with_fusion(teacher, student.fusion)
    except CheckpointError:
        expected = f"{student.fusion} as the student's, which has weights of its own"
        raise CheckpointError(complaint(path, "fusion", expected, teacher.settings.fusion)) from None


def initialise_from(path: Path, detector: Detector) -> dict[str, object]:
    """Copy the weights of a detector file that match by name and shape.

    A network of painted points takes the first layer of one of bare points and gives paint no weight. One of bare
    points takes that of painted points without the paint, so that a student can begin as its teacher.

    Returns:
        The file's hash and the numbers of tensors taken and in all, for the run's record.

    Raises:
        CheckpointError: the file is missing or damaged, no weight matches, or they are of the mirror image.
    """
    own = detector.state_dict()
    start = load_detector(path)
    wanted_hand, hand = detector.settings.left_handed, start.settings.left_handed
    if hand != wanted_hand:
        hint = f"; train in the frame that it knows: --set left_handed={str(hand).lower()}"
        raise CheckpointError(complaint(path, "left_handed", f"{wanted_hand} as the network's", hand, hint))
    theirs = start.state_dict()
    first, paint = theirs[_FIRST], 4
    painted, wanted = start.settings.point_features > paint, detector.settings.point_features > paint
    if wanted and not painted:
        theirs[_FIRST] = torch.cat([first[:, :paint], torch.zeros_like(first[:, :1]), first[:, paint:]], dim=1)
    if painted and not wanted:
        theirs[_FIRST] = torch.cat([first[:, :paint], first[:, paint + 1 :]], dim=1)
    matching = {name: t for name, t in theirs.items() if name in own and own[name].shape == t.shape}
    if all(tensor.ndim < 2 for tensor in matching.values()):  # the heads' biases and the steps' counters always match
        raise CheckpointError(complaint(path, "state", "a weight of the name and shape of the network's", "none"))
    detector.load_state_dict(own | matching)
    taken, total = (sum(t.is_floating_point() for t in tensors.values()) for tensors in (matching, own))
    LOG.info("%s: %d of %d tensors taken", path, taken, total)
    return {"sha256": file_sha256(path), "tensors_taken": taken, "tensors": total}
