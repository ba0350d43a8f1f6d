"""The wheel holds all that is tracked, and runs where there is no clone."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.paths import ROOT

pytestmark = pytest.mark.slow
PACKAGES = ("sim/", "sensors/", "dsrc/", "scenarios/")
WITHOUT = ("torch", "libsumo", "sumo", "highway_env", "gymnasium", "viser", "lightning", "matplotlib", "scenarios")
"""Modules that dsrc-sensors does without."""
SCAN = f"""
import importlib.util

import numpy as np
import trimesh

import dsrc
from sensors.corruptions import corrupt

hall = trimesh.creation.box((40.0, 24.0, 8.0))
lidar = dsrc.get_lidar("vlp-16")
sweep = dsrc.scan(dsrc.RayScene(hall), lidar, np.eye(4), np.eye(4), time_s=0.0, rng=np.random.default_rng(0))
assert len(sweep.points) > 10_000 and np.abs(sweep.points).max() < 21.0
foggy = corrupt(sweep, "fog", 5, np.random.default_rng(0))
assert 0 < len(foggy) and not np.array_equal(foggy.points, sweep.points)
assert dsrc.open_drives and dsrc.corrupt_frame
assert [name for name in {WITHOUT} if importlib.util.find_spec(name)] == []
assert dsrc.__version__.startswith("0.")
try:
    dsrc.load_detector
except ModuleNotFoundError as error:
    print(error)
"""
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
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the tracked files."""
    folder = tmp_path_factory.mktemp("source")
    for name in tracked():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((ROOT / name).read_bytes())
    return folder


def wheel_of(project: Path, out: Path) -> tuple[Path, str]:
    """Return the wheel of a project, made of its source distribution, and what its build said."""
    builder = out / "builder"
    run(sys.executable, "-m", "venv", builder, cwd=out)
    run(builder / "bin/pip", "install", "--quiet", "build", cwd=out)
    said = run(builder / "bin/python", "-m", "build", "--outdir", out, project, cwd=out)
    return next(out.glob("*.whl")), said


@pytest.fixture(scope="module")
def built(source: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    return wheel_of(source, tmp_path_factory.mktemp("wheel"))


def environment_with(wheel: Path, home: Path) -> Path:
    """Return the folder of programs of a new environment in which a wheel is installed."""
    run(sys.executable, "-m", "venv", home, cwd=home.parent)
    run(home / "bin/pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel, cwd=home.parent)
    return home / "bin"


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
    here = tmp_path / "empty"
    here.mkdir()
    dsrc = environment_with(built[0], tmp_path / "environment") / "dsrc"
    assert run(dsrc, "--version", cwd=here).startswith("dsrc 0.")
    assert "braunschweig" in run(dsrc, "scenario", "list", cwd=here)
    run(dsrc, "generate", "four_way", "--frames", "2", "--out", "drives", cwd=here)
    run(dsrc, "dataset", "check", "drives", cwd=here)
    run(dsrc, "view", "drives", "--out", "page.html", cwd=here)
    assert (here / "page.html").stat().st_size > 100_000


@pytest.mark.timeout(1800)
def test_the_sensors_alone_scan_and_corrupt_without_torch_and_sumo(source: Path, tmp_path: Path) -> None:
    wheel, _ = wheel_of(source / "packaging/sensors", tmp_path)
    with zipfile.ZipFile(wheel) as held:
        names = set(held.namelist())
    assert {name for name in tracked() if name.startswith(("sim/", "sensors/", "dsrc/data/"))} - names == set()
    programs = environment_with(wheel, tmp_path / "environment")
    said = run(programs / "python", "-c", SCAN, cwd=tmp_path)
    assert said == "dsrc.load_detector is in dsrc-testbed, not in the smaller dsrc-sensors that is installed\n"
    installed = sum(path.stat().st_size for path in programs.parent.rglob("*") if path.is_file())
    assert installed < 800e6  # dsrc-testbed: 2.6 GB


def test_the_sensors_alone_are_of_the_version_and_need_packages_of_the_versions_of_the_whole() -> None:
    whole, part = (
        tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"] for folder in ("", "packaging/sensors")
    )
    assert part["version"] == whole["version"]
    assert part["authors"] == whole["authors"]
    assert (ROOT / "packaging/sensors/LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert set(part["dependencies"]) <= set(whole["dependencies"])
