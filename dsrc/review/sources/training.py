"""Validation drives of a training, with its newest weights as their detector; the training may still run."""

from pathlib import Path
from typing import Any

import msgspec
import torch

from dsrc.data.drives import list_drives, open_drive
from dsrc.data.sample import SampleDetector
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_student
from dsrc.review.sources.base import DriveSource
from dsrc.review.sources.detected import ComputedSet
from dsrc.training.recipes import Recipe, Stage, of_today
from dsrc.training.run_folder import Record, RunFolder
from sim.errors import CheckpointError, DataError, complaint

NEWEST = "newest weights"
"""Name of the set of detections."""


def open_training(run: Path, data: Path | None = None, engine: str = "auto") -> list[DriveSource]:
    """Open the validation drives of a training.

    Args:
        data: folder of the drives now; None for where they were.
        engine: execution of the network, `auto` or a key of `dsrc.models.storage.deploy.ENGINES`; that of a checkpoint
            is plain.

    Raises:
        DataError: the record is damaged, or the training has no validation drives of its own, or they are missing.
        CheckpointError: there are no weights yet, they are damaged, or a teacher's.
    """
    folder = RunFolder(run)
    try:
        record = msgspec.json.decode(folder.settings.read_bytes(), type=Record)
        recipe = msgspec.convert(of_today(record.settings.recipe), Recipe)
    except (msgspec.DecodeError, KeyError, TypeError) as error:
        raise DataError(complaint(folder.settings, "file", "the settings of a training", str(error))) from None
    if not record.validation:
        hint = "; dsrc view takes its detector.pt by --checkpoint beside any drives"
        raise DataError(complaint(folder.settings, "validation", "drives of its own", "none", hint))
    place = data or Path(record.folders.get("validate") or "unknown")
    found = {path.name: path for path in list_drives(place)} if place.exists() else {}
    missing = sorted(set(record.validation) - set(found))
    if missing:
        hint = "; give the folder of its drives by --drives"
        raise DataError(complaint(place, "drives", missing[0], "none", hint))
    detector = _newest(folder, recipe, record.settings.stage, engine)
    sources = [DriveSource(open_drive(found[name])) for name in sorted(record.validation)]
    for source in sources:
        source.sets[NEWEST] = ComputedSet(NEWEST, detector)
    return sources


def _newest(folder: RunFolder, recipe: Recipe, stage: Stage, engine: str) -> SampleDetector:
    """Detector of a finished training, else the best validated weights, else those of the last checkpoint."""
    for path in (folder.detector, folder.best):
        if path.is_file():
            return load_student(path, engine=engine)
    model = recipe.settings(stage)
    if model.role != "student":
        hint = "; a teacher reads clouds that are made with ground truth"
        raise CheckpointError(complaint(folder.settings, "stage", "a student", stage, hint))
    if not folder.last.is_file():
        raise CheckpointError(complaint(folder.last, "file", "a first checkpoint", "none so far"))
    detector = Detector(model)
    try:
        content: dict[str, Any] = torch.load(folder.last, map_location="cpu", weights_only=True)
        own = "detector."
        state = {name.removeprefix(own): one for name, one in content["state_dict"].items() if name.startswith(own)}
        detector.load_state_dict(state)
    except Exception as error:  # torch's reader of a damaged file raises many types
        found = " ".join(str(error).split())[:200]
        raise CheckpointError(complaint(folder.last, "file", "a checkpoint of these settings", found)) from None
    return detector.eval()
