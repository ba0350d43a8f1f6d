"""Any detector opens by its text, wherever `--checkpoint` stands."""

import json
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.sample import make_sample
from dsrc.detectors.check import check_detector
from dsrc.detectors.levelled import LevelledDetector
from dsrc.detectors.open import detector_sha256, open_detector
from dsrc.detectors.texts import kind_of, split_name, stem_of
from dsrc.evaluation.config import read_benchmark
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.sharing.drives import share_drives
from dsrc.evaluation.stored import read_index
from dsrc.options.detection import Evaluation, Sharing
from dsrc.review.model import open_model
from dsrc.review.sources.detected import ComputedSet
from dsrc.runs.executors import Pool
from sim.errors import CheckpointError, SettingsError
from tests.commands import dsrc
from tests.dsrc.data.toy import toy_frame
from tests.dsrc.evaluation.fakes import write_drives
from tests.paths import ROOT

EXAMPLE = ROOT / "examples" / "11_detector_process.py"
PIPE = f"pipe:{sys.executable} {EXAMPLE}"
OWN = """
import numpy as np
import dsrc

class Densest:
    settings = dsrc.SampleRequest(dsrc.GridSpec((-51.2, -25.6, -3.0, 51.2, 25.6, 1.0)))

    def detect(self, sample):
        points = np.concatenate(sample.clouds)[:, :3]
        points = points[(points[:, 2] > -1.3) & (points[:, 2] < 0.0)]
        cells, count = np.unique(np.floor(points[:, :2] / 4.0), axis=0, return_counts=True)
        best = np.argsort(-count)[:20]
        boxes = [[4.0 * x + 2.0, 4.0 * y + 2.0, -1.0, 4.5, 1.9, 1.6, 0.0] for x, y in cells[best]]
        return dsrc.Detections(dsrc.Boxes.from_array(boxes), (count[best] / (count[best] + 50.0)).astype(np.float32))

class Peeping(Densest):
    def detect(self, sample):
        return dsrc.Detections(sample.boxes, np.ones(len(sample.boxes), np.float32))

class Moody(Densest):
    calls = 0
    def detect(self, sample):
        self.calls += 1
        return super().detect(sample)[: self.calls]

class Careless(Densest):
    def detect(self, sample):
        sample.clouds[0][:] = 0.0
        return super().detect(sample)

class Sure(Densest):
    def detect(self, sample):
        found = super().detect(sample)
        return dsrc.Detections(found.boxes, found.score + 1.0)

class Crashing(Densest):
    def detect(self, sample):
        return self.network(sample)

class Fussy(Densest):
    def detect(self, sample):
        sample.clouds[0].min()
        return super().detect(sample)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "my_eyes.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [p for p in sys.path if p not in ("", str(tmp_path))])
    monkeypatch.delitem(sys.modules, "my_eyes", raising=False)
    return "my_eyes:Densest"


@pytest.mark.parametrize(
    ("text", "name", "kind", "stem"),
    [
        ("a/b.pt", "", "file", "b"),
        ("runs/a=1/b.pt", "", "file", "b"),
        ("mine=a/b.onnx", "mine", "onnx", "b"),
        ("mine=my.eyes:Own", "mine", "class", "Own"),
        ("02_own_detector:Clusters", "", "class", "Clusters"),
        ("pipe:python serve.py --weights=a/b.pth", "", "pipe", "serve"),
        ("mine=pipe:env A=1 python serve.py", "mine", "pipe", "serve"),
        ("tcp://localhost:5005", "", "tcp", "localhost:5005"),
        ("mine=tcp://localhost:5005", "mine", "tcp", "localhost:5005"),
    ],
)
def test_a_text_has_a_name_a_kind_and_a_stem(text: str, name: str, kind: str, stem: str) -> None:
    found, detector = split_name(text)
    assert (found, kind_of(detector), stem_of(detector)) == (name, kind, stem)


def test_a_class_and_a_process_of_the_same_rule_find_the_same(own: str) -> None:
    ours, theirs = open_detector(own), open_detector(PIPE)
    sample = make_sample(toy_frame(0), None, ours.settings.request)
    one, other = ours.detect(sample), theirs.detect(sample)
    assert len(one) > 0 and np.allclose(one.boxes.array, other.boxes.array) and np.allclose(one.score, other.score)


@pytest.mark.slow
def test_an_evaluation_takes_them_all_with_workers_resume_and_provenance(own: str, tmp_path: Path) -> None:
    write_drives(tmp_path / "data")
    config = Evaluation(
        checkpoint=(own, f"theirs={PIPE}"), data=tmp_path / "data", out=tmp_path / "out", corruption=("fog",)
    )
    rows = evaluate_drives(config, Pool(workers=2))
    found = {(row.method, row.condition): row for row in rows}
    assert found["Densest", "clean"].detections > 0
    for kind in ("clean", "fog"):
        ours, theirs = found["Densest", kind], found["theirs", kind]
        assert (ours.detections, ours.truth) == (theirs.detections, theirs.truth)
        assert ours.metrics == pytest.approx(theirs.metrics, nan_ok=True, abs=1e-6)
    before = {path: path.stat().st_mtime_ns for path in (config.out / "cells").iterdir()}
    evaluate_drives(config)
    assert {path: path.stat().st_mtime_ns for path in (config.out / "cells").iterdir()} == before
    methods = json.loads((config.out / "results.json").read_text())["provenance"]["settings"]["methods"]
    assert methods["Densest"][0]["file"] == own and methods["theirs"][0]["file"] == PIPE
    assert methods["theirs"][0]["sha256"] == detector_sha256(PIPE)
    assert {run.detector for run in read_index(config.out).runs} == {detector_sha256(own), detector_sha256(PIPE)}


def test_shares_and_view_take_them(own: str, tmp_path: Path) -> None:
    write_drives(tmp_path / "data", drives=1, frames=1)
    rows = share_drives(Sharing(checkpoint=own, data=tmp_path / "data", out=tmp_path / "shares"))
    assert rows and {row.agent for row in rows} >= {"ego"}
    model = open_model(tmp_path / "data", own)
    assert "Densest" in model.sources[0].sets
    levelled = open_model(tmp_path / "data", own, height="auto").sources[0].sets["Densest"]
    assert isinstance(levelled, ComputedSet) and isinstance(levelled.detector.open(), LevelledDetector)


def test_a_changed_class_is_another_detector(own: str, tmp_path: Path) -> None:
    first = detector_sha256(own)
    assert detector_sha256("my_eyes:Sure") != first
    (tmp_path / "my_eyes.py").write_text(OWN.replace("50.0", "60.0"))
    assert detector_sha256(own) != first


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Densest", ""),
        ("Peeping", "truth: expected the same detections without `sample.boxes`"),
        ("Moody", "again: expected the same detections of the same sample"),
        ("Careless", "sample: expected the clouds and poses as they were"),
        ("Sure", "score: expected 0 to 1, found 1.48"),
        ("Crashing", "detect: AttributeError: 'Crashing' object has no attribute 'network'"),
        ("Fussy", "empty cloud: ValueError"),
        ("Nothing", "expected a class that loads, found AttributeError"),
    ],
)
def test_a_broken_rule_is_one_line(own: str, name: str, line: str) -> None:
    if not line:
        check_detector(f"my_eyes:{name}")
        return
    with pytest.raises(SettingsError) as raised:
        check_detector(f"my_eyes:{name}")
    lines = str(raised.value).splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"my_eyes:{name}: ") and line in lines[0]


def test_instances_classes_and_processes_are_checked_too(own: str) -> None:
    check_detector(PIPE)
    check_detector(own)  # the current folder is found from here on
    made = import_module("my_eyes").Densest
    check_detector(made)
    check_detector(made())
    with pytest.raises(SettingsError, match="object: detect: expected a method, found none"):
        check_detector(object())


def test_what_does_not_open_is_one_line(own: str, tmp_path: Path) -> None:
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    with pytest.raises(CheckpointError, match=r"gone\.pt: no such checkpoint file"):
        open_detector(tmp_path / "gone.pt")
    with pytest.raises((CheckpointError, SettingsError), match=r"bad\.onnx: (not a readable|packages)"):
        open_detector(tmp_path / "bad.onnx")
    with pytest.raises(SettingsError, match="use: expected none beside a detector of one's own, found nms_iou"):
        open_detector(own, use={"nms_iou": 0.1})
    result = dsrc("evaluate", "data", "--checkpoint", "my_eyes:Gone", "--out", "out")
    assert result.returncode == 2 and len(result.stderr.strip().splitlines()) == 1, result.stderr


def test_a_file_starts_no_program(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    command = f"pipe:touch {tmp_path}/made"
    methods = f'[[methods]]\nname = "x"\ndetectors = ["{command}"]\n'
    plan.write_text(methods + '[[datasets]]\nname = "y"\ndrives = ["z"]\n')
    with pytest.raises(SettingsError, match=r"methods\.x\.detectors: expected no command: files start no programs"):
        read_benchmark(plan)
    assert not (tmp_path / "made").exists()


def test_a_script_that_is_the_program_itself_is_known_by_its_content(tmp_path: Path) -> None:
    script, text = tmp_path / "serve", f"pipe:{tmp_path}/serve"
    hashes = []
    for comment in ("first", "second"):
        script.write_text(f"#!/bin/sh\n# {comment}\nexec {PIPE.removeprefix('pipe:')}\n")
        script.chmod(0o755)
        hashes.append(detector_sha256(text))
    assert hashes[0] != hashes[1]
