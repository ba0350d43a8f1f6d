"""A finished run is verified; what was changed since is named."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from dsrc.cli.main import run as cli
from dsrc.models.device import BFLOAT16
from dsrc.models.storage.checkpoint import load_detector, read_meta, save_detector
from dsrc.training.train import train
from dsrc.training.verify import agree, runs_in, verify
from sim.errors import CheckpointError, DataError
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.runs import tiny


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("verify")
    data = write_drive(root / "data", 4)
    train(tiny(epochs=1), data, root / "run/plain", "plain")
    return root / "run/plain"


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "run/plain")
    return tmp_path / "run/plain"


def differing(run: Path, **moved: Path) -> list[str]:
    return [check.name for check in verify(run, **moved) if not check.agrees]


def change(path: Path, **entries: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def test_a_run_agrees_with_itself(run: Path) -> None:
    checks = verify(run)
    assert agree(checks), [str(check) for check in checks]
    names = {check.name for check in checks}
    # This run holds nothing out, and nobody takes its precision for one on other frames.
    assert {"detector.pt, SHA-256", "model", "recipe", "seed", "data", "version"} <= names
    assert "ap_bev_50 on training frames" in names and not [name for name in names if "validation" in name]


def test_a_record_that_called_training_frames_validation_still_agrees(run: Path) -> None:
    metrics = json.loads((run / "result.json").read_text())["metrics"]
    change(run / "result.json", metrics={f"val/{name.partition('/')[2]}": value for name, value in metrics.items()})
    assert differing(run) == []


def test_other_weights_are_found_out_by_hash_and_precision(run: Path) -> None:
    detector = load_detector(run / "detector.pt")
    meta = read_meta(run / "detector.pt")
    torch.nn.init.constant_(detector.cls_head.bias, 3.0)  # sees cars everywhere
    save_detector(run / "detector.pt", detector, meta)
    metrics = json.loads((run / "result.json").read_text())["metrics"]
    change(run / "result.json", metrics=metrics | {"train/ap_bev_50": 0.9})
    differ = differing(run)
    assert differ[0] == "detector.pt, SHA-256"
    assert "ap_bev_50 on training frames" in differ


def test_a_result_without_its_metrics_does_not_agree(run: Path) -> None:
    change(run / "result.json", metrics={"train/luck": 1.0})
    lacking = ["ap_bev_30", "ap_bev_50", "ap_bev_70", "heading", "luck"]
    engines = ["", ", engine fused", *([", engine bf16"] if BFLOAT16 else [])]
    assert differing(run) == [f"{name} on training frames{engine}" for engine in engines for name in lacking]


def test_another_teacher_start_and_epoch_are_named(run: Path) -> None:
    change(run / "settings.json", teacher="0" * 64, init={"sha256": "1" * 64})
    change(run / "result.json", epoch=7)
    assert differing(run) == ["teacher sha256", "start sha256", "epoch"]


WRONG_META = [3, "none", [1, 2], {"settings": "small"}, {"settings": []}, {"seed": "many"}, {"epoch": 1.5}]


@pytest.mark.parametrize("meta", WRONG_META)
def test_a_detector_with_a_damaged_origin_is_told_in_one_line(run: Path, meta: object) -> None:
    content = torch.load(run / "detector.pt", weights_only=True)
    torch.save(content | {"meta": meta}, run / "detector.pt")
    with pytest.raises(CheckpointError, match=r"^.*detector.pt: meta: expected what a training has written.*$") as told:
        verify(run)
    assert "\n" not in str(told.value)


def test_a_detector_of_unknown_origin_differs_in_it(run: Path) -> None:
    save_detector(run / "detector.pt", load_detector(run / "detector.pt"))
    assert {"detector.pt, SHA-256", "seed", "recipe learning_rate"} <= set(differing(run))


def test_other_settings_data_and_versions_are_named(run: Path, tmp_path: Path) -> None:
    settings = json.loads((run / "settings.json").read_text())
    settings["settings"]["recipe"]["learning_rate"] = 1.0
    change(run / "settings.json", settings=settings["settings"], versions=settings["versions"] | {"torch": "0.1"})
    other = write_drive(tmp_path / "data", 3)
    assert set(differing(run, data=other)) >= {"recipe learning_rate", "version torch", "data made_up"}


def test_a_run_of_a_version_before_agrees(run: Path) -> None:
    """The communication range was a setting of the recipe, and none of the detector's."""
    settings = json.loads((run / "settings.json").read_text())["settings"]
    settings["recipe"]["comm_range_m"] = settings["recipe"]["model"].pop("comm_range_m")
    change(run / "settings.json", settings=settings)
    assert set(differing(run)) == {"recipe comm_range_m", "recipe model"}


def test_a_run_whose_folders_were_not_recorded_agrees_with_the_given_ones(run: Path) -> None:
    record = json.loads((run / "settings.json").read_text())
    folders = record.pop("folders")
    (run / "settings.json").write_text(json.dumps(record))
    assert differing(run, data=Path(folders["data"])) == []
    with pytest.raises(DataError, match=r"data: expected the folder of its drives, found None; say .* --data"):
        verify(run)


def test_the_command_says_what_differs_and_returns_1(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cli(["model", "verify", str(run.parent)])
    assert "agrees   data: all 1" in capsys.readouterr().out
    change(run / "settings.json", seed=7)
    with pytest.raises(SystemExit) as stopped:
        cli(["model", "verify", str(run)])
    assert stopped.value.code == 1
    assert "differs  seed: recorded 7, found 0" in capsys.readouterr().out


def test_what_is_no_finished_run_is_told(run: Path, tmp_path: Path) -> None:
    assert runs_in(run.parent) == [run]
    with pytest.raises(DataError, match=r"settings.json: expected the run folder of a training"):
        runs_in(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"data: expected the folder of its drives, found .* say where it is: --data"):
        verify(run, data=tmp_path / "nowhere")
    (run / "result.json").write_text("[]")
    with pytest.raises(DataError, match=r"result.json: file: expected what a training has written"):
        verify(run)
    (run / "result.json").unlink()
    with pytest.raises(DataError, match=r"result.json: file: expected that of a finished training, found none"):
        verify(run)


def test_a_damaged_detector_is_told(run: Path) -> None:
    (run / "detector.pt").write_bytes(b"no detector")
    with pytest.raises(CheckpointError, match=r"detector.pt"):
        verify(run)
