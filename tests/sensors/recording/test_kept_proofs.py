"""Proofs of encounters on disk: made once for all processes, and again where anything that decides them differs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from sensors.recording import encounter_check
from sensors.recording.encounter_check import find_encounter, prove_encounter, with_proven_encounter
from sim.catalog.load import load_scenario
from sim.encounters import with_encounter
from sim.kept import files
from sim.scenario import Scenario
from tests.cache import forget
from tests.paths import ROOT

SEED = 3
PROVE = f"""
from sensors.recording.encounter_check import find_encounter
from sim.catalog.load import load_scenario
print(find_encounter(load_scenario("eebl_chain"), {SEED}).scenario.conflict.draw)
"""


def eebl(control: str = "") -> Scenario:
    return load_scenario(f"eebl_chain{control}")


def not_again(*_: object, **__: object) -> None:
    raise AssertionError("proven again")


@pytest.mark.slow
def test_another_process_proves_an_encounter_for_all_later_ones(
    empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = {**os.environ, "DSRC_CACHE": str(empty_cache), "PYTHONPATH": str(ROOT)}
    told = subprocess.run([sys.executable, "-c", PROVE], env=env, capture_output=True, text=True, check=True).stdout
    monkeypatch.setattr(encounter_check, "prove_encounter", not_again)
    found = with_proven_encounter(eebl(), SEED)
    assert found.conflict is not None and found.conflict.draw == int(told)
    assert found == find_encounter(eebl(), SEED).scenario
    monkeypatch.undo()
    assert prove_encounter(found, SEED, hurry=True) == find_encounter(eebl(), SEED).proof


def test_a_control_takes_the_draw_of_its_encounter(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw = with_proven_encounter(eebl(), SEED).conflict.draw
    monkeypatch.setattr(encounter_check, "prove_encounter", not_again)
    bare = eebl(":no_occluder")
    assert bare.conflict is not None
    expected = with_encounter(replace(bare, conflict=replace(bare.conflict, draw=draw)), SEED)
    assert with_proven_encounter(bare, SEED) == expected


@pytest.mark.parametrize("change", ["seed", "settings", "code"])
def test_whatever_decides_a_proof_has_it_made_again(
    empty_cache: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    with_proven_encounter(eebl(), SEED)
    scenario, seed = eebl(), SEED
    if change == "seed":
        seed += 1
    elif change == "settings":
        scenario = replace(scenario, agents=replace(scenario.agents, mount_pitch_deg=1.0))
    else:
        monkeypatch.setattr(files, "code_hash", lambda module: "other code")
        forget()
    monkeypatch.setattr(encounter_check, "prove_encounter", not_again)
    with pytest.raises(AssertionError, match="proven again"):
        with_proven_encounter(scenario, seed)


def test_a_damaged_proof_is_made_again(empty_cache: Path) -> None:
    before = with_proven_encounter(eebl(), SEED)
    (path,) = (empty_cache / "encounters").glob("*.json")
    whole = path.read_bytes()
    path.write_bytes(whole[:5])
    forget()
    assert with_proven_encounter(eebl(), SEED) == before
    assert path.read_bytes() == whole


def test_without_an_encounter_nothing_is_proven(empty_cache: Path) -> None:
    assert with_proven_encounter(load_scenario("four_way"), SEED) == load_scenario("four_way")
    assert not (empty_cache / "encounters").exists()


def test_a_cache_that_cannot_be_written_to_costs_time_alone(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("read-only")

    before = with_proven_encounter(eebl(), SEED)
    forget()
    (path,) = (empty_cache / "encounters").glob("*.json")
    path.unlink()
    monkeypatch.setattr(encounter_check, "write_file", refuse)
    assert with_proven_encounter(eebl(), SEED) == before
