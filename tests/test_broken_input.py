"""Broken input at the command line: one line that names it, exit code 2, no other output."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from msgspec.structs import replace

from dsrc.__main__ import main
from dsrc.data.write import write_drive
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from dsrc.training.recipes import debug
from tests.dsrc.data.toy import SETTINGS, ToySource
from tests.paths import ROOT


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Folder with one valid drive."""
    write_drive(tmp_path / "data" / "toy_3", SETTINGS, ToySource().open)
    return tmp_path / "data"


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Function that runs `dsrc` and returns its one line of error; a stack trace would be an exception here."""

    def run(*args: object) -> str:
        with pytest.raises(SystemExit) as leaving:
            main([str(arg) for arg in args])
        assert leaving.value.code == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
        assert len(lines) == 1, lines
        return lines[0]

    return run


def first(data: Path, pattern: str) -> Path:
    return sorted(data.glob(f"*/*/{pattern}"))[0]


def cut(data: Path) -> str:
    path = first(data, "*.pcd")
    path.write_bytes(path.read_bytes()[:-100])
    return path.name


def execute(data: Path) -> str:
    path = first(data, "*.yaml")
    body = path.read_text().partition("\n")[2]
    path.write_text(body + "extra: !!python/object/apply:os.system ['touch owned']\n")
    return path.name


def not_a_number(data: Path) -> str:
    path = first(data, "*.yaml")
    body = path.read_text().partition("\n")[2]
    assert "extent:" in body
    head, _, tail = body.partition("extent:")
    line, _, rest = tail.partition("\n")
    broken = line.replace(line.strip(" []").split(",")[0], ".nan", 1) if "[" in line else line
    rest = rest if "[" in line else "\n".join(["    - .nan", *rest.split("\n")[1:]])
    path.write_text(f"{head}extent:{broken}\n{rest}")
    return path.name


def lost_agent(data: Path) -> str:
    folder = next(p for p in sorted(data.glob("*/*")) if p.is_dir() and p.name.startswith("-"))
    shutil.rmtree(folder)
    return folder.name


@pytest.mark.parametrize("damage", [cut, execute, not_a_number, lost_agent])
def test_a_damaged_drive_is_named(
    data: Path, tmp_path: Path, damage: Callable[[Path], str], refused: Callable[..., str]
) -> None:
    name = damage(data)
    page = tmp_path / "page.html"
    assert name in refused("view", data, "--out", page)
    assert not page.exists()
    assert not Path("owned").exists()


def test_a_checkpoint_of_another_model_is_named(data: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    path = tmp_path / "other.pt"
    torch.save({"state_dict": {"weight": torch.zeros(3)}}, path)
    assert "other.pt" in refused("evaluate", data, "--checkpoint", path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_teacher_is_refused_as_a_detector(data: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    path = tmp_path / "teacher.pt"
    save_detector(path, Detector(replace(debug().model, role="teacher")))
    for verb in (
        ("evaluate", data, "--checkpoint", path, "--out", tmp_path / "out"),
        ("view", data, "--checkpoint", path, "--out", tmp_path / "out"),
        ("drive", "four_way", "--perception", "ego", "--checkpoint", path),
    ):
        assert "teacher.pt: settings.role: expected student" in refused(*verb)
    assert not (tmp_path / "out").exists()


def test_a_file_where_a_folder_should_be_is_named(data: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "taken").write_text("a file")
    assert "taken" in refused("generate", "four_way", "--frames", "1", "--out", tmp_path / "taken")
    assert "taken" in refused(
        "model", "train", "debug", "--data", data, "--out", tmp_path / "taken", "--stage", "plain"
    )


def test_an_impossible_folder_costs_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (("--out", "/proc/nowhere"), ("--out", "/tmp", "--frames", "0")):
        with pytest.raises(SystemExit):
            main(["generate", "four_way", *wrong])
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1


def test_a_scenario_with_a_typo_is_named_with_the_right_word(tmp_path: Path, refused: Callable[..., str]) -> None:
    source = ROOT / "scenarios" / "four_way" / "scenario.toml"
    path = tmp_path / "scenario.toml"
    path.write_text(source.read_text().replace("warmup_s", "warmpu_s"))
    line = refused("generate", path, "--out", tmp_path / "out")
    assert "scenario.toml" in line
    assert "warmpu_s" in line
    assert "did you mean 'warmup_s'" in line
    assert not (tmp_path / "out").exists()


def test_a_scenario_with_an_unknown_sensor_is_neither_shown_nor_generated(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    source = ROOT / "scenarios" / "braunschweig" / "scenario.toml"
    path = tmp_path / "scenario.toml"
    path.write_text(source.read_text().replace("opv2v-64", "opv2v-46"))
    for verb in (("scenario", "show", path), ("generate", path, "--out", tmp_path / "out")):
        assert "did you mean 'opv2v-64'" in refused(*verb)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("generate", "four_way", "--frames", "0", "--out", "{out}"), "frames"),
        (("generate", "four_way", "--interval-s", "0.03", "--out", "{out}"), "interval"),
        (("generate", "four_way", "--frames", "9999", "--out", "{out}"), "duration_s"),
        (("generate", "four_way", "--seed", "-1", "--out", "{out}"), "seed"),
        (("view", "{data}", "--corruption", "frog", "--out", "{out}"), "fog"),
        (("view", "{data}", "--corruption", "pose_error", "--family", "paper", "--out", "{out}"), "published"),
        (("view", "{data}", "--corruption", "fog", "--severity", "9", "--out", "{out}"), "severity"),
        (("corrupt", "{data}", "--corruption", "frog", "--out", "{out}"), "fog"),
        (("corrupt", "{data}", "--corruption", "fog", "--severity", "0", "--out", "{out}"), "severity"),
        (("corrupt", "{data}", "--corruption", "pose_error", "--family", "paper", "--out", "{out}"), "published"),
        (("corrupt", "{data}", "--corruption", "fog", "--workers", "0", "--out", "{out}"), "workers"),
        (("corrupt", "{out}", "--corruption", "fog", "--out", "{out}2"), "out"),
        (("corrupt", "{data}", "--corruption", "fog", "--out", "{data}/foggy"), "apart"),
        (("dataset", "convert", "{data}", "--to", "dair", "--agent-id", "all", "--out", "{out}"), "agent"),
        (("dataset", "convert", "{data}", "--to", "mcap", "--view", "around", "--out", "{out}"), "view"),
        (("dataset", "convert", "{data}", "--to", "kitti", "--agent-id", "12", "--out", "{out}"), "1000"),
        (("dataset", "convert", "{data}", "--to", "kitti", "--out", "{data}/kitti"), "apart"),
        (("dataset", "convert", "{out}", "--to", "kitti", "--out", "{out}2"), "no such folder"),
        (("model", "train", "smal", "--data", "{data}", "--out", "{out}"), "small"),
        (("model", "train", "debug", "--data", "{out}", "--out", "{out}"), "out"),
        (("model", "train", "debug", "--data", "{data}", "--out", "{out}", "--seed", "-1"), "seed"),
        (("model", "train", "debug", "--data", "{data}", "--out", "{out}", "--set", "batch_size=0"), "batch_size"),
        (("drive", "four_way", "--corruption", "fog"), "corruption"),
        (("drive", "ima_queue", "--perception", "team", "--critical", "loss", "--out", "{out}"), "out"),
        (("drive", "{out}.npz"), "episode log"),
        (("drive", "four_way", "--fail-under", "crashed=5"), "--fail-under: expected a condition such as crashed<=5%"),
        (("drive", "four_way", "--fail-under"), "--fail-under: expected at least one value, found none"),
        (("drive", "four_way", "--fault", "--seed", "1"), "--fault: expected at least one value, found none"),
        (("drive", "ima_queue", "--fault", "misalignment"), "expected one of yaw_deg, pitch_deg"),
        (("drive", "ima_queue", "--fault", "fog:2.5"), "severity: expected a whole number, "),
        (("drive", "ima_queue", "--perception", "cpm", "--fault", "ghost"), "in episodes), found cpm"),
        (("drive", "ima_queue", "--perception", "team-sight", "--defence", "trust"), "another one beside trust"),
        (("drive", "ima_queue", "--defence", "motion"), "expected a perception whose helpers tell boxes"),
        (("drive", "four_way", "--fail-under", "broken<=0"), "--fail-under: expected --baseline beside broken"),
        (("drive", "four_way", "--baseline", "{out}"), "baseline: expected a folder of a campaign, or its results.csv"),
        (("drive", "four_way", "--baseline", "{data}"), "results.csv: "),
        (("drive", "four_way", "--junit", "{data}"), "output: expected a file"),
        (("drive", "four_way", "--view", "--junit", "{out}"), "--view shows an episode; leave out --junit"),
        (("drive", "four_way", "--duration-s", "-1"), "duration_s"),
        (("drive", "four_way", "--duration-s", "nan"), "duration_s"),
        (("drive", "four_way", "--detect-every-s", "0"), "detect_every_s"),
        (("drive", "ima_queue", "--detect-every-s", "0.15"), "detect_every_s"),
        (("drive", "four_way", "--latency-s", "-0.1"), "latency_s"),
        (("drive", "four_way", "--perception", "team", "--look-ahead-s", "nan"), "look_ahead_s"),
        (("drive", "four_way", "--perception", "truth", "--look-ahead-s", "1"), "look_ahead_s: expected 0 with"),
        (("drive", "{out}.npz", "--detect-every-s", "0.2"), "is a log, which has its own; leave out --detect-every-s"),
        (("drive", "{out}.npz", "--seed", "1"), "is a log, which has its own; leave out --seed"),
        (("drive", "{out}.npz", "--workers", "2"), "is the log of an episode; leave out --workers"),
        (("drive", "lta_truck:dense:light"), "traffic: expected one, found 'dense' and 'light'"),
        (("drive", "four_way", "--perception", "nobody:Here"), "nobody"),
        (("drive", "four_way", "--seed", "-1", "--out", "{out}/rows.csv"), "seed: expected 0 to 2^63 - 1"),
        (("drive", "ima_queue", "--perception", "team", "--corruption", "fog", "--severity", "9"), "expected 1 to 5"),
        (
            ("drive", "ima_queue", "--perception", "team", "--corruption", "fog", "--corrupted-agents", "helper"),
            "ego, helpers, vehicles",
        ),
        (("drive", "ima_queue", "--perception", "team", "--corrupted-agents", "helpers"), "add --corruption"),
        (("view", "{data}", "--out", "{out}", "--frames", "0"), "frames"),
        (("view", "{data}", "--port", "99999999"), "port"),
        (("view", "{data}", "--severity", "9"), "severity: expected 1 to 5, found 9"),
        (("scenario", "show", "dsrc-sim"), "is a data set, not a scenario; run: dsrc dataset build dsrc-sim"),
        (("model", "train", "debug", "--data", "{data}", "--out", "{out}", "--epochs", "0"), "epochs"),
    ],
)
def test_a_wrong_option_is_named(
    data: Path, tmp_path: Path, arguments: tuple[str, ...], word: str, refused: Callable[..., str]
) -> None:
    out = tmp_path / "out"
    assert word in refused(*(a.format(data=data, out=out) for a in arguments))
    assert not out.exists()


def test_an_unwritable_path_is_refused_before_the_work(tmp_path: Path, refused: Callable[..., str]) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("mine")
    assert str(occupied) in refused("drive", "four_way", "--duration-s", "1", "--out", occupied / "rows.csv")
    assert str(occupied) in refused("demo", "--out", occupied)
    assert occupied.read_text() == "mine"
