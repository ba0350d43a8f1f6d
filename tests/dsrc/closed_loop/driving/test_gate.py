"""With the truth the driver finishes every encounter and its controls: its crashes belong to its perception."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.loop import ClosedLoop
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Decision, Driver, EgoState, LaneMap, Outcome, Tracks
from sim.encounters import ENCOUNTERS
from tests.dsrc.closed_loop.driving.drives import drive

QUICK = ("lta_truck", "ped_dartout")
"""A car that turns and one who walks; the others are slow."""
CONDITIONS = ("", ":no_occluder", ":no_conflict")
ROADS = ("braunschweig", "four_way", "helsinki", "rilsa_1", "motorway_a10")
HIGHWAY = ("merge", "roundabout", "intersection", "two_way", "racetrack")


def check_encounter(kind: str, condition: str, seed: int, driver: Driver | None = None) -> None:
    loop = ClosedLoop(f"{kind}{condition}", open_perception("truth"), driver or PlanningDriver())
    outcome = loop.run(seed)
    assert outcome is Outcome.ARRIVED, f"{kind}{condition} seed {seed}: {outcome}"
    if condition == ":no_conflict":
        hardest = -min(tick.decision.acceleration_mps2 for tick in loop.ticks)
        assert hardest < 5.0, f"{kind}{condition} seed {seed}: braked with {hardest:.1f} m/s2 for nobody"


class Standing:
    """Never drives, and so never crashes."""

    def reset(self, lanes: LaneMap | None = None) -> None: ...

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(-4.0, "free", -1)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_who_only_stands_does_not_pass(condition: str) -> None:
    with pytest.raises(AssertionError, match="seed 0: "):
        check_encounter("lta_truck", condition, 0, Standing())


@pytest.mark.parametrize(
    "kind", [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in ENCOUNTERS]
)
def test_with_the_truth_every_encounter_and_control_ends_at_the_goal(kind: str) -> None:
    for condition in CONDITIONS:
        check_encounter(kind, condition, 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_with_the_truth_twenty_seeds_of_each_do(kind: str) -> None:
    for seed in range(1, 20):
        for condition in CONDITIONS:
            check_encounter(kind, condition, seed)


def check_road(name: str, seed: int, seconds: float, least: float) -> None:
    ours, theirs = drive(name, seed, seconds), drive(name, seed, seconds, commanded=False)
    assert not ours.hit, f"{name} seed {seed}: hit {ours.hit} at {ours.hit_s:.1f} s"
    assert ours.progress_m > least * theirs.progress_m


@pytest.mark.parametrize(
    "name", ["four_way", *(pytest.param(name, marks=pytest.mark.slow) for name in ("braunschweig", "motorway_a10"))]
)
def test_in_traffic_it_crashes_into_nobody_and_keeps_up_with_sumos_own_driver(name: str) -> None:
    check_road(name, 0, 15.0, 0.8)


@pytest.mark.slow
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
