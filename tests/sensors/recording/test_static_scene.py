"""The world of a scenario is built once and shared."""

from pathlib import Path

import msgspec
import pytest
import trimesh

from sensors.recording.encounter_check import find_encounter
from sensors.recording.static_scene import static_scene
from sim.catalog.load import load_scenario
from sim.scenario import Scenario
from tests.sensors.fakes import ground, toy_scenario


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of the worlds that were built."""
    seeds: list[int] = []

    def build(scenario: Scenario, seed: int) -> trimesh.Trimesh:
        seeds.append(seed)
        return ground()

    monkeypatch.setattr("sim.world.build.build_world", build)
    return seeds


def test_equal_scenarios_and_seeds_share_a_scene(built: list[int]) -> None:
    scenario = toy_scenario(vehicles=7)
    again = msgspec.convert(msgspec.to_builtins(scenario), type(scenario))
    assert static_scene(scenario, 1) is static_scene(again, 1)
    assert static_scene(scenario, 2) is not static_scene(scenario, 1)
    assert static_scene(toy_scenario(vehicles=8), 1) is not static_scene(scenario, 1)
    assert built == [1, 2, 1]


def test_who_drives_through_an_encounter_meets_the_world_of_its_proof(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))  # where no proof is kept, which would need no world
    found = find_encounter(load_scenario("ima_queue"), 11)
    monkeypatch.setattr("sim.world.build.build_world", lambda *_: pytest.fail("the world was built again"))
    static_scene(found.scenario, 11)
