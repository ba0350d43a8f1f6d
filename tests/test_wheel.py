"""The wheel holds all that is tracked, and runs where there is no clone."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.paths import ROOT

pytestmark = pytest.mark.slow
PACKAGES = ("sim/", "sensors/", "dsrc/", "scenarios/")
NO_CLONE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(*words: object, cwd: Path) -> str:
    """Run a command outside of the clone and return its output."""
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=NO_CLONE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def tracked() -> list[str]:
    """Return the tracked files that are there."""
    names = run("git", "ls-files", "-z", cwd=ROOT).split("\0")
    return [name for name in names if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Wheel of the tracked files, and what its build said."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in tracked():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    said = run(sys.executable, "-m", "pip", "wheel", "--verbose", "--no-deps", "--wheel-dir", out, source, cwd=out)
    return next(out.glob("*.whl")), said


def test_the_wheel_holds_every_tracked_file_of_its_packages(built: tuple[Path, str]) -> None:
    with zipfile.ZipFile(built[0]) as wheel:
        held = set(wheel.namelist())
    assert {name for name in tracked() if name.startswith(PACKAGES)} - held == set()
    assert {name for name in held if not name.startswith(PACKAGES) and ".dist-info/" not in name} == set()


def test_its_build_warns_of_nothing(built: tuple[Path, str]) -> None:
    lines = [line for line in built[1].splitlines() if "warning" in line.lower() and "byte-compiling" not in line]
    assert lines == []


@pytest.mark.timeout(1800)
def test_it_runs_from_an_empty_folder_of_an_empty_environment(built: tuple[Path, str], tmp_path: Path) -> None:
    home, here = tmp_path / "environment", tmp_path / "empty"
    here.mkdir()
    run(sys.executable, "-m", "venv", home, cwd=here)
    run(home / "bin/pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", built[0], cwd=here)
    dsrc = home / "bin/dsrc"
    assert run(dsrc, "--version", cwd=here).startswith("dsrc 0.")
    assert "braunschweig" in run(dsrc, "scenario", "list", cwd=here)
    run(dsrc, "generate", "four_way", "--frames", "2", "--out", "drives", cwd=here)
    run(dsrc, "dataset", "check", "drives", cwd=here)
    run(dsrc, "view", "drives", "--out", "page.html", cwd=here)
    assert (here / "page.html").stat().st_size > 100_000
