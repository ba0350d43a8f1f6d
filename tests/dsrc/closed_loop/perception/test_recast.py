"""Sweeps of a log, cast again: those of the loop to the bit, and as old as the messages that arrived."""

import math

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog, EpisodeSettings
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.recast import RecastSenses, recast_senses
from dsrc.closed_loop.perception.senses import Senses
from dsrc.closed_loop.types import Decision, EgoState, Outcome, Percept, Tick, Tracks
from dsrc.faults.fault import parse_faults
from sensors.corruptions import Condition
from sensors.frame import AgentFrame, Frame
from sim.boxes import Boxes
from sim.radio import Link, Obstruction
from sim.traffic.base import Limits
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, SCENARIO, Knowing, build, instant

STEPS, EVERY, SPEED = 8, 2, 6.0


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def message(sent: int, age_s: float) -> Link:
    arrived = np.array([sent >= 0])
    return Link(HELPER, EGO, sent, age_s, 0.05, 100, 1, arrived, 30.0, Obstruction.FREE, 0.9, 0.1)


def ego_at(step: int) -> EgoState:
    now = instant(step + 1, SPEED)
    ahead = np.array([[0.0, 0.0], [100.0, 0.0]])
    return EgoState(now.time_s, now.boxes[[now.row(EGO)]], 0.0, 0.0, ahead, Limits(10.0, 2.0, 5.0), (), 0.0)


def log_of(links: dict[int, Link], **settings: object) -> EpisodeLog:
    """Episode of the toy encounter with a percept every other step, and one link in some."""
    ticks = []
    for step in range(STEPS):
        now = instant(step + 1, SPEED)
        ego = ego_at(step)
        heard = (links[step],) if step in links else ()
        percept = Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)), heard)
        tracks = Tracks(now.time_s, Boxes.zeros(), np.zeros((0, 2)), *[np.zeros(0)] * 4)
        ticks.append(Tick(now, ego, None if step % EVERY else percept, tracks, Decision(0.0)))
    about = {"perception": "team", "loop": {"detect_every_s": 0.2}, **settings}
    return EpisodeLog(
        EpisodeSettings(scenario=SCENARIO, seed=0, ego_id=EGO, **about), instant(0, SPEED), ticks, Outcome.TIMEOUT
    )


def frames_of_the_loop(condition: Condition) -> list[Frame]:
    """Frames at the measured steps, as a perception gets them."""
    senses = Senses(condition, True)
    senses.reset(SCENARIO, EGO, 0)
    frames = []
    for step in range(STEPS):
        if step % EVERY == 0:
            frames.append(senses.frame(instant(step, SPEED), instant(step + 1, SPEED), {}))
        else:
            senses.pass_over(instant(step, SPEED), instant(step + 1, SPEED))
    return frames


def assert_same(found: AgentFrame, expected: AgentFrame) -> None:
    assert found.agent_id == expected.agent_id
    np.testing.assert_array_equal(found.sweep.points, expected.sweep.points)
    np.testing.assert_array_equal(found.sweep.world_from_lidar, expected.sweep.world_from_lidar)


def test_sweeps_are_those_of_the_loop_in_any_order_and_stay_until_the_next_percept() -> None:
    frames = frames_of_the_loop(Condition("fog", 3))
    recast = RecastSenses(log_of({}, corruption="fog", severity=3))
    for row in (5, 0, 7, 4):
        agents = recast.agents(row)
        assert len(agents) == 2 and len(agents[0].sweep) > 0
        for found, expected in zip(agents, frames[row // EVERY].agents, strict=True):
            assert_same(found, expected)
        np.testing.assert_allclose(recast.lidar(row), agents[0].sweep.world_from_lidar, atol=1e-9)


def test_a_late_message_has_its_older_sweep_and_a_lost_one_none() -> None:
    frames = frames_of_the_loop(Condition())
    recast = RecastSenses(log_of({4: message(2, 0.2), 6: message(-1, math.nan)}))
    ego, helper = recast.agents(4)
    assert_same(ego, frames[2].agents[0])
    assert_same(helper, frames[1].agents[1])
    (alone,) = recast.agents(6)
    assert_same(alone, frames[3].agents[0])


@pytest.mark.parametrize("text", ["ghost:1,ahead_m=25 from 0.2 s", "remove", "false_pose:aside_m=4"])
def test_who_shares_clouds_lies_in_them_as_in_the_loop(text: str) -> None:
    perception = DetectorPerception(Knowing([]), interval_s=0.2, faults=parse_faults(text, "test"))
    perception.reset(SCENARIO, EGO, 0)
    frames = []
    for step in range(STEPS):
        if step % EVERY:
            perception.overhear(instant(step, SPEED), instant(step + 1, SPEED), {})
            continue
        perception.aim(ego_at(step))
        perception.perceive(instant(step, SPEED), instant(step + 1, SPEED), {})
        assert perception.sensed is not None
        frames.append(perception.sensed)
    recast = RecastSenses(log_of({}, fault=text))
    honest = RecastSenses(log_of({}))
    for row in (6, 0, 4):
        for found, expected in zip(recast.agents(row), frames[row // EVERY].agents, strict=True):
            assert_same(found, expected)
    lied, true = (one.agents(6)[1].sweep for one in (recast, honest))
    assert not (
        np.array_equal(lied.points, true.points) and np.array_equal(lied.world_from_lidar, true.world_from_lidar)
    )


@pytest.mark.parametrize(("perception", "agents"), [("ego", 1), ("sight", 1), ("team-sight", 2), ("late", 2)])
def test_the_agents_are_those_of_the_perception(perception: str, agents: int) -> None:
    assert len(RecastSenses(log_of({}, perception=perception)).agents(0)) == agents


def test_a_perception_without_sweeps_has_none() -> None:
    assert recast_senses(log_of({}, perception="truth")) is None
    assert recast_senses(log_of({}, perception="drawn=model.json")) is None
