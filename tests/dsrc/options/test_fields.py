"""A function of options takes a struct of them, or its fields; each option stands once."""

import inspect
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from dsrc.__main__ import main
from dsrc.cli.options import parse
from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.loop import LoopSettings
from dsrc.evaluation.config import Benchmark
from dsrc.options.detection import BenchmarkOptions, Comparison, Evaluation, Sharing
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import RENAMED, takes_fields
from sim.errors import GOES, DeprecatedName
from tests.paths import ROOT


class Walk(msgspec.Struct, frozen=True):
    """Options of a walk.

    Attributes:
        place: where to.
        steps: how many; default: one.
    """

    place: str
    steps: int = 1


class Command(Walk, frozen=True):
    """Walk somewhere."""

    fast: bool = False


class Framed(msgspec.Struct, frozen=True):
    """A place and frames."""

    place: str
    frames: int


@takes_fields(Framed)
def walk_in(options: Framed) -> int:
    """Walk in frames."""
    return options.frames


@takes_fields(Walk)
def walk(options: Walk, progress: Callable[[int, int], None] | None = None) -> tuple[str, int]:
    """Walk."""
    if progress is not None:
        progress(options.steps, options.steps)
    return options.place, options.steps


def test_a_struct_its_fields_and_a_command_are_the_same() -> None:
    seen: list[tuple[int, int]] = []

    def report(done: int, total: int) -> None:
        seen.append((done, total))

    command = parse(Command, "walk", ["--place", "home", "--steps", "3", "--fast"])
    assert command == Command(place="home", steps=3, fast=True)
    assert walk(command) == walk(Walk("home", 3)) == walk("home", 3) == walk(place="home", steps=3) == ("home", 3)
    assert walk(command, report) == walk("home", steps=3, progress=report) == ("home", 3)
    assert seen == [(3, 3), (3, 3)]


def test_an_option_has_one_name_on_the_command_line_in_a_plan_and_in_python() -> None:
    of_benchmark = {one.name for one in msgspec.structs.fields(Benchmark)}
    assert {one.name for one in msgspec.structs.fields(Comparison)} <= of_benchmark
    of_campaign = {one.name for struct in (Campaign, LoopSettings) for one in msgspec.structs.fields(struct)}
    options = {one.name for one in msgspec.structs.fields(DriveOptions)}
    assert options - of_campaign == {"what", "perception", "checkpoint", "seed"}, "a campaign has tables of these"
    for struct in (Benchmark, Campaign, BenchmarkOptions, DriveOptions, Evaluation, Sharing):
        assert not {one.name for one in msgspec.structs.fields(struct)} & set(RENAMED), struct
        assert all(one.encode_name == one.name for one in msgspec.structs.fields(struct))


def test_a_former_name_is_taken_and_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = [str(tmp_path / "none"), "--corruption", "fog", "--out", str(tmp_path / "out")]
    with warnings.catch_warnings():
        warnings.simplefilter("always", DeprecatedName)
        with pytest.raises(SystemExit):
            main(["corrupt", *words, "--who", "nobody"])
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"dsrc: --who is deprecated and goes on {GOES}; use --corrupted-agents"
    assert "corrupted_agents: expected all, ego, helpers, vehicles, roadside or ids" in second
    with pytest.raises(SystemExit):
        main(["corrupt", *words, "--who", "all", "--corrupted-agents", "ego"])
    assert "--who and --corrupted-agents are the same; leave out --who" in capsys.readouterr().err
    with pytest.warns(DeprecatedName, match="^limit is deprecated") as told:
        config = takes_fields(Evaluation)(lambda options: options)(
            checkpoint=("a.pt",), data=tmp_path, out=tmp_path, limit=3
        )
    assert config.frames == 3
    assert told[0].filename == __file__


def test_an_unknown_field_is_refused_and_the_signature_names_all() -> None:
    with pytest.raises(TypeError, match="stepps"):
        walk("home", stepps=3)  # type: ignore[call-overload]
    assert list(inspect.signature(walk).parameters) == ["place", "steps", "progress"]
    assert walk.__doc__ == "Walk."


@pytest.mark.slow
def test_a_type_checker_reads_the_fields(tmp_path: Path) -> None:
    lines = {
        'generate("four_way", Path("out"), frames=3)': True,
        'generate("four_way", Path("out"), framse=3)': False,
        'generate("four_way", Path("out"), frames="three")': False,
        'export_html(Path("data"), Path("page.html"), corruption="fog", frames=slice(1, 3))': True,
        'export_html(Path("data"))': False,
    }
    text = "from pathlib import Path\nfrom dsrc import export_html, generate\n" + "".join(f"{line}\n" for line in lines)
    (tmp_path / "script.py").write_text(text)
    options = ("--config-file", "pyproject.toml", "--cache-dir", str(tmp_path), "--follow-imports", "silent")
    run = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(tmp_path / "script.py")], cwd=ROOT, capture_output=True, text=True
    )
    wrong = {int(line.split(":")[1]) - 3 for line in run.stdout.splitlines() if ": error:" in line}
    assert wrong == {row for row, good in enumerate(lines.values()) if not good}, run.stdout + run.stderr
