import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from PIL import Image
from rich.table import Table

from dsrc.evaluation.run import evaluate_checkpoints, name_checkpoints
from sim.errors import CheckpointError, SettingsError
from tests.dsrc.evaluation.fakes import PointCounter, halve, write_drives

FILES = {
    "results.csv", "results.json", "timings.csv", "ap_per_corruption.png", "mce_map.png", "precision_recall.png",
}  # fmt: skip


@pytest.fixture
def world(tmp_path, monkeypatch):
    monkeypatch.setattr("sensors.corruptions.CORRUPTIONS", {"fog": None, "snow": None}, raising=False)
    monkeypatch.setattr("sensors.corruptions.corrupt_frame", halve, raising=False)
    loader = SimpleNamespace(load_student=lambda path, engine: PointCounter(need=int(Path(path).read_text())))
    monkeypatch.setitem(sys.modules, "dsrc.models.storage.checkpoint", loader)
    write_drives(tmp_path / "test", drives=1, frames=2)
    for name, need in (("small.pt", 2), ("plain.pt", 6)):
        (tmp_path / name).write_text(str(need))
    return tmp_path


def test_an_evaluation_writes_tables_plots_and_what_made_them(world):
    checkpoints = {"DSRC": world / "small.pt", "plain": world / "plain.pt"}
    table = evaluate_checkpoints(checkpoints, data=world / "test", out=world / "out", seed=4)
    assert isinstance(table, Table)
    assert {p.name for p in (world / "out").iterdir()} == FILES
    result = json.loads((world / "out" / "results.json").read_text())
    made_by = result["provenance"]
    assert made_by["seed"] == 4
    assert made_by["settings"]["conditions"] == ["clean", "fog", "snow"]
    assert made_by["settings"]["engine"] == "fused"
    assert len(made_by["settings"]["checkpoints"]["DSRC"]["sha256"]) == 64
    assert list(made_by["data"]) == ["drive_0"]
    assert {row["method"] for row in result["rows"]} == {"DSRC", "plain", "DSRC, ego alone"}
    with (world / "out" / "results.csv").open() as file:
        assert json.loads(file.readline()[2:]) == made_by
        assert len(list(csv.DictReader(file))) == 3 * (3 + 2)
    with Image.open(world / "out" / "mce_map.png") as image:
        assert json.loads(image.text["Description"]) == made_by


def test_two_evaluations_write_the_same_bytes(world):
    for out in ("one", "two"):
        evaluate_checkpoints([world / "small.pt"], data=world / "test", out=world / out, corruptions=("fog",))
    for name in FILES - {"timings.csv"}:
        assert (world / "one" / name).read_bytes() == (world / "two" / name).read_bytes(), name


def test_clean_only_and_cooperative_only(world):
    evaluate_checkpoints(
        [world / "small.pt"], data=world / "test", out=world / "out", corruptions=("clean",), ego_alone=False
    )
    rows = json.loads((world / "out" / "results.json").read_text())["rows"]
    assert [(row["method"], row["condition"]) for row in rows] == [("small", "clean")]


def test_checkpoints_are_named_by_their_file_or_by_hand(world):
    named = name_checkpoints([Path("runs/a/detector.pt"), Path("runs/b/detector.pt"), Path("late fusion=runs/c.pt")])
    assert named == {
        "a/detector": Path("runs/a/detector.pt"),
        "b/detector": Path("runs/b/detector.pt"),
        "late fusion": Path("runs/c.pt"),
    }
    assert name_checkpoints([Path("runs/lr=0.1/d.pt")]) == {"d": Path("runs/lr=0.1/d.pt")}
    with pytest.raises(CheckpointError, match="name=path"):
        name_checkpoints([Path("x=a.pt"), Path("x=b.pt")])


def test_nothing_to_evaluate_is_told(world):
    with pytest.raises(SettingsError, match="at least one detector"):
        evaluate_checkpoints([], data=world / "test", out=world / "out")
