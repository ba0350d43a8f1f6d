"""Trainings of the questions: their order, one factor each, and a tiny run that a sitting cuts."""

import json
import re
import shutil
import subprocess
import sys
from argparse import Namespace
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.models.detector import Detector
from dsrc.runs.lock import locked
from sim.errors import DataError, SettingsError
from sim.files import file_sha256, write_file
from studies.rivals import train
from studies.rivals.questions import CHANGES, DSRC, PLAIN, QUESTIONS, RIVALS, STRONGEST, Training, pairs, parts, rivals
from studies.shipped.train import STARTS
from tests.commands import run_study, study
from tests.dsrc.training.drive import frame
from tests.paths import ROOT


def plan(question: str) -> list[Training]:
    return list(QUESTIONS[question](lambda name: 0.0))


@pytest.mark.parametrize("question", QUESTIONS)
def test_every_training_comes_after_what_it_starts_from_and_is_taught_by(question: str) -> None:
    starts, known = {"", *(path.stem for path in STARTS.glob("*.pt"))}, dict[str, Training]()
    for run in plan(question):
        # The best of a method's lengths is named again, as the one that is measured.
        assert run.name not in starts and known.get(run.name) in (None, replace(run, title=""))
        assert {run.start, run.teacher} <= starts | set(known)
        assert bool(run.teacher) == run.recipe().settings(run.stage).distils or run.stage == "teacher"
        known[run.name] = run


def test_rivals_have_the_rate_and_length_that_are_best_for_each() -> None:
    known = {"attfuse-1000-0": 1.2, "attfuse-2000-0": 1.3, "attfuse-4000-0": 1.25}
    strongest = "late", "early", "cobevt", "ermvp"
    known |= {f"{method}-4000-0-slow": 1.0 + 0.01 * place for place, method in enumerate(strongest)}
    known |= {"no-collaboration-8000-0-slow": 1.9} | {f"{method}-1000-0": 0.4 for method in ("dsrc", *RIVALS)}
    runs = list(rivals(lambda name: known.get(name, 0.8 if "-2000" in name else 0.5)))
    measured = {run.method: run for run in runs if run.title and run.seed == 0}
    assert set(measured) == {"attfuse", "dsrc", *RIVALS}
    lengths = {name: measured[name].steps for name in ("attfuse", "dsrc", "late", "no-collaboration")}
    assert lengths == {"attfuse": 2000, "dsrc": 2000, "late": 4000, "no-collaboration": 2000}
    assert {name for name, run in measured.items() if run.rate == 1.5e-3} == {"attfuse"}
    assert not any(run.name.startswith("dsrc-8000") for run in runs)
    trainings = {name: sum(run.title == one.title for run in runs) for name, one in measured.items()}
    assert (
        trainings == {name: 5 if name in ("attfuse", "dsrc") else 3 if name in strongest else 1 for name in measured}
        and len(strongest) == STRONGEST
    )
    for run in runs:
        one = measured[run.method] if run.title else run
        assert (run.rate, run.steps) == (one.rate, one.steps)


def test_a_start_has_all_layers_of_a_method_but_those_of_its_fusion() -> None:
    runs = {run.name: run for run in plan("rivals")}
    starts = {run.method: run.start for run in runs.values() if run.title}
    assert set(starts.values()) == {"alone", "alone-map", "alone-residual"}
    assert len({(runs[start].start, runs[start].steps, runs[start].rate) for start in starts.values()}) == 1

    def layers(run: Training) -> dict[str, torch.Size]:
        state = Detector(run.recipe().settings(run.stage)).state_dict()
        return {name: value.shape for name, value in state.items() if not name.startswith("fusion.")}

    for method, start in starts.items():
        assert layers(next(run for run in runs.values() if run.method == method and run.title)) == layers(runs[start])


def test_all_rivals_are_trained_at_one_length_before_the_next_and_none_longer_than_asked() -> None:
    runs = rivals(lambda name: float(name.split("-")[-2]), longest=2000)
    trials = [run.steps for run in runs if not run.title and re.fullmatch(r".*-\d+-0(-slow)?", run.name)]
    assert trials == sorted(trials) and set(trials) == {1000, 2000}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ("rivals", "--longest", "500"),
            "argument --longest: invalid choice: 500 (choose from 1000, 2000, 4000, 8000)",
        ),
        (("parts", "--longest", "2000"), "--longest: expected with rivals alone, found with parts"),
        (("parts", "--share", "nan"), "--share: expected above 0 and at most 1, found nan"),
        (("parts", "--share", "0"), "--share: expected above 0 and at most 1, found 0"),
    ],
)
def test_a_length_or_share_that_no_training_has_is_refused(options: tuple[str, ...], told: str, tmp_path: Path) -> None:
    found = run_study("rivals.train", *options, "--list", "--out", str(tmp_path))
    assert found.returncode == 2 and told in found.stderr


def test_questions_share_a_training_by_its_name() -> None:
    known = {run.name: replace(run, title="") for run in plan("lengths")}
    others = *rivals(lambda name: -float(name.count("slow"))), *plan("parts")
    shared = [run for run in others if run.name in known]
    assert all(replace(run, title="") == known[run.name] for run in shared)
    assert {"alone", "teacher", "attfuse-1000-0", "dsrc-2000-2"} <= {run.name for run in shared}


def test_a_part_differs_from_dsrc_in_one_factor() -> None:
    runs = {run.title: run for run in parts(lambda name: 0.0) if run.title and run.seed == 0}
    whole = runs[DSRC]
    for title in CHANGES:
        one = runs[f"{DSRC}, {title}"]
        same = [field.name for field in fields(one) if getattr(one, field.name) == getattr(whole, field.name)]
        assert {"method", "stage", "start", "steps", "rate", "seed", "base"} <= set(same)
        assert one.settings != whole.settings and one.recipe().epochs == whole.recipe().epochs
    assert set(pairs(list(runs))) >= {
        (DSRC, PLAIN),
        (f"{DSRC}, wide", f"{PLAIN}, wide"),
        (DSRC, f"{DSRC}, no painting"),
        (DSRC, f"{PLAIN}, from the teacher's weights"),
    }
    assert pairs([PLAIN, DSRC, f"{PLAIN}, wide", f"{DSRC}, half as long"]) == [(DSRC, PLAIN)]
    assert pairs([PLAIN, f"{PLAIN}, wide", f"{DSRC}, wide"]) == [(f"{DSRC}, wide", f"{PLAIN}, wide")]


def tiny(data: Path) -> tuple[str, ...]:
    """Write a data set of a few frames, and return the options of a training on it."""
    for split, first in (("train", 0), ("validation", 10), ("unseen", 20)):
        for index in range(first, first + (4 if split == "train" else 1)):
            write_frame(data / split / f"{split}_drive", frame(index))
    return "--data", str(data), "--recipe", "debug", "--share", "0.0001", "--workers", "0", "--frames", "1"


@pytest.mark.slow
def test_a_sitting_that_ends_goes_on_from_the_detectors_brought_back(tmp_path: Path) -> None:
    small = tiny(tmp_path)
    kept = ("--kept", str(tmp_path / "kept"))
    cut = study("rivals.train", "scale", *small, *kept, "--out", str(tmp_path / "first"), "--minutes", "0.0001")
    assert cut.endswith("the sitting is over; the same command goes on\n")
    whole = study("rivals.train", "scale", *small, *kept, "--out", str(tmp_path / "second"))
    assert {path.stem for path in (tmp_path / "kept").iterdir()} == {run.name for run in plan("scale")}
    assert f"| {PLAIN} | 1 | 1 |" in whole and "v2x-vit" in (tmp_path / "second/benchmark/tables.md").read_text()
    again = study("rivals.train", "scale", *small, *kept, "--out", str(tmp_path / "third"))
    assert not list((tmp_path / "third").glob("*/detector.pt")) and f"| {PLAIN} | 1 | 1 |" in again


@pytest.mark.slow
def test_processes_share_trainings_and_lines_that_are_not_finished_are_not_measured(tmp_path: Path) -> None:
    small = tiny(tmp_path)
    folder = ("--out", str(tmp_path / "runs"))
    early = run_study("rivals.train", "scale", *small, *folder, "--only", "attfuse-1")
    assert early.returncode and early.stderr == "teacher-2: this training comes first and is not finished\n"
    none = run_study("rivals.train", "scale", *small, *folder, "--measure")
    assert none.returncode and none.stderr == "measure: no line has all its trainings\n"
    shared = study("rivals.train", "scale", *small, *folder, "--only", "teacher-?", "attfuse-*", "where2comm-1")
    assert "GFLOP" not in shared and not (tmp_path / "runs/dsrc-1").exists()
    study("rivals.train", "scale", *small, *folder, "--measure")
    table = (tmp_path / "runs/benchmark/tables.md").read_text()
    assert PLAIN in table and "where2comm" not in table and DSRC not in table


@pytest.mark.slow
def test_two_processes_train_each_run_once(tmp_path: Path) -> None:
    words = ("scale", *tiny(tmp_path), "--out", str(tmp_path / "runs"), "--only", "*")
    command = [sys.executable, "-m", "studies.rivals.train", *words]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    told = [process.communicate(timeout=600)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    trained = [re.findall(r"^(\S+): \d+ s$", text, re.MULTILINE) for text in told]
    assert sorted(trained[0] + trained[1]) == sorted(run.name for run in plan("scale"))


def test_what_another_process_trains_is_left_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr(train, "train", lambda recipe, data, out, *more, **named: made.append(out.name))
    options = Namespace(out=tmp_path, kept=None, only=["*"], share=0.01, workers=0, data=tmp_path)
    known = {run.name: run for run in plan("scale")}
    with locked(tmp_path / "claims/teacher-1", what="training"):
        assert not train.claim(known["teacher-1"], known, options) and not made
    assert not train.claim(known["attfuse-1"], known, options) and not made  # its start is not there
    assert train.claim(known["teacher-1"], known, options) and made == ["teacher-1"]
    kept = Namespace(**vars(options) | {"kept": tmp_path / "kept"})
    record = {"frames": 60, "bfloat16": True, "ap_bev_50": 0.5, "ap_bev_70": 0.5}
    for name in ("teacher-1", "teacher-2"):
        write_file(kept.kept / f"{name}.json", json.dumps(record))
    with pytest.raises(SystemExit, match="teacher-2: this training comes first and is not finished"):
        train.finish(known["attfuse-1"], known, kept)  # of its start only the record was kept
    (tmp_path / "folder").touch()
    with pytest.raises(DataError, match="cannot write in this folder"):
        train.claim(known["teacher-1"], known, Namespace(**vars(options) | {"out": tmp_path / "folder"}))


def test_tables_have_the_methods_in_the_order_of_the_plan(tmp_path: Path) -> None:
    words = ("--list", "--share", "0.25", "--longest", "2000", "--out", str(tmp_path))
    told = study("rivals.train", "rivals", *words).splitlines()
    titles = dict.fromkeys(line.partition("; a training of ")[2] for line in told if "; a training of " in line)
    assert list(titles) == [PLAIN, DSRC, *RIVALS]


def test_records_without_weights_choose_the_rate(tmp_path: Path) -> None:
    """All methods but late fusion were better at the lower rate."""
    for run in rivals(lambda name: 0.0, longest=1000):
        recipe = run.recipe(0.25)
        good = run.name.endswith("-slow") != (run.method == "late")
        frames = recipe.epochs * (recipe.epoch_frames or 0)
        start = STARTS / f"{run.start}.pt"
        record: dict[str, object] = {"frames": frames, "bfloat16": True, "ap_bev_50": 0.7 if good else 0.6}
        record |= {"ap_bev_70": 0.5, "start": file_sha256(start) if start.is_file() else None}
        (tmp_path / f"{run.name}.json").write_text(json.dumps(record))
    options = ("--share", "0.25", "--longest", "1000", "--kept", str(tmp_path), "--out", str(tmp_path / "runs"))
    found = run_study("rivals.train", "rivals", *options, "--measure")
    assert found.stderr == "measure: no line has all its trainings\n"
    named = [line.partition(":")[0] for line in found.stdout.splitlines()]
    assert {name: named.count(name) for name in ("late-1000-0", "late-1000-0-slow")} == {
        "late-1000-0": 2,  # tried, then measured
        "late-1000-0-slow": 1,
    }
    assert named.count("early-1000-0") == 1 and named.count("early-1000-0-slow") == 2


def test_a_kept_training_of_another_length_is_refused(tmp_path: Path) -> None:
    kept = ("--kept", "studies/rivals/kept", "--out", str(tmp_path))
    found = run_study("rivals.train", "parts", "--only", "alone", "--share", "0.1", *kept)
    assert found.returncode == 2 and found.stderr == (
        "train: studies/rivals/kept/alone.pt: frames of the training: expected 1200, as --share 0.1 asks, found 3000; "
        "another share has another folder\n"
    )


def test_a_kept_training_from_another_start_is_refused(tmp_path: Path) -> None:
    record = json.loads((ROOT / "studies/rivals/kept/attfuse-1000-0.json").read_text()) | {"start": "0" * 64}
    shutil.copy(ROOT / "studies/rivals/kept/alone.pt", tmp_path)
    (tmp_path / "attfuse-1000-0.json").write_text(json.dumps(record))
    options = ("--share", "0.25", "--only", "attfuse-1000-0", "--kept", str(tmp_path), "--out", str(tmp_path / "runs"))
    found = run_study("rivals.train", "rivals", *options)
    assert found.returncode == 2
    assert f"attfuse-1000-0.json: start: expected {file_sha256(tmp_path / 'alone.pt')} of" in found.stderr
    assert found.stderr.endswith("found 0000000000000000000000000000000000000000000000000000000000000000\n")


def test_trainings_of_two_precisions_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {"a.pt": True, "b.pt": True, "c.pt": False}
    monkeypatch.setattr(train, "read_meta", lambda path: {"settings": {"recipe": {"bfloat16": made[path.name]}}})
    train.check_precision([Path("a.pt"), Path("b.pt")])
    with pytest.raises(SettingsError, match=r"c\.pt: bfloat16: expected True, as a\.pt was trained, found False"):
        train.check_precision([Path("a.pt"), Path("c.pt")])


@pytest.mark.parametrize("share", [0.01, 0.2, 0.25, 0.33, 1.0])
def test_a_share_of_a_plan_is_that_share_of_the_steps_of_each_training(share: float) -> None:
    for run in plan("parts"):
        recipe = run.recipe(share)
        assert recipe.epochs * (recipe.epoch_frames or 0) == pytest.approx(4 * run.steps * share, abs=recipe.epochs + 4)
