"""The closed loop: encounters are met, survived by those who perceive, and a perception that fails is an outcome."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from dsrc.closed_loop.driving.lanes import NetworkLanes
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.perception.truth import TruthPerception
from dsrc.closed_loop.replay import replay
from dsrc.closed_loop.types import Decision, Driver, EgoState, LaneMap, Outcome, Percept, Perception, Tracks
from sensors.recording.encounter_check import LATENCY_S, find_encounter
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.encounters import ENCOUNTERS
from sim.errors import TrafficError
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.script import FIRST_ID
from tests.dsrc.closed_loop.driving.test_gate import QUICK
from tests.paths import ROOT

SEED = 1
KINDS = [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in ENCOUNTERS]
"""Encounters, most of them in the slow tests."""


class Blind:
    """Perceives nothing, or what `answer` returns."""

    cooperative = False

    def __init__(self, answer: Callable[[Actors], Any] | None = None) -> None:
        self.answer = answer

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        pass

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Any:
        if self.answer is not None:
            return self.answer(now)
        return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


class BrakeAt:
    """Drives at the allowed speed, and brakes fully from a time on."""

    def __init__(self, time_s: float) -> None:
        self.time_s = time_s

    def reset(self, lanes: LaneMap | None) -> None:
        pass

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        if ego.time_s >= self.time_s - 1e-6:
            return Decision(-ego.limits.deceleration_mps2)
        return Decision(10.0 * (ego.limits.speed_mps - ego.speed_mps))


def drive(name: str, perception: Perception | None = None, driver: Driver | None = None, **settings: Any) -> ClosedLoop:
    loop = ClosedLoop(name, perception or TruthPerception(), driver, LoopSettings(**settings))
    loop.run(SEED)
    return loop


@pytest.mark.parametrize("kind", KINDS)
def test_a_blind_ego_meets_the_crash_that_a_warned_one_avoids(kind: str) -> None:
    blind = drive(kind, Blind(), BrakeAt(np.inf))
    assert blind.outcome is Outcome.CRASHED
    contact = blind.tick.contact
    assert contact is not None and contact.other_id == FIRST_ID + 1
    proof = find_encounter(load_scenario(kind), SEED).proof
    assert contact.time_s == pytest.approx(proof.hit_s, abs=0.35)
    warned = drive(kind, Blind(), BrakeAt(proof.hit_s - proof.helper_ttc_s + LATENCY_S))
    assert warned.outcome is not Outcome.CRASHED


@pytest.mark.parametrize("kind", KINDS)
def test_the_driver_arrives_with_the_truth(kind: str) -> None:
    assert drive(kind).outcome is Outcome.ARRIVED


@pytest.mark.parametrize("latency_s", [0.0, 0.3])
def test_a_percept_arrives_as_late_as_its_latency(latency_s: float) -> None:
    loop = ClosedLoop("ima_building", TruthPerception(), settings=LoopSettings(latency_s=latency_s))
    loop.start(SEED)
    for _ in range(8):
        loop.advance()
    ages = [tick.actors.time_s - tick.percept.time_s for tick in loop.ticks if tick.percept is not None]
    assert ages == pytest.approx([latency_s] * (9 - round(10 * latency_s)))
    loop.close()


def test_tracks_go_on_between_detections() -> None:
    loop = ClosedLoop("four_way", TruthPerception(), settings=LoopSettings(detect_every_s=0.5))
    loop.start(SEED)
    for _ in range(10):
        loop.advance()
    assert [tick.percept is not None for tick in loop.ticks] == [step % 5 == 0 for step in range(11)]
    assert all(tick.tracks.time_s == tick.actors.time_s for tick in loop.ticks)
    assert len(loop.ticks[7].tracks) > 0
    loop.close()


def _raise(now: Actors) -> None:
    raise RuntimeError("out of memory\nat line 3")


def _nan(now: Actors) -> Percept:
    return Percept(now.time_s, Boxes.from_array(np.full((1, 7), np.nan)), np.ones(1), np.zeros((1, 2)))


def _flat(now: Actors) -> Percept:
    return Percept(now.time_s, Boxes.from_array(np.zeros((1, 7))), np.ones(1), np.zeros((1, 2)))


def _far(now: Actors) -> Percept:
    boxes = Boxes.from_array([[2e9, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    return Percept(now.time_s, boxes, np.ones(1), np.full((1, 2), np.nan))


def _sure(now: Actors) -> Percept:
    boxes = Boxes.from_array([[5.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    return Percept(now.time_s, boxes, np.full(1, 1.5), np.full((1, 2), np.nan))


def _early(now: Actors) -> Percept:
    return Percept(now.time_s + 1.0, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


def _slow(now: Actors) -> Percept:
    time.sleep(0.02)
    return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (_raise, "RuntimeError: out of memory at line 3"),
        (_nan, "finite"),
        (_flat, "sizes"),
        (lambda now: None if now.time_s < 0 else "boxes", "expected a Percept, found str"),
        (_slow, "limit 0.01 s"),
        (_far, "within 1e+06 m"),
        (_sure, "scores between 0 and 1"),
        (_early, "found one of"),
    ],
    ids=["raises", "nan", "flat", "no percept", "slow", "far", "score", "future"],
)
def test_a_perception_that_fails_ends_the_episode_with_its_reason(
    answer: Callable[[Actors], Any], message: str
) -> None:
    loop = drive("ima_building:no_conflict", Blind(answer), perception_limit_s=0.01)
    assert loop.outcome is Outcome.PERCEPTION_FAILED
    assert message in loop.message and "\n" not in loop.message


def test_a_perception_that_fails_at_its_reset_is_an_outcome() -> None:
    class Unready(Blind):
        def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
            raise RuntimeError("no weights")

    loop = drive("ima_building:no_conflict", Unready())
    assert loop.outcome is Outcome.PERCEPTION_FAILED and loop.message == "RuntimeError: no weights"
    assert loop.log(perception="unready").outcome is Outcome.PERCEPTION_FAILED


def test_none_is_no_percept() -> None:
    loop = ClosedLoop("ima_building:no_conflict", Blind(lambda now: None))
    assert loop.run(SEED) is Outcome.PERCEPTION_FAILED and "NoneType" in loop.message


def test_an_ego_that_stands_is_stuck_and_no_success() -> None:
    assert drive("ima_building:no_conflict", Blind(), BrakeAt(2.0)).outcome is Outcome.STUCK


def test_an_ego_that_stands_before_its_encounter_has_not_met_it() -> None:
    assert drive("ima_building", Blind(), BrakeAt(1.0)).outcome is Outcome.DESYNCHRONISED


def test_a_driver_without_a_number_has_failed_and_brakes_nothing() -> None:
    class Broken(BrakeAt):
        """Divides by nothing after a second."""

        def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
            return Decision(math.nan if ego.time_s > 1.0 else 0.0)

    loop = drive("ima_building:no_conflict", Blind(), Broken(0.0))
    assert loop.outcome is Outcome.DRIVER_FAILED
    assert loop.message == "ValueError: decide: expected a finite acceleration, found nan"
    assert loop.tick.ego.time_s == pytest.approx(1.1, abs=0.11) and loop.tick.ego.acceleration_mps2 > -0.1


def test_an_ego_that_was_late_for_its_encounter_says_so() -> None:
    class Late(BrakeAt):
        """Stops early, waits, and goes on at full acceleration."""

        def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
            braking = 1.0 < ego.time_s < 7.0
            return Decision(-4.0 if braking else ego.limits.acceleration_mps2)

    assert drive("red_light_runner", Blind(), Late(0.0), stuck_s=30.0).outcome is Outcome.DESYNCHRONISED


def test_one_seed_is_one_episode_bit_for_bit() -> None:
    def log() -> EpisodeLog:
        return drive("lta_truck").log(perception="truth")

    first, second = log(), log()
    assert len(first) == len(second)
    for one, other in zip(first.ticks, second.ticks, strict=True):
        assert one.decision == other.decision
        assert np.array_equal(one.tracks.boxes.array, other.tracks.boxes.array)
        assert np.array_equal(one.actors.boxes.array, other.actors.boxes.array)


@pytest.mark.slow
def test_another_process_with_other_threads_writes_the_same_log(tmp_path: Path) -> None:
    """Traffic, rays, network and tracks of a detector's drive, byte for byte."""
    script = (
        "import sys, dsrc\n"
        "from dsrc.closed_loop.loop import LoopSettings\n"
        "loop = dsrc.ClosedLoop('lta_truck', dsrc.open_perception('team'), settings=LoopSettings(duration_s=1.0))\n"
        "loop.run(1)\n"
        "loop.log(perception='team').save(sys.argv[1])\n"
    )
    loop = ClosedLoop("lta_truck", open_perception("team"), settings=LoopSettings(duration_s=1.0))
    loop.run(1)
    here, there = loop.log(perception="team").save(tmp_path / "here.npz"), tmp_path / "there.npz"
    threaded = os.environ | {"OMP_NUM_THREADS": "1" if torch.get_num_threads() > 1 else "2"}
    subprocess.run([sys.executable, "-c", script, str(there)], check=True, cwd=ROOT, env=threaded)
    assert here.read_bytes() == there.read_bytes()


def test_a_replay_shows_the_same_and_other_eyes_see_something_else(tmp_path: Path) -> None:
    log = drive("ima_building").log(perception="truth")
    again = replay(EpisodeLog.load(log.save(tmp_path / "log.npz")), TruthPerception(), "truth")
    blind = replay(log, Blind(), "nothing")
    assert len(again) == len(blind) == len(log)
    for tick, one, none in zip(log.ticks, again.ticks, blind.ticks, strict=True):
        assert np.array_equal(tick.actors.boxes.array, one.actors.boxes.array)
        assert np.array_equal(tick.percept.boxes.array, one.percept.boxes.array)
        assert len(none.tracks) == 0
    braked = min(tick.decision.acceleration_mps2 for tick in log.ticks)
    assert min(tick.decision.acceleration_mps2 for tick in blind.ticks) > braked


@pytest.mark.slow
def test_on_uneven_ground_the_ego_arrives_and_the_log_keeps_how_all_stand(tmp_path: Path) -> None:
    scenario = msgspec.structs.replace(load_scenario("ima_building"), world=2)
    loop = ClosedLoop(scenario, TruthPerception())
    assert loop.run(SEED) is Outcome.ARRIVED
    log = loop.log(perception="truth")
    again = EpisodeLog.load(log.save(tmp_path / "log.npz"))
    ego = [tick.actors[tick.actors.boxes.object_id == loop.ego_id] for tick in again.ticks]
    assert np.ptp(np.concatenate([one.boxes.center[:, 2] for one in ego])) > 0.5
    assert max(float(np.abs(one.roll).max()) for one in ego if len(one)) > 0.005
    for tick, one in zip(log.ticks, again.ticks, strict=True):
        assert np.array_equal(tick.actors.world_from_body(), one.actors.world_from_body())


def test_an_episode_that_has_ended_takes_no_further_step() -> None:
    loop = drive("ima_building:no_conflict")
    with pytest.raises(TrafficError, match="ended"):
        loop.advance()


def test_an_acceleration_that_is_not_finite_is_refused() -> None:
    loop = ClosedLoop("ima_building:no_conflict", Blind())
    loop.start(SEED)
    with pytest.raises(ValueError, match="finite"):
        loop.advance(float("nan"))
    with pytest.raises(ValueError, match="steering_rad comes with acceleration_mps2"):
        loop.advance(None, 0.1)
    loop.close()


@pytest.mark.slow
def test_the_driver_gets_the_lanes_of_its_roads() -> None:
    class Told(BrakeAt):
        """Keeps what it is told at its reset."""

        def reset(self, lanes: LaneMap | None) -> None:
            self.lanes = lanes

    def lanes(name: str) -> LaneMap | None:
        driver = Told(np.inf)
        loop = ClosedLoop(name, Blind(), driver)
        loop.start(SEED)
        loop.close()
        return driver.lanes

    for name in ("roundabout_entry", "four_way"):
        assert isinstance(lanes(name), NetworkLanes)
    assert lanes("highway_env_merge") is None


@pytest.mark.slow
def test_on_its_lane_the_oncoming_car_is_no_reason_for_an_emergency() -> None:
    """Straight on, the car in the bend would leave its lane and meet the ego that overtakes."""
    loop = drive("dnpw_overtake:no_occluder")
    assert loop.outcome is Outcome.ARRIVED
    assert all(tick.decision.reason != "emergency" for tick in loop.ticks)
