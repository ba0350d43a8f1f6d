from pathlib import Path

import pytest

from studies.shipped.ingredients import RUNS, Run, drives_of
from tests.paths import ROOT


@pytest.mark.parametrize("run", RUNS[1:], ids=lambda run: run.name)
def test_each_training_goes_without_one_thing(run: Run) -> None:
    first = RUNS[0]
    changed = (run.drives != first.drives) + (run.sensor != first.sensor) + len(run.changes)
    assert changed == 1
    assert (ROOT / "studies/shipped/ingredients" / f"{run.drives}.toml").exists()


def test_drives_of_one_sensor_are_linked_once_and_others_left_out(tmp_path: Path) -> None:
    for name in ("a_511_hdl-64e-kitti", "a_511_os1-128", "b_512_hdl-64e-kitti"):
        (tmp_path / "parked" / "train" / name).mkdir(parents=True)
    run = Run("one", "one sensor", sensor="hdl-64e-kitti")
    for _ in range(2):
        chosen = drives_of(run, tmp_path, tmp_path / "out")
        assert sorted(path.name for path in chosen.iterdir()) == ["a_511_hdl-64e-kitti", "b_512_hdl-64e-kitti"]
    assert drives_of(Run("all", "everything"), tmp_path, tmp_path / "out") == tmp_path / "parked" / "train"
