"""The proof by rays: every encounter hides its conflict actor from the ego in time, and its controls do not."""

import msgspec
import pytest

from sensors.recording import encounter_check
from sensors.recording.encounter_check import (
    AHEAD_S,
    CONFLICT_ID,
    EGO_ID,
    LATENCY_S,
    UNSEEN_POINTS,
    Proof,
    find_encounter,
    prove_encounter,
    with_proven_encounter,
)
from sensors.recording.record import record
from sim.catalog.load import load_scenario
from sim.encounters import ENCOUNTERS
from sim.errors import ScenarioError
from sim.scenario import EncounterSpec
from sim.traffic.open import open_traffic
from sim.world.build import build_world
from tests.sim.encounters.test_encounters import encounter

SEED = 1
QUICK = ("ima_building", "lta_truck", "dnpw_overtake", "eebl_chain", "cut_in_merge", "ped_dartout")
KINDS = [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in ENCOUNTERS]
"""Encounters, half of them in the slow tests."""


def control_of(kind: str, control: str, seed: int) -> Proof | None:
    return find_encounter(encounter(kind, control=control), seed).control


@pytest.mark.parametrize("seed", [SEED, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
@pytest.mark.parametrize("kind", KINDS)
def test_the_proof_holds(kind: str, seed: int) -> None:
    found = find_encounter(encounter(kind), seed)
    proof = found.proof
    assert proof.holds and proof.reason == "" and proof.hit == "conflict"
    assert proof.ego_points < UNSEEN_POINTS
    assert proof.ego_ttc_s is None or proof.ego_ttc_s < proof.critical_ttc_s
    assert proof.helper_ttc_s >= proof.critical_ttc_s + AHEAD_S
    assert LATENCY_S < proof.critical_ttc_s < 3.0
    assert sum(found.rejected.values()) == found.scenario.conflict.draw
    assert found.scenario.agents.named[0] == "ego"


@pytest.mark.parametrize("seed", [SEED, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "kind",
    [
        "ped_dartout",
        "ima_building",
        "lta_truck",
        "eebl_chain",
    ],
)
@pytest.mark.slow
def test_the_proof_holds_on_uneven_ground(kind: str, seed: int) -> None:
    found = find_encounter(msgspec.structs.replace(encounter(kind), world=2), seed)
    assert found.scenario.uneven and found.proof.holds and found.proof.hit == "conflict"
    assert found.proof.ego_points < UNSEEN_POINTS
    assert found.proof.helper_ttc_s >= found.proof.critical_ttc_s + AHEAD_S


@pytest.mark.parametrize("kind", KINDS)
def test_without_the_occluder_the_ego_sees_it_early(kind: str) -> None:
    control = control_of(kind, "no_occluder", SEED)
    assert not control.holds and control.reason == "seen early"
    assert control.ego_ttc_s > find_encounter(encounter(kind), SEED).proof.critical_ttc_s + 0.5
    assert control.hit == "conflict"


@pytest.mark.parametrize("kind", KINDS)
def test_without_the_conflict_actor_there_is_no_collision(kind: str) -> None:
    control = control_of(kind, "no_conflict", SEED)
    assert not control.holds and control.reason == "no collision" and control.hit_s is None


def test_a_ghost_is_listed_with_its_track_and_causes_no_collision() -> None:
    found = find_encounter(encounter("ped_bus_stop", control="ghost"), SEED)
    assert not found.control.holds and found.control.reason == "no collision"
    (ghost,) = found.ghosts
    assert (ghost["name"], ghost["claimed_by"], ghost["class"]) == ("ghost", "bus", "pedestrian")
    crossing = [row for row in ghost["track"] if -3.5 < row[2] < 0.0]
    assert crossing and all(abs(row[1]) < 0.1 for row in crossing)
    plain = find_encounter(encounter("ped_bus_stop"), SEED)
    assert plain.ghosts == () and plain.control is None
    assert plain.parameters == found.parameters and plain.rejected == found.rejected


def test_equal_seeds_are_proven_to_the_same_draw() -> None:
    scenario = encounter("ima_queue")
    draw, proof, rejected = encounter_check._search_draws(scenario, 4)
    found = find_encounter(scenario, 4)
    assert (found.scenario.conflict.draw, found.proof, found.rejected) == (draw, proof, rejected)


def test_values_that_hide_nothing_are_refused_with_the_reasons() -> None:
    bare = {"setback_m": 8.0, "ego_mps": 8.0, "conflict_mps": 8.0}
    with pytest.raises(ScenarioError, match=r"conflict\.parameters: expected .* of 3 draws .* found 3 x seen early"):
        find_encounter(encounter("ima_building", parameters=bare, draws=3), 1)


def test_an_encounter_without_a_collision_fails() -> None:
    late = encounter("ima_building", parameters={"jitter_s": 0.5, "ego_mps": 17.0, "conflict_mps": 17.0})
    assert prove_encounter(late, 1).reason == "no collision"


def test_a_proven_scenario_and_one_without_encounter_stay_unchanged() -> None:
    done = with_proven_encounter(encounter("ima_building"), 1)
    assert done.agents.named and with_proven_encounter(done, 1) is done
    plain = load_scenario("four_way")
    assert with_proven_encounter(plain, 1) is plain
    with pytest.raises(ScenarioError, match="conflict: expected one of an encounter, found none"):
        find_encounter(plain, 1)


def test_a_control_of_a_shipped_scenario_has_a_name() -> None:
    scenario = load_scenario("ima_building:no_occluder")
    assert scenario.name == "ima_building-no_occluder"
    assert scenario.conflict == EncounterSpec(kind="ima_building", control="no_occluder")
    with pytest.raises(ScenarioError, match="did you mean 'no_occluder'"):
        load_scenario("ima_building:no_ocluder")
    with pytest.raises(ScenarioError, match="variant of an encounter"):
        load_scenario("four_way:ghost")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["braunschweig_lta_truck", "braunschweig_red_light_runner"])
def test_encounters_at_a_real_junction_hold_and_their_controls_fail(name: str) -> None:
    found = find_encounter(load_scenario(name), SEED)
    assert found.proof.holds and found.proof.helper_ttc_s >= found.proof.critical_ttc_s + AHEAD_S
    assert found.scenario.network.area_m == load_scenario(name).network.area_m
    assert len(found.scenario.agents.roadside) == 1
    assert find_encounter(load_scenario(f"{name}:no_occluder"), SEED).control.reason == "seen early"
    assert find_encounter(load_scenario(f"{name}:no_conflict"), SEED).control.reason == "no collision"


@pytest.mark.parametrize(
    ("kind", "seed"), [pytest.param("cut_in_merge", 7, marks=pytest.mark.slow), ("ima_building", 1)]
)
def test_no_frame_of_the_drive_shows_the_ego_what_the_proof_says_is_hidden(kind: str, seed: int) -> None:
    """Frames from the very first, with the noise and the losses of the drive."""
    found = find_encounter(encounter(kind), seed)
    hidden = found.proof.hit_s - found.proof.critical_ttc_s
    with open_traffic(found.scenario, seed) as traffic:
        world = build_world(found.scenario, seed)
        frames = int(hidden / found.scenario.step_s) + 1
        drive = record(traffic, world, found.scenario, seed, frames, visibility=False)
        for frame in drive:
            ego = frame.agents.index(frame.agent(EGO_ID))
            on_it = frame.points_on[ego][frame.truth.object_id == CONFLICT_ID].sum()
            assert on_it <= found.proof.ego_points < UNSEEN_POINTS, frame.index
