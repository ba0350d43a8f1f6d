"""The examples run: each says how to use it, and draws on a small setting."""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Outcome, Percept
from dsrc.data.datasets.convert import Format, convert
from dsrc.data.drives import open_drive
from dsrc.data.sample import Sample, SampleRequest
from dsrc.data.write import write_drive
from dsrc.evaluation.cache import CellSettings, write_cell
from dsrc.evaluation.conditions import Condition
from dsrc.evaluation.detect import Method, evaluate_drive
from dsrc.evaluation.stored import StoredDrive, StoredIndex, StoredRun, write_index
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sensors.corruptions import CORRUPTIONS
from sensors.presets import LIDARS
from sim.boxes import CLASSES, Boxes
from sim.errors import UserError
from sim.traffic.base import Actors
from tests.commands import run_script
from tests.dsrc.closed_loop.logged import Mover, ahead, episode, ticks_of
from tests.dsrc.data.toy import SETTINGS, ToySource
from tests.dsrc.evaluation.fakes import GRID, PointCounter
from tests.dsrc.evaluation.small import make_detector, write_detector, write_drives
from tests.paths import ROOT

SCRIPTS = sorted(path for path in (ROOT / "examples").glob("*.py") if path.name != "look.py")
SMALL = {
    "channel.py": ("--frames", "28"),
    "corruptions.py": ("--only", "fog", "pose_error", "--scenario", "four_way"),
    "lidar_presets.py": ("--only", "debug-16", "--scenario", "four_way"),
    "lidar_effects.py": (),
    "scenarios.py": ("--only", "ped_bus_stop"),
    "places.py": ("--only", "four_way"),
    "same_crash.py": ("--perceptions", "truth", "truth"),
    "lidar_realism.py": ("--scenarios", "four_way", "--sensors", "debug-16", "--frames", "1"),
}


def run(script: Path, *args: str) -> str:
    """Run an example and return what it printed."""
    result = run_script(script, *args, env={"DSRC_LIDAR_ENGINE": "public"})
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_an_example_says_what_it_is_and_how_to_use_it(script: Path) -> None:
    text = ast.get_docstring(ast.parse(script.read_text())) or ""
    assert f"Usage:\n    python examples/{script.name}" in text
    assert script.name in (ROOT / "examples" / "README.md").read_text()
    assert text.splitlines()[0] in run(script, "--help")


@pytest.mark.parametrize("script", [path for path in SCRIPTS if path.name in SMALL], ids=lambda path: path.name)
def test_an_example_draws_in_seconds_on_a_small_setting(script: Path, tmp_path: Path) -> None:
    printed = run(script, "--out", str(tmp_path), *SMALL[script.name])
    pictures = list(tmp_path.glob("*.png"))
    assert pictures
    for picture in pictures:
        assert str(picture) in printed
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < 300_000


def test_some_corruptions_are_drawn_beside_the_sheet_of_all(tmp_path: Path) -> None:
    (tmp_path / "all.png").write_bytes(b"of all")
    run(ROOT / "examples/corruptions.py", "--out", str(tmp_path), "--only", "fog", "--scenario", "four_way")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.png", "fog.png"]
    assert (tmp_path / "all.png").read_bytes() == b"of all"


FAKE_LOADER = '''
"""A loader with the interface of OpenCOOD's, by the rules of tests/dsrc/data/loaders.py."""
from pathlib import Path

import numpy as np

from tests.dsrc.data.loaders import opv2v


class BaseDataset:
    def __init__(self, params, visualize, train):
        self.samples = opv2v(Path(params["validate_dir"]))

    def __len__(self):
        return len(self.samples)

    def retrieve_base_data(self, index):
        agents = self.samples[index]["agents"]
        poses = {name: one["world_from_lidar"] for name, one in agents.items()}
        ego = next(iter(agents))
        return {
            str(name): {
                "ego": name == ego,
                "lidar_np": one["points"] + np.float32(SHIFT_M),
                "params": {
                    "transformation_matrix": np.linalg.inv(poses[ego]) @ poses[name],
                    "vehicles": {
                        number: {"location": pose[:3, 3], "center": [0.0, 0.0, 0.0], "extent": half}
                        for number, (pose, half) in one["boxes"].items()
                    },
                },
            }
            for name, one in agents.items()
        }
'''


@pytest.mark.parametrize(("shift_m", "code"), [(0.0, 0), (0.001, 1)])
def test_what_a_loader_of_others_reads_is_compared(tmp_path: Path, shift_m: float, code: int) -> None:
    for name in ("one", "two"):
        write_drive(tmp_path / "test" / name, SETTINGS, ToySource().open)
    module = tmp_path / "checkout/opencood/data_utils/datasets/basedataset.py"
    module.parent.mkdir(parents=True)
    module.write_text(f"SHIFT_M = {shift_m}\n{FAKE_LOADER}")
    words = [ROOT / "examples/read_by_opencood.py", tmp_path / "test", "--opencood", tmp_path / "checkout"]
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == code, done.stderr
    assert ("sweeps of other points" in done.stdout) == bool(code)
    assert "centres of boxes, m" in done.stdout


FAKE_COALIGN = '''
"""A loader with the interface of CoAlign's, by the rules of tests/dsrc/data/loaders.py."""
import json
from pathlib import Path

from tests.dsrc.data.loaders import dair


class DAIRV2XBaseDataset:
    def __init__(self, params, visualize, train):
        self.root = Path(params["data_dir"])
        self.split_info = json.loads(Path(params["validate_dir"]).read_text())

    def __len__(self):
        return len(self.split_info)

    def retrieve_base_data(self, number):
        sample = dair(self.root, [self.split_info[number]])[0]
        pairs = json.loads((self.root / "cooperative/data_info.json").read_text())
        (path,) = (p["cooperative_label_path"] for p in pairs if sample["frame"] in p["vehicle_image_path"])
        sides = [{"lidar_np": a["points"], "params": {"lidar_pose": a["world_from_lidar"]}} for a in sample["agents"]]
        sides[0]["params"]["vehicles_all"] = json.loads((self.root / path).read_text())
        return dict(enumerate(sides))
'''
FAKE_PCDET = '''
"""Objects and calibrations with the interface of OpenPCDet's."""
from types import SimpleNamespace

import numpy as np


def get_objects_from_label(path):
    rows = [[float(value) for value in line.split()[1:]] for line in path.read_text().splitlines()]
    return [SimpleNamespace(h=r[7], w=r[8], l=r[9], loc=np.array(r[10:13]), ry=r[13]) for r in rows]


class Calibration:
    def __init__(self, path):
        rows = dict(line.split(":") for line in path.read_text().splitlines())
        self.turn = np.array(rows["Tr_velo_to_cam"].split(), float).reshape(3, 4)

    def rect_to_lidar(self, points):
        return (points - self.turn[:, 3]) @ self.turn[:, :3]
'''


@pytest.mark.parametrize("kind", ["dair", "kitti", "mcap"])
def test_what_tools_of_others_read_of_a_conversion_is_compared(tmp_path: Path, kind: Format) -> None:
    source, out, checkout = tmp_path / "data/test", tmp_path / "converted", tmp_path / "checkout"
    write_drive(source / "one", SETTINGS, ToySource().open)
    if kind == "mcap":
        pytest.importorskip("mcap.reader")
    convert(source, out, kind, **({"agent_id": "all", "view": "around"} if kind == "kitti" else {}))
    modules = {
        "opencood/data_utils/datasets/basedataset/dairv2x_basedataset.py": FAKE_COALIGN,
        "opencood/utils/transformation_utils.py": "def x_to_world(pose):\n    return pose\n",
        "pcdet/utils/object3d_kitti.py": FAKE_PCDET,
        "pcdet/utils/calibration_kitti.py": FAKE_PCDET,
    }
    for name, text in modules.items():
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_text(text)
    words = {
        "dair": ["coalign.py", out / "cooperative-vehicle-infrastructure", "--coalign", checkout],
        "kitti": ["kitti.py", out, "--source", source, "--openpcdet", checkout],
        "mcap": ["mcap.py", out, "--source", source],
    }[kind]
    command = [sys.executable, ROOT / f"examples/read_by_{words[0]}", *words[1:]]
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counts = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines())
    assert float(counts["points"]) > 100 and float(counts["boxes"]) > 5


def test_a_driver_of_one_s_own_drives_beside_the_shipped_one() -> None:
    cautious, planning = run(ROOT / "examples/own_driver.py", "--seeds", "1").splitlines()
    assert cautious.startswith("cautious  seed 0  ")
    assert planning.startswith("planning  seed 0  arrived")


@pytest.mark.slow
def test_a_detector_of_one_s_own_sees_what_nothing_hides() -> None:
    own, truth = run(ROOT / "examples/own_detector.py").splitlines()
    assert own.split()[:2] == ["own_detector:Clusters", "arrived,"]
    assert truth.split()[:2] == ["truth", "arrived,"]


def test_the_campaign_trains_every_detector_of_the_tables_after_those_it_needs() -> None:
    commands = run(ROOT / "examples/campaign.py", "--data", "data", "--out", "runs", "--dry-run").splitlines()
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
        tomllib.loads((ROOT / f"docs/results/dsrc-sim-small/{name}.toml").read_text())
        for name in ("benchmark", "twins")
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
        run(ROOT / "examples/campaign.py", *arguments)
    assert (run_folder / "detector.pt").read_bytes() == b"done"
    names, *lines = (tmp_path / "runs/trainings.csv").read_text().splitlines()
    assert [dict(zip(names.split(","), line.split(","), strict=True)) for line in lines] == [
        {
            **{"name": "first", "phase": "1", "method": "no-collaboration", "stage": "plain", "seed": "0", "init": ""},
            **{"tensors_taken": "", "teacher": "", "settings": "", "data": "", "steps": "20", "minutes": "1.5"},
            **{"val_ap_bev_50": "0.2", "val_ap_bev_70": "0.1"},
        }
    ]


def test_the_campaign_validates_on_as_many_frames_as_it_is_told() -> None:
    for told, trial, frames in ((), (), 140), (("--validation-frames", "24"), (), 24), ((), ("--trial", "2"), 16):
        arguments = ("--data", "data", "--out", "runs", "--only", "first", "--dry-run", *told, *trial)
        assert f"validation_frames={frames}" in run(ROOT / "examples/campaign.py", *arguments).split()


def test_an_interrupted_campaign_says_so_and_ends_its_trainings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import campaign

    for part in ("train", "validation"):
        (tmp_path / "data" / part).mkdir(parents=True)
    endless = [sys.executable, "-c", "import time; time.sleep(600)"]
    monkeypatch.setattr(campaign, "command", lambda *_: endless)
    waits = iter((None, KeyboardInterrupt()))

    def sleep(_seconds: float) -> None:
        if reason := next(waits):
            raise reason

    monkeypatch.setattr(campaign.time, "sleep", sleep)
    started: list[subprocess.Popen] = []
    begin = campaign.subprocess.Popen
    monkeypatch.setattr(campaign.subprocess, "Popen", lambda *a, **k: started.append(begin(*a, **k)) or started[-1])
    arguments = ["campaign.py", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "runs"), "--only", "first"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="130"):
        campaign.main()
    assert capsys.readouterr().err.splitlines()[-1] == "campaign: interrupted; the same command continues it"
    assert [process.poll() for process in started] == [-15]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (("--only", "telepathy"), "--only: expected some of first, .* found telepathy"),
        (("--jobs", "0"), "--jobs: expected at least 1, found 0"),
        (("--validation-frames", "0"), "--validation-frames: expected at least 1, found 0"),
        (("--trial", "-3"), "--trial: expected at least 0, found -3"),
        (
            (),
            "--data: .*data: first needs its folder train, found none; `dsrc dataset build dsrc-sim --out",
        ),
    ],
)
def test_the_campaign_refuses_what_it_cannot_do_before_it_begins(
    wrong: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    folders = ("--data", str(tmp_path / "data"), "--out", str(tmp_path / "runs"))
    result = run_script(ROOT / "examples/campaign.py", *folders, *wrong)
    assert result.returncode == 2
    assert re.search(told, result.stderr.splitlines()[-1])
    assert not (tmp_path / "runs").exists()


def test_a_campaign_needs_the_drives_of_what_is_not_trained_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    from campaign import check_drives, drives_of
    from trainings import Training

    for part in ("train", "validation"):
        (tmp_path / "data" / part).mkdir(parents=True)
    both = [Training("vehicles", 1, "none"), Training("people", 6, "none", data="streets")]
    options = SimpleNamespace(data=tmp_path / "data", out=tmp_path / "runs", kept=tmp_path / "kept")
    check_drives(both[:1], options)
    with pytest.raises(UserError, match=r"people needs its folder train, .* build streets --out .*streets`"):
        check_drives(both, options)
    both[1].folder(options.kept).mkdir(parents=True)
    both[1].detector(options.kept).touch()
    check_drives(both, options)
    monkeypatch.chdir(tmp_path / "data")
    assert drives_of(both[1], Path(".")).resolve() == drives_of(both[1], options.data) == tmp_path / "streets"


@pytest.mark.parametrize("name", LIDARS)
def test_every_preset_is_pictured(name: str) -> None:
    picture = f"pictures/lidar/{name}.png"
    assert (ROOT / "docs" / picture).is_file(), (
        f"python examples/lidar_presets.py --out docs/pictures/lidar --only {name}"
    )
    assert f"]({picture})" in (ROOT / "docs" / "lidar.md").read_text()


@pytest.mark.parametrize("kind", [*CORRUPTIONS, "all"])
def test_every_corruption_is_pictured(kind: str) -> None:
    picture = f"pictures/corruptions/{kind}.png"
    assert (ROOT / "docs" / picture).is_file(), (
        f"python examples/corruptions.py --out docs/pictures/corruptions --only {kind}"
    )
    assert f"]({picture})" in (ROOT / "docs" / "corruptions.md").read_text()


def test_a_gate_passes_where_every_value_reaches_its_bound_and_a_missing_one_reaches_none() -> None:
    sys.path.insert(0, str(ROOT / "examples"))
    import gates

    bounds = {"gain_50": -1.0, "gain_70": 1.0}
    assert gates.gate("G1", {"gain_50": -0.9, "gain_70": 1.0}, bounds, "").passed
    assert not gates.gate("G1", {"gain_50": 5.0, "gain_70": 0.9}, bounds, "").passed
    assert not gates.gate("G1", {"gain_50": float("nan"), "gain_70": 2.0}, bounds, "").passed


def test_a_kept_training_has_no_path_of_the_machine_that_trained_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import campaign

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
    sys.path.insert(0, str(ROOT / "examples"))
    import campaign
    import gates

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
    assert "--epochs 1 " in run(
        ROOT / "examples/campaign.py", *folders, "--dry-run", "--lengthen", "0.1", "--only", "first"
    )
    assert "dsrc-single-halved_s0" in run(ROOT / "examples/campaign.py", *folders, "--dry-run", "--only", "dsrc_s0")
    assert not any("distill" in setting for setting in halved["attfuse_s0"].settings)
    gates.record(tmp_path, gates.gate("G2", {"gain_50": 1.0}, {"gain_50": 0.5}, ""))
    assert {name: gate.passed for name, gate in gates.recorded(tmp_path).items()} == {"G1": False, "G2": True}


def test_the_table_of_weather_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    document = tmp_path / "weather.md"
    document.write_text("before\n<!-- begin weather_shares -->\nold\n<!-- end weather_shares -->\nafter\n")
    script = ROOT / "examples" / "weather_shares.py"
    run(script, "--scenario", "four_way", "--lidar", "debug-16", "--docs", str(document))
    before, *table, after = (line for line in document.read_text().splitlines() if not line.startswith("<!--"))
    assert (before, after) == ("before", "after")
    cells = {row[1]: row[2:] for row in ([cell.strip() for cell in line.split("|")[:-1]] for line in table)}
    scattered = [float(cell.split(" / ")[0]) for cell in cells["**snow**"]]
    assert len(scattered) == 5
    assert scattered == sorted(scattered)
    assert scattered[-1] > 1.5 * scattered[0] > 0.0


def test_the_gates_refuse_a_folder_without_a_finished_teacher_in_one_line(tmp_path: Path) -> None:
    result = run_script(ROOT / "examples/gates.py", "--runs", str(tmp_path), "--data", str(tmp_path))
    assert result.returncode == 2
    assert "--runs: expected a finished teacher with" in result.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_training_without_its_package_says_in_one_line_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "stable_baselines3.py").write_text("raise ImportError\n")
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples/ppo.py"), "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        timeout=200,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"},
    )
    assert result.returncode == 2
    assert "stable-baselines3 is missing: pip install -e '.[rl]'" in result.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_snow_is_taken_apart_for_any_detector_and_drives(tmp_path: Path) -> None:
    drives = write_drives(tmp_path / "data")
    detector = write_detector(tmp_path / "detector.pt", "attfuse")
    arguments = ("--data", str(drives), "--checkpoint", str(detector), "--frames", "1")
    experiments, _, pillars = run(ROOT / "examples/snow_pillars.py", *arguments).strip().partition("\n| within 15 m")
    assert [line.split(" | ")[0] for line in experiments.splitlines()][2:4] == ["| clear air", "| **snow**"]
    assert experiments.splitlines()[-1].startswith("| norms' statistics measured again in snow")
    assert pillars.splitlines()[-1].startswith("| median confidence at true objects")
    clear = next(line for line in experiments.splitlines() if line.startswith("| clear air")).split(" | ")
    assert clear[1] == clear[2] and clear[3] == clear[4].rstrip(" |")  # of no severity


class Scorer(PointCounter):
    """Detects all true boxes with one score, moved along x."""

    def __init__(self, score: float, moved_m: float) -> None:
        super().__init__(need=0, offset=moved_m)
        self.score = score

    def detect(self, sample: Sample) -> Detections:
        found = super().detect(sample)
        return replace(found, score=np.full_like(found.score, self.score))


def write_results(out: Path, drives: Path, seen: dict[str, dict[int, tuple[float, float]]]) -> None:
    """Write results of methods whose trainings find all boxes with a score, moved by so many metres."""
    readers = [open_drive(path) for path in sorted(drives.iterdir())]
    runs = []
    for method, trainings in seen.items():
        for training, (score, moved_m) in trainings.items():
            cells = []
            for reader in readers:
                tested = Method(method, Scorer(score, moved_m))
                found = evaluate_drive(reader, [0, 1], {Condition(): [tested]}, 0)
                settings = CellSettings(
                    detector=f"{method} {training}",
                    use={},
                    drive=reader.drive.name,
                    data=reader.digest(),
                    positions=(0, 1),
                    condition={},
                    seed=0,
                    channel=None,
                    agents=1,
                    device="cpu",
                    engine="torch",
                    versions={},
                    code="",
                )
                write_cell(out / "cells", settings, found[Condition(), method])
                cells.append((settings.key,))
            run = StoredRun(
                method=method,
                training=training,
                kind="clean",
                severity=0,
                family="physical",
                channel="ideal",
                detector="0" * 64,
                range_m=GRID.range_m,
                agents=1,
                cells=tuple(cells),
            )
            runs.append(run)
    stored = [StoredDrive(dataset="toy", path=str(reader.drive), data=reader.digest()) for reader in readers]
    write_index(out, StoredIndex(seed=0, drives=tuple(stored), runs=tuple(runs)))


def test_a_method_is_ahead_where_its_boxes_count_and_the_other_s_do_not(tmp_path: Path) -> None:
    """A method finds all with a score of 0.3; of its rival one training does, with 0.5, and one is 20 m off."""
    sure, off = (0.5, 0.0), (0.5, 20.0)
    trainings = {"DSRC": {0: (0.3, 0.0), 1: (0.3, 0.0)}, "rival": {0: sure, 1: off}, "one": {0: sure}}
    write_results(tmp_path / "toy", write_drives(tmp_path / "data"), trainings)
    script = ROOT / "examples/score_thresholds.py"
    scores = ("--scores", "0.2", "0.3", "0.4", "0.6")
    *_, half, most = run(script, str(tmp_path / "toy"), "--baseline", "rival", *scores).splitlines()
    ahead, behind = "**+50.0 [+50.0, +50.0]**", "**-50.0 [-50.0, -50.0]**"
    assert half == f"| clean, 0.5 | {ahead} | {ahead} | {behind} | +0.0 [+0.00, +0.00] |"
    assert most == half.replace("0.5", "0.7", 1)
    several = run(script, str(tmp_path / "toy"), "--baseline", "rival", "one", *scores).splitlines()[-2:]
    cells = [line.strip("| ").split(" | ") for line in several]
    assert cells[0][:2] == ["DSRC − rival", "clean"]
    assert cells[0][2:] == ["**+50.0** / **+50.0**", "**+50.0** / **+50.0**", "**-50.0** / **-50.0**", "+0.0 / +0.0"]
    assert cells[1][2:] == ["+0.0 / +0.0", "+0.0 / +0.0", "**-100.0** / **-100.0**", "+0.0 / +0.0"]


def test_a_head_that_always_says_one_direction_is_right_where_the_other_guess_is_wrong(tmp_path: Path) -> None:
    """Its other heads say the same everywhere, too: no cell holds a vehicle, whatever the points."""
    for split in ("train", "validation", "test"):
        write_drives(tmp_path / "data" / split)
    detector = Detector(msgspec.structs.replace(make_detector("attfuse").settings, direction=True))
    for head, says in ((detector.direction_head, 1.0), (detector.cls_head, -30.0)):
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.constant_(head.bias, says)
    save_detector(tmp_path / "headed.pt", detector, {})
    other = write_detector(tmp_path / "other.pt", "attfuse")
    script, files = ROOT / "examples/feature_maps.py", (str(tmp_path / "headed.pt"), f"without={other}")
    printed = run(script, "--data", str(tmp_path / "data"), "--checkpoint", *files, "--frames", "4", "--tested", "4")
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()]
    shares = {row[1]: list(map(int, row[2:])) for row in rows[2:6]}
    assert {row[0] for row in rows[2:6]} == {"headed"}
    assert [a + b for a, b in zip(*list(shares.values())[:2], strict=True)] == [100, 100]
    assert all(0 <= share <= 100 for two in shares.values() for share in two)
    frames, below, share, boxes, inside, least, without = rows[8][1:]
    assert (frames, below, share, boxes, least, without) == ("4", "4", "100.00", inside, "-30", "-30")
    assert int(boxes) > 0
    assert rows[9][0] == "without" and rows[9][4] == boxes and rows[9][5] == "0"


def test_false_tracks_and_late_ones_are_counted(tmp_path: Path) -> None:
    """A car that is found from 1 s on, and a box 20 m beside it in each of the 45 percepts, where nobody is."""

    def sees(now: Actors) -> Percept:
        boxes = now.boxes[[1, 1]]
        boxes = replace(boxes, center=boxes.center + np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 0.0]]))
        score = np.array([0.7 if now.time_s > 0.95 else 0.05, 0.7])
        return Percept(now.time_s, boxes, score, np.full((2, 2), np.nan))

    movers = [Mover("ego", ahead(0.0)), Mover("car", ahead(5.0, x=30.0))]
    (tmp_path / "episodes").mkdir()
    episode(movers, 45, sees=sees, detector="0" * 64).save(tmp_path / "episodes/one.npz")
    printed = run(ROOT / "examples/tracking.py", str(tmp_path), "--set", "ghosts_per_m2=1e9").splitlines()
    assert {"| 0 to 0.1 | 10 | 100 |", "| 0.7 to 1 | 80 | 44 |"} <= set(printed)
    now, never = (line.split(" | ")[1:] for line in printed[-2:])
    # Both are known from their second box on: the false one in 44 of 45 instants, the car a second late.
    assert now == ["45", "0.98", "0.98", "76", "1.10", "0 |"]
    assert never == ["45", "0.00", "0.00", "0", "3.00", "100 |"]


def test_what_a_perception_knows_of_the_conflict_actor_is_counted(tmp_path: Path) -> None:
    """A car that is in every second percept from 1 s on, with a score of 0.4."""

    def sees(now: Actors) -> Percept:
        seen = now.time_s > 0.95 and round(10 * now.time_s) % 2 == 0
        boxes = now.boxes[[1] if seen else []]
        return Percept(now.time_s, boxes, np.full(len(boxes), 0.4), np.full((len(boxes), 2), np.nan))

    movers = [Mover("ego", ahead(0.0)), Mover("conflict", ahead(5.0, x=30.0))]
    before, ticks = ticks_of(movers, 45, sees)
    tracker = Tracker()
    ticks = [replace(tick, tracks=tracker.update(tick.percept, tick.ego.time_s)) for tick in ticks]
    (tmp_path / "episodes").mkdir()
    settings = episode(movers, 1, detector="0" * 64, perception="team").settings
    other = episode(movers, 1, detector="1" * 64, perception="team", corruption="snow", severity=3).settings
    EpisodeLog(settings, before, ticks, Outcome.TIMEOUT).save(tmp_path / "episodes/one.npz")
    EpisodeLog(other, before, ticks[:5], Outcome.TIMEOUT).save(tmp_path / "episodes/other.npz")
    script, scenario = ROOT / "examples/tracking.py", settings.scenario.name
    head, _, row, never = run(script, str(tmp_path), "--scenario", scenario).splitlines()[-4:]
    assert head.split(" | ")[2:5] == ["episodes", "percepts with a box of it, %", "median score"]
    name, condition, episodes, boxed, score, tracked = row.strip("| ").split(" | ")
    assert (name, condition, episodes, score) == ("team 00000000", "clean", "1", "0.40")
    assert float(boxed) == pytest.approx(50, abs=2)
    assert 50 < float(tracked) < 100, tracked  # one weak box confirms no track
    assert never == "| team 11111111 | snow 3 | 1 | - | - | - |"
    wrong = run_script(script, str(tmp_path), "--scenario", scenario, "elsewhere")
    assert wrong.returncode == 2 and f"--scenario: expected some of {scenario}, found elsewhere" in wrong.stderr


@pytest.mark.parametrize(("yaw", "along"), [(np.pi + 0.4, "100"), (0.6, "0")])
def test_who_is_found_as_what_is_counted_by_class(monkeypatch: pytest.MonkeyPatch, yaw: float, along: str) -> None:
    """A network that takes all for bicycles, misses what is behind, and sees two of one and somebody who is not."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import road_users

    settings = SampleRequest(GridSpec(range_m=(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0)), users="vulnerable")
    people = Boxes.from_array(
        [(x, 2.0, -1.0, 0.5, 0.5, 1.7, 0.0) for x in (8.0, 12.0, -9.0)],
        [CLASSES.index(name) for name in ("pedestrian", "motorcycle", "pedestrian")],
    )
    boxes = Boxes.from_array([(x, y, -1, 1.8, 0.6, 1.7, yaw) for x, y in ((8.9, 2), (12, 2), (12.5, 2), (12, 4))])
    boxes = replace(boxes, label=np.full(4, CLASSES.index("bicycle")))
    sample = SimpleNamespace(boxes=people)
    monkeypatch.setattr(road_users, "make_sample", lambda frame, ego, request: sample)
    detector = SimpleNamespace(
        settings=settings, detect=lambda _: Detections(boxes, np.array([0.9, 0.5, 0.4, 0.3], np.float32))
    )
    rows = list(road_users.counted([pair for frame in range(2) for pair in road_users.pairs(detector, frame)]))
    assert rows == [
        ["pedestrian", "4", "2", "0", "2", "0.90", "-"],
        ["bicycle", "0", "0", "0", "0", "-", "-"],
        ["motorcycle", "2", "2", "0", "2", "0.50", along],
        ["matched already", "-", "2", "0", "2", "0.40", "-"],
        ["nobody", "-", "2", "0", "2", "0.30", "-"],
    ]


@pytest.mark.parametrize(
    ("script", "arguments", "told"),
    [
        ("road_users.py", ("--data", "nowhere", "--checkpoint", "x.pt"), "nowhere"),
        ("tracking.py", ("docs",), "docs: expected episodes of a detector, found none"),
        ("tracking.py", ("docs", "--seed", "3"), "found none with these seeds"),
        ("tracking.py", ("docs", "--scenario", "x"), "docs: expected episodes of a detector, found none"),
        ("tracking.py", ("docs", "--set", "gait=2"), "--set: expected NAME=VALUE, a number of TrackerSettings, found"),
        ("tracking.py", ("docs", "--set", "gate=nan"), "a number of TrackerSettings, found gate=nan"),
        ("tracking.py", ("docs", "--set", "history_s=a"), "a number of TrackerSettings, found history_s=a"),
        ("tracking.py", ("docs", "--set", "ghosts_per_m2=0"), "--set: ghosts_per_m2: expected more than 0, found 0"),
        ("zoo.py", ("nowhere",), "runs: expected finished trainings in nowhere, found none"),
        (
            "zoo.py",
            ("docs/results/dsrc-sim-small/kept", "--docs", "docs/lidar.md"),
            "docs/lidar.md: zoo: expected the lines <!-- begin zoo -->",
        ),
        ("feature_maps.py", ("--data", "nowhere", "--checkpoint", "x.pt"), "x.pt: "),
        ("feature_maps.py", ("--data", "x", "--checkpoint", "x.pt", "--frames", "2"), "--frames: expected at least 3"),
        ("score_thresholds.py", ("nowhere",), "nowhere: results: expected a folder, found no such folder"),
        ("score_thresholds.py", ("nowhere", "--scores", "2"), "--scores: expected numbers from 0 to 1, found 2"),
        ("score_thresholds.py", ("nowhere", "--scores", "nan"), "--scores: expected numbers from 0 to 1, found nan"),
    ],
)
def test_a_table_that_cannot_be_made_is_told_in_one_line(script: str, arguments: tuple[str, ...], told: str) -> None:
    result = run_script(ROOT / "examples" / script, *arguments)
    assert result.returncode == 2 and told in result.stderr and "Traceback" not in result.stderr
