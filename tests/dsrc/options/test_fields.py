"""A function of options takes a struct of them, or its fields; each option stands once."""

import inspect
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from dsrc.cli.options import parse
from dsrc.options.fields import takes_fields
from tests.paths import ROOT


class Walk(msgspec.Struct, frozen=True):
    """Options of a walk.

    Attributes:
        place: where to.
        steps: how many; default: one.
    """

    place: str
    steps: int = msgspec.field(default=1, name="step")


class Command(Walk, frozen=True):
    """Walk somewhere."""

    fast: bool = False


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

    command = parse(Command, "walk", ["--place", "home", "--step", "3", "--fast"])
    assert command == Command(place="home", steps=3, fast=True)
    assert walk(command) == walk(Walk("home", 3)) == walk("home", 3) == walk(place="home", steps=3) == ("home", 3)
    assert walk(command, report) == walk("home", steps=3, progress=report) == ("home", 3)
    assert seen == [(3, 3), (3, 3)]
    assert walk("home", step=3) == ("home", 3), "an option's name on the command line is an argument's too"


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
