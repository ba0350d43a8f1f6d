"""A training opens as its validation drives, with the newest weights that it has."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from torch import Tensor

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from dsrc.review.sources.base import DriveSource
from dsrc.review.sources.opening import open_sources
from dsrc.review.sources.training import NEWEST
from dsrc.training.recipes import RECIPES
from sim.errors import CheckpointError, DataError
from tests.dsrc.review.conftest import street_frame

RECIPE = RECIPES["small"]()
DETECTOR = Detector(RECIPE.settings("student"))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Run folder without weights, of a training whose validation drives are there."""
    for drive in ("north", "south", "not of this training"):
        write_frame(tmp_path / "drives" / drive, replace(street_frame(0), index=0))
    run = tmp_path / "run" / "student"
    (run / "checkpoints").mkdir(parents=True)
    write_record(run, tmp_path / "drives")
    return run


def write_record(run: Path, drives: Path, validation: Sequence[str] = ("south", "north")) -> None:
    record = {
        "settings": {"recipe": msgspec.to_builtins(RECIPE), "stage": "student"},
        "seed": 0,
        "versions": {},
        "data": {},
        "validation": dict.fromkeys(validation, "0" * 64) if validation else None,
        "folders": {"data": None, "validate": str(drives)},
    }
    (run / "settings.json").write_bytes(msgspec.json.encode(record))


def write_checkpoint(run: Path) -> None:
    state = {f"detector.{name}": tensor for name, tensor in DETECTOR.state_dict().items()}
    torch.save({"state_dict": {**state, "other": torch.zeros(1)}}, run / "checkpoints" / "last.ckpt")


def weights(source: DriveSource) -> Tensor:
    return source.sets[NEWEST].detector.state_dict()["encoder.linear.weight"]


def test_a_running_training_shows_the_weights_of_its_last_checkpoint(run: Path) -> None:
    write_checkpoint(run)
    for path in (run, run.parent):
        sources = open_sources(path)
        assert [source.name for source in sources] == ["north", "south"]
        assert all(torch.equal(weights(source), DETECTOR.encoder.linear.weight) for source in sources)


def test_the_best_validated_weights_and_then_the_result_come_first(run: Path) -> None:
    write_checkpoint(run)
    save_detector(run / "checkpoints" / "best.pt", DETECTOR)
    (source, _) = open_sources(run)
    assert source.sets[NEWEST].detector.settings == DETECTOR.settings


def test_a_training_of_a_version_before_opens(run: Path) -> None:
    """The communication range was a setting of the recipe, and none of the model's."""
    record = json.loads((run / "settings.json").read_text())
    recipe = record["settings"]["recipe"]
    recipe["comm_range_m"] = recipe["model"].pop("comm_range_m")
    (run / "settings.json").write_text(json.dumps(record))
    write_checkpoint(run)
    assert open_sources(run)
    del record["settings"]["recipe"]["model"]
    (run / "settings.json").write_text(json.dumps(record))
    with pytest.raises(DataError, match=r"settings.json: file: expected the settings of a training"):
        open_sources(run)


def test_drives_that_were_moved_are_found_in_the_folder_that_is_given(run: Path, tmp_path: Path) -> None:
    write_checkpoint(run)
    write_record(run, tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"nowhere: drives: expected north, found none; give the folder .+ by --drives"):
        open_sources(run)
    assert len(open_sources(run, tmp_path / "drives")) == 2


def test_what_is_missing_or_damaged_is_one_line(run: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"last.ckpt: file: expected a first checkpoint, found none so far"):
        open_sources(run)
    torch.save({"state_dict": {"detector.encoder.linear.weight": torch.zeros(3)}}, run / "checkpoints" / "last.ckpt")
    with pytest.raises(CheckpointError, match="expected a checkpoint of these settings") as caught:
        open_sources(run)
    assert "\n" not in str(caught.value)
    write_record(run, tmp_path / "drives", validation=())
    with pytest.raises(DataError, match="validation: expected drives of its own, found none"):
        open_sources(run)
    (run / "settings.json").write_text("{")
    with pytest.raises(DataError, match="expected the settings of a training"):
        open_sources(run)
