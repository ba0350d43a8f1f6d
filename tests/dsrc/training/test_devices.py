"""Several processes that share each batch train as one does."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from dsrc.models.storage.checkpoint import load_detector, read_meta
from dsrc.training.datamodule import EpochSampler
from dsrc.training.train import train
from sim.errors import SettingsError
from sim.files import file_sha256
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.runs import StillNorms, tiny
from tests.dsrc.training.shared_batch import RECIPE
from tests.paths import ROOT


def test_two_devices_share_the_batches_of_one() -> None:
    alone = [number for _, number in EpochSampler(11, seed=3)]
    parts = [[number for _, number in EpochSampler(11, seed=3, device=d, devices=2)] for d in range(2)]
    # A batch of four of one device is two and two of both.
    for start in range(0, 8, 4):
        shared = [part[start // 2 : start // 2 + 2] for part in parts]
        assert sorted(shared[0] + shared[1]) == sorted(alone[start : start + 4])
    assert len(parts[0]) == len(parts[1]) == len(EpochSampler(11, seed=3, device=1, devices=2)) == 5


def both_train(data: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """Run the trainings of `shared_batch` in two processes."""
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    program = ["-m", "tests.dsrc.training.shared_batch", str(data), str(out), *more]
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.run(
        [sys.executable, *launch, *program], cwd=ROOT, env=quiet, capture_output=True, text=True, timeout=900
    )


@pytest.mark.slow
def test_two_processes_end_with_the_weights_of_one_and_resume_exactly(tmp_path: Path) -> None:
    data = write_drive(tmp_path / "data", 7)
    alone = train(RECIPE, data, tmp_path / "alone", "plain", seed=1, callbacks=[StillNorms()])
    done = both_train(data, tmp_path / "both")
    assert done.returncode == 0, done.stderr
    expected, found = load_detector(alone).state_dict(), load_detector(tmp_path / "both/detector.pt").state_dict()
    worst = max(float((found[name].double() - tensor.double()).abs().max()) for name, tensor in expected.items())
    assert worst < 1e-6
    records = [json.loads((tmp_path / run / "settings.json").read_text()) for run in ("alone", "both")]
    assert [record["devices"] for record in records] == [1, 2]
    rows = [(tmp_path / run / "metrics.csv").read_text().splitlines() for run in ("alone", "both")]
    assert len(rows[0]) == len(rows[1]) == 3
    results = [json.loads((tmp_path / run / "result.json").read_text()) for run in ("alone", "both")]
    assert results[0]["metrics"] == pytest.approx(results[1]["metrics"], abs=0.02)
    # A student of several processes finds the file of its teacher, which one of them has written.
    teacher = file_sha256(tmp_path / "both/teacher/detector.pt")
    assert read_meta(tmp_path / "both/student/detector.pt")["teacher"] == teacher

    assert "power cut" in both_train(data, tmp_path / "cut", "cut").stderr
    assert not (tmp_path / "cut/detector.pt").exists()
    done = both_train(data, tmp_path / "cut")
    assert done.returncode == 0, done.stderr
    for name, tensor in load_detector(tmp_path / "cut/detector.pt").state_dict().items():
        assert torch.equal(tensor, found[name]), name


def test_a_batch_that_cannot_be_shared_is_refused(tmp_path: Path) -> None:
    data = write_drive(tmp_path / "data", 2)
    with pytest.raises(SettingsError, match=r"batch_size: expected a multiple of the 3 devices, found 2"):
        train(tiny(), data, tmp_path / "run", "plain", devices=3)
    with pytest.raises(SettingsError, match=r"devices: expected at least 1, found 0"):
        train(tiny(), data, tmp_path / "run", "plain", devices=0)
    with pytest.raises(SettingsError, match=r"epoch_frames: expected at least one for each of 4 devices, found 2"):
        train(tiny(batch_size=4), data, tmp_path / "run", "plain", devices=4)
