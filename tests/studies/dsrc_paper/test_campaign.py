"""The campaign of trainings and its gates."""

import argparse
import json
import tomllib
from pathlib import Path

import pytest

from studies.dsrc_paper import campaign, gates
from tests.commands import study
from tests.paths import ROOT


def test_the_campaign_trains_every_detector_of_the_tables_after_those_it_needs() -> None:
    commands = study("dsrc_paper.campaign", "--data", "data", "--out", "runs", "--dry-run").splitlines()
    made: list[str] = []
    for command in commands:
        words = command.split()
        data = "dsrc-sim-vulnerable" if "users=vulnerable" in words else "data"
        for option, part in (("--data", "train"), ("--validate", "validation")):
            assert words[words.index(option) + 1] == f"{data}/{part}"
        said = {
            name: words[words.index(name) + 1] for name in ("--out", "--stage", "--init", "--teacher") if name in words
        }
        assert {said.get("--init"), said.get("--teacher")} <= {None, *made}
        made.append(f"{said['--out']}/{said['--stage']}/detector.pt")
    tables, twins = (
        tomllib.loads((ROOT / f"studies/dsrc_paper/{name}.toml").read_text()) for name in ("benchmark", "twins")
    )
    for table in (tables, twins):
        assert {path for method in table["methods"] for path in method["detectors"]} <= set(made)
    assert tables["pictures"]["teacher"] in made


def test_the_campaign_leaves_what_is_done_and_writes_how_it_went(tmp_path: Path) -> None:
    run_folder = tmp_path / "runs/first/plain"
    for folder in (run_folder, *(tmp_path / f"data/{part}" for part in ("train", "validation", "test"))):
        folder.mkdir(parents=True)
    (run_folder / "detector.pt").write_bytes(b"done")
    (run_folder / "settings.json").write_text('{"settings": {"stage": "plain"}, "seed": 0, "teacher": null}')
    columns = "epoch,step,seconds,val/ap_bev_50,val/ap_bev_70\n"
    (run_folder / "metrics.csv").write_text(f"{columns}0,10,60.0,0.1,0.0\n1,20,30.0,0.2,0.1\n")
    arguments = ("--data", str(tmp_path / "data"), "--out", str(tmp_path / "runs"), "--only", "first")
    for _ in range(2):  # the second time there is a table already
        study("dsrc_paper.campaign", *arguments)
    assert (run_folder / "detector.pt").read_bytes() == b"done"
    names, *lines = (tmp_path / "runs/trainings.csv").read_text().splitlines()
    assert [dict(zip(names.split(","), line.split(","), strict=True)) for line in lines] == [
        {
            **{"name": "first", "phase": "1", "method": "no-collaboration", "stage": "plain", "seed": "0", "init": ""},
            **{"tensors_taken": "", "teacher": "", "settings": "", "data": "", "steps": "20", "minutes": "1.5"},
            **{"val_ap_bev_50": "0.2", "val_ap_bev_70": "0.1"},
        }
    ]


def test_a_gate_passes_where_every_value_reaches_its_bound_and_a_missing_one_reaches_none() -> None:
    bounds = {"gain_50": -1.0, "gain_70": 1.0}
    assert gates.gate("G1", {"gain_50": -0.9, "gain_70": 1.0}, bounds, "").passed
    assert not gates.gate("G1", {"gain_50": 5.0, "gain_70": 0.9}, bounds, "").passed
    assert not gates.gate("G1", {"gain_50": float("nan"), "gain_70": 2.0}, bounds, "").passed


def test_a_kept_training_has_no_path_of_the_machine_that_trained_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "runs/v2vnet_s0/student"  # a rival, which no other training starts from
    folder.mkdir(parents=True)
    for part in campaign.KEPT:
        (folder / part).write_text("{}")
    (folder / "settings.json").write_text(f'{{"seed": 0, "folders": {{"data": "{tmp_path}"}}}}')
    campaign.keep(tmp_path / "runs", tmp_path / "kept", "v2vnet_s0")
    target = tmp_path / "kept/v2vnet_s0/student"
    assert sorted(path.name for path in target.iterdir()) == sorted(campaign.KEPT)
    assert json.loads((target / "settings.json").read_text()) == {"seed": 0}


def test_the_campaign_halves_the_distillation_once_after_a_first_gate_that_did_not_pass(tmp_path: Path) -> None:
    assert campaign.factor(tmp_path) == 1.0
    gates.record(tmp_path, gates.gate("G1", {"gain_50": -3.0}, {"gain_50": -1.0}, ""))
    assert campaign.factor(tmp_path) == 0.5
    halved = {training.name: training for training in campaign.campaign(2, 0.5)}
    assert "dsrc-single-halved_s0" in halved["dsrc_s0"].needs()
    assert "distill.dap=0.25" in halved["dsrc_s0"].settings
    folders = "--data", "data", "--out", str(tmp_path)
    given = argparse.Namespace(phases=None, only=["dsrc-single_s0", "single_s1"])
    asked = campaign.selected(list(halved.values()), given)  # asked for before the gate replaced the first
    assert {"dsrc-single-halved_s0", "single_s1"} <= {training.name for training in asked}
    assert "--epochs 1 " in study("dsrc_paper.campaign", *folders, "--dry-run", "--lengthen", "0.1", "--only", "first")
    assert "dsrc-single-halved_s0" in study("dsrc_paper.campaign", *folders, "--dry-run", "--only", "dsrc_s0")
    assert not any("distill" in setting for setting in halved["attfuse_s0"].settings)
    gates.record(tmp_path, gates.gate("G2", {"gain_50": 1.0}, {"gain_50": 0.5}, ""))
    assert {name: gate.passed for name, gate in gates.recorded(tmp_path).items()} == {"G1": False, "G2": True}
