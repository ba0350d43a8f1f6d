"""Worlds on disk: built once for all processes, equal bit for bit, and built again where they are damaged."""

import os
from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop import kept
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario
from sim.scenario import Scenario
from sim.world.build import build_world

SEED = 3


def eebl(control: str = "") -> Scenario:
    return load_scenario(f"eebl_chain{control}")


def test_a_slow_world_is_built_once_and_read_bit_for_bit(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("four_way")
    monkeypatch.setattr(kept, "_SLOW_S", 0.0)
    built = build_world(scenario, SEED)
    kept.kept_world(scenario, SEED)
    monkeypatch.setattr(kept, "build_world", lambda scenario, seed: pytest.fail("built again"))
    read = kept.kept_world(scenario, SEED)
    assert np.array_equal(read.vertices, built.vertices) and np.array_equal(read.faces, built.faces)
    assert np.array_equal(read.face_attributes["material"], built.face_attributes["material"])
    assert read.faces.dtype == built.faces.dtype
    assert kept.world_scene(scenario, SEED) is kept.world_scene(load_scenario("four_way"), SEED)


def test_the_oldest_worlds_go_and_a_damaged_one_is_built_again(
    empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "_SLOW_S", 0.0)
    monkeypatch.setattr(kept, "_MOST_WORLDS", 2)
    scenario = with_proven_encounter(eebl(), SEED)
    for seed in (SEED, SEED + 1, SEED + 2):
        first = kept.kept_world(scenario, seed)
    paths = sorted((empty_cache / "worlds").glob("*.npz"), key=os.path.getmtime)
    assert len(paths) == 2
    paths[-1].write_bytes(paths[-1].read_bytes()[:1000])
    assert np.array_equal(kept.kept_world(scenario, SEED + 2).vertices, first.vertices)


def test_a_fast_world_is_not_kept(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "_SLOW_S", 1e6)
    kept.kept_world(with_proven_encounter(eebl(), SEED), SEED)
    assert not (empty_cache / "worlds").exists()


def test_a_cache_that_cannot_be_written_to_costs_time_alone(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("read-only")

    monkeypatch.setattr(kept, "_SLOW_S", 0.0)
    monkeypatch.setattr(kept, "_keep", refuse)
    scenario = load_scenario("four_way")
    assert np.array_equal(kept.kept_world(scenario, SEED).vertices, build_world(scenario, SEED).vertices)
