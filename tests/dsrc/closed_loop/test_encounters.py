"""Encounters in the closed loop: who brakes when a helper sees it stops in time, who sees nothing collides."""

import numpy as np
import pytest

from dsrc.closed_loop.env import LOOK_AHEAD, CoopDrivingEnv
from dsrc.closed_loop.episodes import idm_policy
from sensors.recording.encounter_check import LATENCY_S, find_encounter
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.encounters import ENCOUNTERS
from sim.traffic.script import FIRST_ID

SEED = 1
BRAKE = np.array([-1.0], np.float32)


class Blind:
    """Perceives nothing; a cooperative one listens to others."""

    def __init__(self, cooperative: bool = False) -> None:
        self.cooperative = cooperative

    def reset(self, scenario, ego_id: int, seed: int) -> None:
        self.ego_id, self.named = ego_id, scenario.agents.named

    def perceive(self, before, now) -> Boxes:
        return Boxes.zeros()


def drive(name: str, brake_s: float = np.inf, perception: Blind | None = None):
    """Drive until the end; return the last info and the narrowest gap that was perceived."""
    env = CoopDrivingEnv(name, perception or Blind(), duration_s=10.0)
    observation, info = env.reset(seed=SEED)
    gap, done = LOOK_AHEAD, False
    while not done:
        action = BRAKE if info["time_s"] >= brake_s - 1e-6 else idm_policy(observation, env.idm)
        observation, _, terminated, truncated, info = env.step(action)
        gap, done = min(gap, float(observation["gap"][0])), terminated or truncated
    env.close()
    return info, gap


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_braking_when_a_helper_sees_it_is_in_time_and_not_braking_is_not(kind: str) -> None:
    proof = find_encounter(load_scenario(kind), SEED).proof
    blind, _ = drive(kind)
    assert blind["ego_id"] == FIRST_ID
    assert blind["collided_with"] == (FIRST_ID + 1,)
    assert blind["time_s"] == pytest.approx(proof.hit_s, abs=0.35)
    warned, _ = drive(kind, brake_s=proof.hit_s - proof.helper_ttc_s + LATENCY_S)
    assert warned["collided_with"] == ()


def test_braking_when_the_ego_itself_sees_it_is_too_late() -> None:
    proof = find_encounter(load_scenario("stalled_after_curve"), SEED).proof
    late, _ = drive("stalled_after_curve", brake_s=proof.hit_s - proof.ego_ttc_s + LATENCY_S)
    assert late["collided_with"] == (FIRST_ID + 1,)
    assert late["time_s"] > proof.hit_s


def test_a_ghost_deceives_an_ego_that_listens_and_no_other() -> None:
    name = "ped_bus_stop:ghost"
    alone, nothing = drive(name)
    assert nothing == LOOK_AHEAD and alone["collided_with"] == ()
    deceived, gap = drive(name, perception=Blind(cooperative=True))
    assert gap < 15.0 and deceived["collided_with"] == ()
    assert deceived["progress_m"] < alone["progress_m"] - 1.0


def test_helpers_of_an_encounter_are_the_collaborators() -> None:
    perception = Blind()
    env = CoopDrivingEnv("lta_truck", perception)
    env.reset(seed=SEED)
    env.close()
    assert perception.named == ("ego", "truck", "follower")
