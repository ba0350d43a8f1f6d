"""With the truth the driver finishes every encounter and its controls: its crashes belong to its perception."""

import numpy as np
import pytest

from sim.encounters import ENCOUNTERS
from tests.dsrc.closed_loop.driving.drives import RANGE_M, Drive, drive

CONDITIONS = ("", ":no_occluder", ":no_conflict")
ROADS = ("braunschweig", "four_way", "helsinki", "rilsa_1", "motorway_a10")
HIGHWAY = ("merge", "roundabout", "intersection", "two_way", "racetrack")

SIGHT_M = {"dnpw_overtake": 150.0}
"""Overtaking needs sight of the oncoming lane: 4 s at a closing speed of up to 44 m/s are more than the 70 m that the
others need. No driver with less could tell that the lane is not free before it pulls out."""


def check_encounter(kind: str, condition: str, seed: int) -> None:
    met = drive(f"{kind}{condition}", seed, 14.0, range_m=SIGHT_M.get(kind, RANGE_M))
    assert not met.hit, f"{kind}{condition} seed {seed}: hit {met.hit} at {met.hit_s:.1f} s"
    if condition == ":no_conflict":
        assert hardest(met) < 5.0, f"{kind}{condition} seed {seed}: braked with {hardest(met):.1f} m/s2 for nobody"


def hardest(met: Drive) -> float:
    return -min(decision.acceleration_mps2 for decision in met.decisions)


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_with_the_truth_no_encounter_ends_in_a_crash(kind: str) -> None:
    for seed in range(3):
        for condition in CONDITIONS:
            check_encounter(kind, condition, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_with_the_truth_no_encounter_of_twenty_seeds_ends_in_a_crash(kind: str) -> None:
    for seed in range(3, 20):
        for condition in CONDITIONS:
            check_encounter(kind, condition, seed)


def check_road(name: str, seed: int, seconds: float, least: float) -> None:
    ours, theirs = drive(name, seed, seconds), drive(name, seed, seconds, commanded=False)
    assert not ours.hit, f"{name} seed {seed}: hit {ours.hit} at {ours.hit_s:.1f} s"
    assert ours.progress_m > least * theirs.progress_m


@pytest.mark.parametrize("name", ["braunschweig", "motorway_a10"])
def test_in_traffic_it_crashes_into_nobody_and_keeps_up_with_sumos_own_driver(name: str) -> None:
    check_road(name, 0, 15.0, 0.8)


@pytest.mark.parametrize("name", ["merge", "roundabout"])
def test_on_roads_of_highway_env_too(name: str) -> None:
    check_road(f"highway_env_{name}", 0, 15.0, 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ROADS, *(f"highway_env_{name}" for name in HIGHWAY)])
def test_over_five_seeds_and_half_a_minute_too(name: str) -> None:
    for seed in range(5):
        check_road(name, seed, 30.0, 0.75)


def test_two_drives_of_a_seed_are_equal_bit_for_bit() -> None:
    first, second = (drive("roundabout_entry", 1, 8.0) for _ in range(2))
    assert first.decisions == second.decisions
    assert np.array_equal(first.speed, second.speed)
