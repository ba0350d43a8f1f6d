"""Faults of an ego's computing and actuation: what they do to percepts and commands, and what is left of them after."""

import math
from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop.ego_faults import EgoFaults
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.replay import replay
from dsrc.closed_loop.types import Outcome, Percept, Tick
from dsrc.faults.fault import parse_faults

ASKED = [1.0, 2.0, 3.0, -4.0, -5.0, -6.0, 1.0, 2.0]
"""Commands of successive steps of 0.1 s, m/s2."""


def made(text: str) -> list[float]:
    own = EgoFaults(parse_faults(text), seed=3, ego_id=1, step_s=0.1)
    return [own.acted((wanted, None), 0.1 * step)[0] for step, wanted in enumerate(ASKED)]


def steered(text: str, asked: list[float | None]) -> list[float | None]:
    own = EgoFaults(parse_faults(text), seed=3, ego_id=1, step_s=0.1)
    return [own.acted((0.0, wheel), 0.1 * step)[1] for step, wheel in enumerate(asked)]


def driven(fault: str = "", seed: int = 1, **settings: float) -> ClosedLoop:
    loop = ClosedLoop("ima_building", open_perception("truth", fault=fault or ()), settings=LoopSettings(**settings))
    loop.run(seed)
    return loop


def arrivals(ticks: list[Tick]) -> list[tuple[float, float]]:
    """Instant and measurement of each percept, s of the episode."""
    start_s = ticks[0].actors.time_s
    return [
        (round(tick.actors.time_s - start_s, 3), round(tick.percept.time_s - start_s, 3))
        for tick in ticks
        if tick.percept is not None
    ]


def test_commands_come_late_weak_slowly_or_not_at_all_and_after_the_fault_as_they_are() -> None:
    assert made("control_delay:0.2") == [0.0, 0.0, *ASKED[:-2]]
    assert made("control_delay:0.2 from 0.2 s to 0.5 s") == [1.0, 2.0, 1.0, 2.0, 3.0, *ASKED[5:]]
    assert made("brake_gain:0.5") == [1.0, 2.0, 3.0, -2.0, -2.5, -3.0, 1.0, 2.0]
    assert made("control_drop:1 from 0.3 s to 0.6 s") == [1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 1.0, 2.0]
    slow = made("control_lag:0.2 to 0.6 s")
    assert slow[0] == pytest.approx(1.0 - math.exp(-0.5)) and slow[3] == pytest.approx(
        slow[2] + (-4.0 - slow[2]) * (1.0 - math.exp(-0.5))
    )
    assert slow[6:] == ASKED[6:]


def test_steering_comes_late_weak_slowly_or_not_at_all_and_braking_alone_leaves_it() -> None:
    asked = [None, 0.1, 0.2, 0.3, None]
    assert steered("control_delay:0.1", asked) == [None, None, 0.1, 0.2, 0.3]
    assert steered("steering_gain:0.5", asked) == [None, 0.05, 0.1, 0.15, None]
    assert steered("control_drop:1 from 0.2 s", asked) == [None, 0.1, 0.1, 0.1, 0.1]
    assert steered("brake_gain:0", asked) == asked and made("steering_gain:0") == ASKED
    slow, share = steered("control_lag:0.2", asked), 1.0 - math.exp(-0.5)
    assert slow[1] == pytest.approx(0.1 * share) and slow[2] == pytest.approx(slow[1] + (0.2 - slow[1]) * share)
    assert slow[0] is slow[4] is None


def test_numbers_of_no_effect_have_none() -> None:
    for text in ("control_delay:0", "control_lag:0", "control_drop:0", "brake_gain:1", "latency:2 + missed_cycles:1"):
        assert made(text) == ASKED, text


def test_lost_commands_are_as_many_as_they_should_be_and_the_same_again() -> None:
    own = EgoFaults(parse_faults("missed_cycles:0.3"), seed=3, ego_id=1, step_s=0.1)
    lost = [own.missed(0.1 * step) for step in range(1_000)]
    assert np.mean(lost) == pytest.approx(0.3, abs=0.04)
    assert lost == [own.missed(0.1 * step) for step in range(1_000)]


def test_latency_is_that_of_the_option_and_ends() -> None:
    told, option = driven("latency:0.3", duration_s=3.0), driven(latency_s=0.3, duration_s=3.0)
    assert arrivals(told.ticks) == arrivals(option.ticks) and arrivals(told.ticks)[0] == (0.3, 0.0)
    found = dict(arrivals(driven("latency:0.5 from 1 s to 1.5 s", duration_s=3.0).ticks))
    fresh = [time_s for time_s, measured_s in found.items() if measured_s == time_s]
    assert [round(0.1 * step, 3) for step in range(30) if round(0.1 * step, 3) not in fresh] == [
        1.0, 1.1, 1.2, 1.3, 1.4,
    ]  # fmt: skip
    assert not set(found) & {1.0, 1.1, 1.2, 1.3, 1.4}, "what comes after a newer one is of no use"


def test_missed_cycles_give_no_percept_and_the_tracks_go_on() -> None:
    found = driven("missed_cycles:1 from 1 s to 2 s", duration_s=3.0)
    assert [time_s for time_s, _ in arrivals(found.ticks)] == [round(0.1 * s, 3) for s in range(31) if not 10 <= s < 20]
    assert all(len(tick.tracks) for tick in found.ticks[10:13])


@pytest.mark.slow
def test_brakes_that_fail_crash_and_a_fault_after_the_end_changes_nothing(tmp_path: Path) -> None:
    well = driven()
    assert well.outcome is Outcome.ARRIVED
    assert driven("brake_gain:0").outcome is Outcome.CRASHED
    later = driven("brake_gain:0 from 60 s")
    assert [tick.decision for tick in later.ticks] == [tick.decision for tick in well.ticks]
    assert later.log().settings.fault == "brake_gain:0 from 60 s" and well.log().settings.fault == ""


def test_an_episode_with_faults_repeats_bit_for_bit_and_replays(tmp_path: Path) -> None:
    text = "latency:0.3 from 2 s to 5 s + missed_cycles:0.3 + control_delay:0.2 from 1 s + control_drop:0.2"
    logs = [driven(text).log(perception="truth").save(tmp_path / f"{number}.npz") for number in range(2)]
    assert logs[0].read_bytes() == logs[1].read_bytes()
    former = EpisodeLog.load(logs[0])
    again = replay(former, open_perception("truth", fault=former.settings.fault), "truth")
    assert arrivals(list(again.ticks)) == arrivals(list(former.ticks))
    ours, theirs = ([tick.decision.acceleration_mps2 for tick in log.ticks] for log in (again, former))
    np.testing.assert_allclose(ours, theirs, atol=0.05)


def test_an_ego_believes_its_place_and_speed_and_the_world_moves_with_it() -> None:
    ego = driven(duration_s=1.0).ticks[0].ego
    ahead = np.array([math.cos(ego.box.yaw[0]), math.sin(ego.box.yaw[0])])
    for text, moved_m in (("localisation_bias:3", 3.0), ("localisation_bias:-3", -3.0), ("localisation_drift:1", 2.0)):
        own = EgoFaults(parse_faults(text), seed=3, ego_id=1, step_s=0.1)
        known = own.believed(ego, 2.0)
        np.testing.assert_allclose(known.box.center[0, :2] - ego.box.center[0, :2], moved_m * ahead, atol=1e-6)
        np.testing.assert_allclose(known.route[0], known.box.center[0, :2], atol=0.05, err_msg="its route begins there")
        np.testing.assert_array_equal(known.route[-1], ego.route[-1])
        seen = Percept(ego.time_s, ego.box, np.ones(1), np.full((1, 2), np.nan))
        np.testing.assert_allclose(own.believed_percept(seen, ego.box, 2.0).boxes.center, known.box.center)
    slow = EgoFaults(parse_faults("speed_reading:0.8 to 5 s"), 3, 1, 0.1)
    assert slow.believed(ego, 2.0).speed_mps == pytest.approx(0.8 * ego.speed_mps) and slow.believed(ego, 5.0) is ego


@pytest.mark.slow
def test_a_wrong_place_of_who_sees_all_changes_no_distance_and_a_wrong_speed_does() -> None:
    well, moved, slow = (driven(text) for text in ("", "localisation_bias:2", "speed_reading:0.5"))
    assert moved.outcome is Outcome.ARRIVED
    np.testing.assert_array_equal(moved.tick.actors.boxes.label, well.tick.actors.boxes.label)
    speeds = [max(tick.ego.speed_mps for tick in loop.ticks) for loop in (well, slow)]
    assert speeds[1] > speeds[0] + 1.0, "the log has the true speed, which is above what the ego reads"
