"""Proofs and worlds on disk: made once for all processes, equal bit for bit, and made again where they are damaged."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.closed_loop import kept
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario
from sim.scenario import Scenario
from sim.world.build import build_world

SEED = 3
PROVE = f"""
from dsrc.closed_loop import kept
from sim.catalog.load import load_scenario
print(kept.proven_scenario(load_scenario("eebl_chain"), {SEED}).conflict.draw)
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    forget()
    yield tmp_path
    forget()


def forget() -> None:
    """Forget what this process knows, as a new one does."""
    kept._proven_draw.cache_clear()
    kept._scene.cache_clear()


def eebl(control: str = "") -> Scenario:
    return load_scenario(f"eebl_chain{control}")


def not_again(scenario: Scenario, seed: int) -> Scenario:
    raise AssertionError(f"{scenario.name} seed {seed} is proven again")


def test_another_process_proves_an_encounter_for_all_later_ones(cache: Path, monkeypatch) -> None:
    env = {**os.environ, "DSRC_CACHE": str(cache), "PYTHONPATH": str(Path(__file__).parents[3])}
    told = subprocess.run([sys.executable, "-c", PROVE], env=env, capture_output=True, text=True, check=True).stdout
    monkeypatch.setattr(kept, "find_encounter", not_again)
    found = kept.proven_scenario(eebl(), SEED)
    assert found.conflict is not None and found.conflict.draw == int(told)
    monkeypatch.undo()
    assert found == with_proven_encounter(eebl(), SEED)


def test_a_control_takes_the_draw_of_its_encounter(cache: Path, monkeypatch) -> None:
    kept.proven_scenario(eebl(), SEED)
    monkeypatch.setattr(kept, "find_encounter", not_again)
    control = kept.proven_scenario(eebl(":no_occluder"), SEED)
    monkeypatch.undo()
    assert control == with_proven_encounter(eebl(":no_occluder"), SEED)


@pytest.mark.parametrize("change", ["seed", "settings", "code"])
def test_whatever_decides_a_proof_has_it_made_again(cache: Path, monkeypatch, change: str) -> None:
    kept.proven_scenario(eebl(), SEED)
    scenario, seed = eebl(), SEED
    if change == "seed":
        seed += 1
    elif change == "settings":
        scenario = replace(scenario, agents=replace(scenario.agents, mount_pitch_deg=1.0))
    else:
        monkeypatch.setattr(kept, "code_hash", lambda entry: "other code")
        forget()
    monkeypatch.setattr(kept, "find_encounter", not_again)
    with pytest.raises(AssertionError, match="proven again"):
        kept.proven_scenario(scenario, seed)


def test_a_damaged_proof_is_made_again(cache: Path) -> None:
    before = kept.proven_scenario(eebl(), SEED)
    (path,) = (cache / "encounters").glob("*.json")
    path.write_bytes(b'{"dr')
    forget()
    assert kept.proven_scenario(eebl(), SEED) == before
    forget()
    path.write_bytes(path.read_bytes())
    assert kept.proven_scenario(eebl(), SEED) == before


def test_without_an_encounter_nothing_is_proven() -> None:
    assert kept.proven_scenario(load_scenario("four_way"), SEED) == load_scenario("four_way")


def test_a_slow_world_is_built_once_and_read_bit_for_bit(cache: Path, monkeypatch) -> None:
    scenario = load_scenario("four_way")
    monkeypatch.setattr(kept, "_SLOW_S", 0.0)
    built = build_world(scenario, SEED)
    kept._world(scenario, SEED)
    monkeypatch.setattr(kept, "build_world", lambda scenario, seed: pytest.fail("built again"))
    read = kept._world(scenario, SEED)
    assert np.array_equal(read.vertices, built.vertices) and np.array_equal(read.faces, built.faces)
    assert np.array_equal(read.face_attributes["material"], built.face_attributes["material"])
    assert read.faces.dtype == built.faces.dtype
    assert kept.world_scene(scenario, SEED) is kept.world_scene(load_scenario("four_way"), SEED)


def test_the_oldest_worlds_go_and_a_damaged_one_is_built_again(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(kept, "_SLOW_S", 0.0)
    monkeypatch.setattr(kept, "_MOST_WORLDS", 2)
    scenario = with_proven_encounter(eebl(), SEED)
    for seed in (SEED, SEED + 1, SEED + 2):
        first = kept._world(scenario, seed)
    paths = sorted((cache / "worlds").glob("*.npz"), key=os.path.getmtime)
    assert len(paths) == 2
    paths[-1].write_bytes(paths[-1].read_bytes()[:1000])
    assert np.array_equal(kept._world(scenario, SEED + 2).vertices, first.vertices)


def test_a_fast_world_is_not_kept(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(kept, "_SLOW_S", 1e6)
    kept._world(with_proven_encounter(eebl(), SEED), SEED)
    assert not (cache / "worlds").exists()


def test_a_cache_that_cannot_be_written_to_costs_time_alone(cache: Path, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("read-only")

    monkeypatch.setattr(kept, "write_file", refuse)
    assert kept.proven_scenario(eebl(), SEED) == with_proven_encounter(eebl(), SEED)
