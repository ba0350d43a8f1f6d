"""Detections of drives in the forms of others: what is read back is what was found, and view and score take it."""

import json
from pathlib import Path

import numpy as np
import pytest

from dsrc.evaluation.find import detect_drives
from dsrc.evaluation.scoring.read import read_detections
from dsrc.evaluation.scoring.score import score
from dsrc.models.storage.deploy import engine_for
from dsrc.options.detection import Detection
from dsrc.review.sources.opening import open_sources
from sim.errors import SettingsError
from tests.dsrc.evaluation.small import write_detector, write_drives


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("detect")
    write_drives(root / "data", drives=2)
    write_detector(root / "small.pt", "attfuse")
    config = Detection(
        checkpoint=str(root / "small.pt"), data=root / "data", out=root / "boxes", format=("kitti", "opencood")
    )
    row, places = detect_drives(config)
    assert row.frames == 4 and row.detections > 0
    assert [place.name for place in places] == ["boxes.json", "kitti", "opencood"]
    return root


@pytest.mark.parametrize(("form", "most_m"), [("boxes.json", 1e-4), ("kitti", 2e-3), ("opencood", 1e-5)])
def test_every_form_has_the_boxes_that_are_stored(world: Path, form: str, most_m: float) -> None:
    (stored,), (read,) = read_detections(world / "boxes"), read_detections(world / "boxes" / form)
    assert len(read.frames) == len(stored.frames) == 4
    for one, other in zip(stored.frames.values(), read.frames.values(), strict=True):
        near, turns = other.boxes.center - one.boxes.center, np.sin(other.boxes.yaw - one.boxes.yaw)
        assert len(one) == len(other) and np.abs(near).max(initial=0) < most_m
        assert np.abs(other.boxes.size - one.boxes.size).max(initial=0) < most_m and np.abs(turns).max(initial=0) < 1e-3
        if form != "opencood":
            assert np.allclose(one.score, other.score, atol=1e-5)


def test_score_and_view_take_them(world: Path) -> None:
    (whole,) = score(world / "boxes", protocol="testbed")
    (listed,) = score(world / "boxes" / "boxes.json", world / "data", "opencood")
    assert whole.ap["bev", 0.5] > 0 and listed.ap["bev", 0.5] >= 0
    sources = open_sources(world / "boxes")
    assert len(sources) == 2 and all(list(source.sets) == ["small"] for source in sources)


def test_a_second_run_computes_nothing_and_writes_the_same(world: Path) -> None:
    files = sorted(path for path in (world / "boxes").rglob("*") if path.is_file() and ".lock" not in path.name)
    before = {path: path.read_bytes() for path in files if path.suffix in (".json", ".txt", ".npy")}
    config = Detection(checkpoint=str(world / "small.pt"), data=world / "data", out=world / "boxes", format=("kitti",))
    steps = []
    detect_drives(config, progress=lambda done, of: steps.append(of))
    assert not any(steps)
    assert {path: path.read_bytes() for path in before} == before


def test_the_engine_is_the_machines_and_is_told(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stored = json.loads((world / "boxes" / "results.json").read_text())
    assert stored["provenance"]["settings"]["engine"] == engine_for(world / "small.pt")
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", False)
    caplog.set_level("INFO", "dsrc.models.storage")
    again = tmp_path / "small.pt"
    again.write_bytes((world / "small.pt").read_bytes())
    detect_drives(checkpoint=str(again), data=world / "data", out=tmp_path / "boxes", frames=1)
    assert json.loads((tmp_path / "boxes" / "results.json").read_text())["provenance"]["settings"]["engine"] == "fused"
    assert f"engine fused, since the processor has no bfloat16: {again}" in caplog.messages


def test_levelled_and_ego_only_are_others(world: Path) -> None:
    flat = detect_drives(
        checkpoint=str(world / "small.pt"), data=world / "data", out=world / "auto", height="auto", ego_only=True
    )[0]
    assert flat.frames == 4 and flat.truth > 0
    with pytest.raises(SettingsError, match="detect: height: expected recorded, auto"):
        detect_drives(checkpoint=str(world / "small.pt"), data=world / "data", out=world / "x", height="low")
    assert not (world / "x").exists()
