"""Clock of the script: a driven ego meets the conflict that it would meet undriven, and else it is told."""

import math

import numpy as np
import pytest

from sim.encounters import ENCOUNTERS, encounter_of
from sim.encounters.types import HIT_S
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from sim.traffic.scripted.clock import COMMIT_S, ScriptClock
from tests.sim.encounters.test_encounters import encounter

EGO, CONFLICT = FIRST_ID, FIRST_ID + 1
SEED = 1
WAITING = [kind for kind, one in ENCOUNTERS.items() if one.waits]


def scripts(kind: str) -> tuple:
    return encounter_of(encounter(kind), SEED).layout.actors


def ride(
    kind: str, share_before: float, seconds: float = 10.0
) -> tuple[np.ndarray, float | None, list[tuple[float, str, str]]]:
    """Ego at a share of its scripted speed until the commit, then at all of it; distances of both, without a crash."""
    ego, conflict = scripts(kind)[:2]
    with ScriptedTraffic(encounter(kind), SEED) as traffic:
        along = []
        while traffic.time_s < seconds and EGO in traffic.actors.boxes.object_id and not traffic.crashes:
            now = traffic.actors
            both = ((ego.path, EGO), (conflict.path, CONFLICT))
            places = [path.nearest(now.boxes.center[now.row(i), :2]) for path, i in both]
            along.append((traffic.time_s, *places))
            waits = math.isinf(traffic.encounter_gap_s(EGO))
            traffic.command(EGO, traffic.limits(EGO).speed_mps * (share_before if waits else 1.0))
            traffic.step()
        return np.array(along), traffic.encounter_gap_s(EGO), traffic.crashes


def arrival(times: np.ndarray, along: np.ndarray, place: float) -> float:
    """Time at a place, or when it would be there at its last speed."""
    last = (along[-1] - along[-3]) / (times[-1] - times[-3])
    return float(np.interp(place, along, times)) if place <= along[-1] else times[-1] + (place - along[-1]) / last


@pytest.mark.parametrize("kind", WAITING)
def test_an_ego_that_dawdles_meets_the_conflict_all_the_same(kind: str) -> None:
    ego, conflict = scripts(kind)[:2]
    rows, gap_s, crashes = ride(kind, 0.7)
    at_s = [arrival(rows[:, 0], rows[:, k], float(one.place(HIT_S))) for k, one in ((1, ego), (2, conflict))]
    assert at_s[0] > HIT_S + 0.5
    assert at_s[0] == pytest.approx(at_s[1], abs=0.3)
    assert abs(gap_s) < 0.2
    assert [set(names) for _, *names in crashes] == [{"ego", "conflict"}]


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_an_ego_driven_as_scripted_meets_exactly_the_actors_of_an_undriven_one(kind: str) -> None:
    ego = scripts(kind)[0]
    with ScriptedTraffic(encounter(kind), SEED) as plain, ScriptedTraffic(encounter(kind), SEED) as driven:
        while not plain.crashes and plain.time_s < 8.0:
            driven.command(EGO, float(ego.pace.at(driven.time_s + driven.step_s)))
            one, other = plain.step(), driven.step()
            if plain.crashes:
                break
            others = one.boxes.object_id != EGO
            assert one.boxes[others].array.tobytes() == other.boxes[others].array.tobytes()
            assert one.velocity[others].tobytes() == other.velocity[others].tobytes()
            assert (one.signals[others] == other.signals[others]).all()
            np.testing.assert_allclose(one.boxes.center[0], other.boxes.center[0], atol=0.02)
        assert plain.time_s > 4.0


def test_the_actors_slow_down_for_a_slow_ego_no_harder_than_is_comfortable() -> None:
    conflict = scripts("ima_building")[1]
    _, comfortable, _ = conflict.kind.accel_mps2
    rows, *_ = ride("ima_building", 0.5, 4.0)
    speed = np.diff(rows[:, 2]) / 0.1
    assert speed.min() < 0.75 * speed[0]
    assert np.abs(np.diff(speed)).max() / 0.1 <= comfortable + 0.1


def test_an_ego_that_waits_at_the_start_has_lost_its_encounter() -> None:
    with ScriptedTraffic(encounter("ima_building"), SEED) as traffic:
        assert traffic.encounter_gap_s(EGO) == math.inf
        while traffic.time_s < 8.0:
            traffic.command(EGO, max(traffic.speed(EGO) - 0.6, 0.0))
            traffic.step()
        assert 1.0 < traffic.encounter_gap_s(EGO) < math.inf
        assert not traffic.crashes


@pytest.mark.parametrize(
    ("kind", "control"),
    [("eebl_chain", ""), ("stalled_after_curve", ""), ("ima_queue", "no_conflict"), ("ima_queue", "ghost")],
)
def test_where_nobody_is_to_be_met_there_is_no_gap(kind: str, control: str) -> None:
    with ScriptedTraffic(encounter(kind, control=control), SEED) as traffic:
        assert traffic.encounter_gap_s(EGO) is None
        with pytest.raises(KeyError):
            traffic.encounter_gap_s(5)


def test_the_reference_driver_accelerates_to_the_scripted_speed() -> None:
    ego = scripts("ima_building")[0]
    clock = ScriptClock(ego, (), 0.1)
    speed, strongest, hit = float(ego.pace.at(0.0)), ego.kind.accel_mps2[0], float(ego.place(HIT_S))
    assert clock.eta(hit - 30.0, speed) == pytest.approx(30.0 / speed, abs=1e-6)
    gains_m = 0.5 * speed**2 / strongest
    expected = speed / strongest + (60.0 - gains_m) / speed
    assert gains_m < 60.0
    assert clock.eta(hit - 60.0, 0.0) == pytest.approx(expected, rel=0.01)
    assert clock.eta(hit + 2.0, speed) == pytest.approx(-2.0 / speed)


def test_the_clock_commits_some_seconds_before_the_crash_and_is_the_time_for_an_undriven_ego() -> None:
    ego, *others = scripts("ima_building")
    clock = ScriptClock(ego, others, 0.1)
    for step in range(60):
        assert clock.committed == (step * 0.1 > HIT_S - COMMIT_S + 0.05)
        clock.advance(step * 0.1, float(ego.place(step * 0.1)), float(ego.pace.at(step * 0.1)), driven=False)
        assert clock.offset_s == 0.0 and clock.rate == 1.0
    assert clock.gap_s == pytest.approx(0.0, abs=1e-6)
