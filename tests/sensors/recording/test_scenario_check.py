"""Registration and contract check of scenarios."""

import re
import shutil
from importlib.metadata import EntryPoint
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

import sensors.recording.scenario_check as module
from sensors.recording.scenario_check import check_scenario
from sim.catalog import load
from sim.catalog.load import ROOT, list_scenarios, load_scenario, register_scenario
from sim.catalog.registry import Registry
from sim.errors import ScenarioError, SettingsError


@pytest.fixture
def town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a scenario `my_town` outside the package, and an empty registry."""
    monkeypatch.setattr(load, "_REGISTERED", Registry("dsrc.scenarios", {}, load._REGISTERED._read))
    shutil.copytree(ROOT / "four_way", tmp_path / "my_town")
    file = tmp_path / "my_town" / "scenario.toml"
    file.write_text(file.read_text().replace('name = "four_way"', 'name = "my_town"'))
    return tmp_path / "my_town"


def test_a_registered_scenario_is_found_by_its_name(town: Path) -> None:
    assert register_scenario(town).name == "my_town"
    register_scenario(town / "scenario.toml")
    assert "my_town" in list_scenarios()
    assert load_scenario("my_town") == load_scenario(town)


def test_a_taken_name_is_refused(town: Path) -> None:
    register_scenario(town)
    other = town.with_name("other")
    shutil.copytree(town, other)
    with pytest.raises(SettingsError, match="'my_town', which is registered"):
        register_scenario(other)
    with pytest.raises(SettingsError, match="'four_way', which is shipped"):
        register_scenario(ROOT / "four_way")
    with pytest.raises(ScenarioError, match=r"expected an existing \.toml file"):
        register_scenario(town / "missing")


def test_an_entry_point_names_a_folder(town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("my_town", "my_package:MY_TOWN", "dsrc.scenarios")
    monkeypatch.setitem(load._REGISTERED.__dict__, "_installed", {"my_town": point})
    monkeypatch.setattr(EntryPoint, "load", lambda self: str(town))
    assert load_scenario("my_town").name == "my_town"
    monkeypatch.setattr(EntryPoint, "load", lambda self: 1 / 0)
    monkeypatch.setattr(load._REGISTERED, "_values", {})
    with pytest.raises(SettingsError, match=r"entry point dsrc\.scenarios: my_town: .*ZeroDivisionError"):
        load_scenario("my_town")


def test_a_shipped_scenario_passes() -> None:
    check_scenario("four_way")


def test_a_part_that_cannot_be_made_is_one_line() -> None:
    scenario = load_scenario("four_way")
    wrong = msgspec.structs.replace(scenario, agents=msgspec.structs.replace(scenario.agents, lidar="nothing"))
    with pytest.raises(ScenarioError, match=r"^scenario 'four_way': agents\.lidar: [^\n]*$"):
        check_scenario(wrong)
    with pytest.raises(ScenarioError, match="unknown scenario 'nowhere'"):
        check_scenario("nowhere")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('lidar = "opv2v-64"', 'lidar = "nothing"', r"agents\.lidar: "),
        ("[agents]", "[agents]\ncolour = 1", r"agents: expected known keys only, found key 'colour'"),
    ],
)
def test_a_failure_of_a_file_begins_with_the_file_alone(town: Path, old: str, new: str, said: str) -> None:
    file = town / "scenario.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ScenarioError, match=rf"^{re.escape(str(file))}: {said}[^\n]*$"):
        check_scenario(file)


def test_traffic_that_differs_from_run_to_run_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = module.open_standing
    seeds = iter((1, 2))
    monkeypatch.setattr(module, "open_standing", lambda scenario, seed: opened(scenario, next(seeds)))
    monkeypatch.setattr(module, "build_world", lambda scenario, seed: _plane())
    with pytest.raises(ScenarioError, match="expected the same actors for the same seed"):
        check_scenario("four_way")


def _plane() -> trimesh.Trimesh:
    plane = trimesh.creation.box((600.0, 600.0, 0.2))
    plane.apply_translation((0.0, 0.0, -0.1))
    plane.face_attributes["material"] = np.zeros(len(plane.faces), np.uint8)
    return plane
