"""Command line: help, names of options, progress, one-line errors."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from dsrc.cli import options
from dsrc.cli.main import commands, run
from dsrc.cli.progress import made, progress
from dsrc.cli.scenario import NAMED
from dsrc.options import detection, fields
from dsrc.options.drives import DriveOptions
from tests.command_line import FROZEN, RENEW, command_line
from tests.commands import dsrc
from tests.paths import ROOT

HEAVY = {"torch", "libsumo", "trimesh", "viser", "matplotlib", "scipy", "gymnasium", "embreex", "shapely", "numpy"}


def assert_one_line(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """A user's mistake: exit code 2, one line on standard error, no stack trace."""
    assert result.returncode == 2, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert all(word in lines[0] for word in words), lines[0]


def help_text(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """Return the output of a command that exits with code 0."""
    with pytest.raises(SystemExit) as leaving:
        run(args)
    assert leaving.value.code == 0
    return capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from dsrc.cli.main import run\n"
        "try:\n    run(['--help'])\nexcept SystemExit:\n    pass\n"
        f"heavy = {HEAVY} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr


def test_help_lists_every_command_and_every_option_with_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    overview = help_text(capsys, "--help")
    for words, command in commands():
        assert f"  {' '.join(words)}  " in overview and options.summary(command) in overview
        text = help_text(capsys, *words, "--help")
        assert f"usage: dsrc {' '.join(words)}" in text
        assert not [word for word in ("None", "default: )", "default: '')", "(optional)") if word in text]
        for name, _, _, line in options.fields_of(command):
            assert line.strip(), f"{words}: {name} has no help"
    assert "build" in help_text(capsys, "dataset", "--help")


def test_the_command_line_is_the_frozen_one() -> None:
    assert command_line() == FROZEN.read_text(), f"options or their help have changed; if they should: {RENEW}"


@pytest.mark.parametrize("words", [(), ("help",), ("model",), ("help", "model"), ("help", "model", "train")])
def test_without_a_command_and_by_the_word_help_there_is_help(words: tuple[str, ...]) -> None:
    result = dsrc(*words)
    named = " ".join(["dsrc", *(word for word in words if word != "help")])
    assert result.returncode == 0 and result.stdout.startswith(f"usage: {named} ")


def test_every_command_has_examples_that_are_read() -> None:
    for words, command in commands():
        examples = [line.strip() for line in options.describe(command).partition("examples:\n")[2].splitlines()]
        assert 1 <= len(examples) <= 3, words
        for line in examples:
            begin, *args = shlex.split(line.partition(" > ")[0].removeprefix('eval "$(').removesuffix(')"'))
            assert (begin, *args[: len(words)]) == ("dsrc", *words)
            options.parse(command, " ".join(words), args[len(words) :])


def test_a_page_has_every_command_and_every_option() -> None:
    page = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    spelled = set(re.findall(r"--[a-z][a-z0-9-]*", page))
    for words, command in commands():
        assert f"`dsrc {' '.join(words)}" in page, f"docs/commands.md lacks dsrc {' '.join(words)}"
        for name, kind, *_ in options.fields_of(command):
            known = options.option_words(name, kind)
            assert not known or spelled & set(known), f"docs/commands.md lacks {known[0]} of dsrc {' '.join(words)}"


@pytest.mark.parametrize("things", NAMED)
def test_names_are_listed_as_options_take_them(things: str) -> None:
    names = {
        "lidars": "opv2v-64",
        "corruptions": "incomplete_echo",
        "scenarios": "lta_truck",
        "methods": "v2x-vit",
        "recipes": "small",
        "channels": "its-g5-27",
    }
    lines = dsrc("list", things).stdout.splitlines()
    column = next(line for line in lines if things.removesuffix("s") in line).index(things.removesuffix("s"))
    assert names[things] in [line[column:].partition(" ")[0] for line in lines]


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["ge"], ["generate"]),
        (["dataset", "co"], ["convert"]),
        (["generate", "four"], ["four_way"]),
        (["evaluate", "data", "--corruption", "fog", "sn"], ["snow"]),
        (["evaluate", "data", "--corruption", "fog", "--fam"], ["--family"]),
        (["generate", "four_way", "--out", ""], []),
    ],
)
def test_bash_completes_commands_options_and_names(typed: list[str], offered: list[str]) -> None:
    ask = 'COMP_WORDS=(dsrc "$@"); COMP_CWORD=$#; _dsrc; echo "${COMPREPLY[@]}"'
    script = f"{dsrc('completion', 'bash').stdout}\n{ask}"
    result = subprocess.run(["bash", "-c", script, "bash", *typed], capture_output=True, text=True, check=True)
    assert result.stdout.split() == offered


def test_one_name_stands_for_one_thing() -> None:
    names = {name for _, command in commands() for name, *_ in options.fields_of(command)}
    assert not names & {"kind", "corruptions", "seeds", "severities", "channels", "limit", "checkpoints", "export"}


def test_listed_choices_are_those_there_are() -> None:
    from dsrc.models.storage.deploy import ENGINES
    from dsrc.training.recipes import METHODS, RECIPES
    from sensors.corruptions import CORRUPTIONS, FAMILIES
    from sensors.sweep import MOTIONS
    from sim.radio import PRESETS

    assert list(fields.CORRUPTIONS) == list(CORRUPTIONS)
    assert fields.Family.__args__ == tuple(FAMILIES)
    assert DriveOptions.__annotations__["motion"].__args__ == MOTIONS
    assert [name.removesuffix(":FILE") for name in fields.CHANNELS] == list(PRESETS)
    assert (fields.METHODS, fields.RECIPES) == (tuple(METHODS), tuple(RECIPES))
    assert detection.Engine.__args__ == tuple(ENGINES)


def test_an_unknown_command_names_the_nearest() -> None:
    assert_one_line(dsrc("genrate"), "found genrate", "did you mean 'generate'")
    assert_one_line(dsrc("dataset", "biuld"), "dsrc dataset", "did you mean 'build'")
    assert dsrc("--version").stdout.startswith("dsrc 0.")


@pytest.mark.parametrize("words", [("scenario", "list"), ("generate", "--help")])
def test_a_closed_pipe_ends_a_command_quietly(words: tuple[str, ...]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        result = subprocess.run(
            [sys.executable, "-m", "dsrc", *words], stdout=closed, stderr=subprocess.PIPE, text=True
        )
    assert (result.returncode, result.stderr) == (141, "")


def test_progress_without_a_terminal_is_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = iter([0.0, 1.0, 25.0, 30.0, 31.0, 32.0])
    monkeypatch.setattr("dsrc.cli.progress.monotonic", lambda: next(seconds))
    with progress("work") as report:
        for done in (0, 2, 3, 4, 4):
            report(done, 4)
    assert capsys.readouterr().err.splitlines() == ["work: 2 of 4, 25 s", "work: 4 of 4, 31 s"]
    monkeypatch.undo()
    with progress("short work") as report:
        report(4, 4)
    assert capsys.readouterr().err == ""


def test_what_was_made_is_a_path_for_scripts_and_a_line_with_the_next_command(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "my drives"
    made(folder, "a drive", "view", folder)
    out, err = capsys.readouterr()
    assert out == f"{folder}\n"
    wrote, following = err.splitlines()
    assert wrote == "wrote a drive" and following.startswith("next: dsrc view '")
    _, *words = shlex.split(following.removeprefix("next: "))
    (tmp_path / "my drives").mkdir()
    assert_one_line(dsrc(*words), str(folder))  # the command runs, and says that the folder is empty
    made(folder, "a drive", new=False)
    assert capsys.readouterr().err == "already there: a drive\n"


def test_an_unknown_scenario_names_the_nearest(tmp_path: Path) -> None:
    assert_one_line(dsrc("generate", "braunschwieg", "--out", str(tmp_path / "x")), "braunschwieg", "braunschweig")


def test_faults_of_a_dataset_are_listed_with_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "drive" / "1").mkdir(parents=True)
    (tmp_path / "drive" / "1" / "000000.yaml").write_text("vehicles: [")
    result = dsrc("dataset", "check", str(tmp_path))
    assert_one_line(result, "faults found")
    assert "000000.pcd: file is missing" in result.stdout and "000000.yaml" in result.stdout


def test_a_dataset_is_not_generated_and_a_scenario_not_built(tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "x"))
    assert_one_line(dsrc("generate", "dsrc-sim", *out), "scenario", "dsrc dataset build dsrc-sim")
    assert_one_line(dsrc("dataset", "build", "dsrc-sim", "--splits", "tset", *out), "split", "'test'")
    assert_one_line(dsrc("dataset", "build", "four_way", *out), "four_way is a scenario", "dsrc generate four_way")
    assert_one_line(dsrc("dataset", "render", str(tmp_path / "none"), *out), "traffic.npz", "no such folder")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("content", "right"),
    [
        ("[[split.test]]\n", "dsrc dataset build {path} --out "),
        ("[[methods]]\n", "dsrc benchmark {path} --out "),
        ("scenarios = ['four_way']\n", "dsrc drive {path} --out "),
        ("[demand]\n", "dsrc generate {path} --out "),
    ],
)
def test_a_toml_names_the_command_that_takes_it(tmp_path: Path, content: str, right: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(content)
    command = right.format(path=path)
    for words in (("generate",), ("dataset", "build"), ("benchmark",), ("drive",)):
        begin = " ".join(words)
        if not command.startswith(f"dsrc {begin} ") and (begin, content) != ("drive", "[demand]\n"):
            result = dsrc(*words, str(path), *(("--out", str(tmp_path / "x")) if begin != "drive" else ()))
            assert_one_line(result, f"{begin}: {path} is a ", f"run: {command}")


@pytest.mark.slow
def test_a_corrupted_drive_is_generated_as_by_two_commands_and_leaves_no_second_tree(tmp_path: Path) -> None:
    four_way = ("generate", "four_way", "--frames", "1", "--no-visibility", "--vehicles", "2", "--lidar", "debug-16")
    fog = ("--corruption", "fog", "--severity", "4")
    assert dsrc(*four_way, "--out", str(tmp_path / "clean")).returncode == 0
    assert dsrc("corrupt", str(tmp_path / "clean"), *fog, "--out", str(tmp_path / "two")).returncode == 0
    assert dsrc(*four_way, *fog, "--out", str(tmp_path / "one")).returncode == 0
    one, two = (
        {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two and len(list((tmp_path / "one").iterdir())) == 1
    assert_one_line(dsrc(*four_way, "--severity", "4", "--out", str(tmp_path / "x")), "add --corruption")


def test_an_empty_folder_is_not_a_dataset(tmp_path: Path) -> None:
    assert_one_line(dsrc("view", str(tmp_path), "--out", str(tmp_path / "x.html")), str(tmp_path))


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(b"not a checkpoint")
    assert_one_line(dsrc("drive", "four_way", "--perception", "ego", "--checkpoint", str(path)), "model.pt")


def test_a_fault_in_the_file_of_a_benchmark_is_named(tmp_path: Path) -> None:
    path = tmp_path / "benchmark.toml"
    path.write_text('[[methods]]\nname = "DSRC"\ndetectors = ["none.pt"]\n[[datasets]]\nname = "x"\ndrives = ["y"]\n')
    out = ("--out", str(tmp_path / "out"))
    assert_one_line(dsrc("benchmark", str(path), *out), "none.pt", "no such checkpoint")
    assert_one_line(dsrc("benchmark", str(path), *out, "--frames", "3"), "frames", "describes the benchmark")
    assert_one_line(dsrc("benchmark", "a.pt", *out), "plan", "--checkpoint")
    path.write_text(path.read_text().replace("detectors", "detector"))
    assert_one_line(dsrc("benchmark", str(path), *out), str(path), "did you mean 'detectors'")
    assert not (tmp_path / "out").exists()
