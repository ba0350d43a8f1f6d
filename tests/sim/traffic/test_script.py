"""Scripted traffic: bodies move as bodies can, and those that are driven or in the way react."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from sim.collisions import overlapping_pairs
from sim.encounters import ENCOUNTERS, encounter_of
from sim.errors import TrafficError
from sim.geometry import wrap_angle
from sim.traffic.base import SIGNALS, Actors
from sim.traffic.open import open_traffic
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from tests.sim.encounters.test_encounters import encounter

EGO, CONFLICT = FIRST_ID, FIRST_ID + 1
SEED, STEP = 2, 0.1


def rollout(kind: str, seconds: float = 11.0, **conflict: Any) -> tuple[list[Actors], list[tuple[float, str, str]]]:
    with ScriptedTraffic(encounter(kind, **conflict), SEED) as traffic:
        steps = [traffic.actors]
        while traffic.time_s < seconds - 1e-6:
            steps.append(traffic.step())
        return steps, traffic.crashes


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_bodies_move_as_bodies_can_until_somebody_crashes(kind: str) -> None:
    steps, crashes = rollout(kind, control="no_conflict")
    if crashes:
        steps = steps[: round(crashes[0][0] / STEP)]
    assert len(steps) > 40
    for before, now in pairwise(steps):
        both = np.intersect1d(before.boxes.object_id, now.boxes.object_id)
        was = np.array([before.row(i) for i in both])
        row = np.array([now.row(i) for i in both])
        moved = now.boxes.center[row, :2] - before.boxes.center[was, :2]
        np.testing.assert_allclose(now.velocity[row], moved / STEP, atol=1e-9)
        speed = np.linalg.norm(now.velocity[row], axis=1)
        yaw = now.boxes.yaw[row]
        turned = wrap_angle(yaw - before.boxes.yaw[was]) / STEP
        assert np.abs(turned).max() < np.radians(75.0)
        fast = speed > 0.5
        slip = wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - (yaw - 0.5 * turned * STEP))[fast]
        assert np.abs(slip).max(initial=0.0) < np.radians(3.0)
        assert np.linalg.norm(now.acceleration[row], axis=1).max() < 9.5
        assert len(overlapping_pairs(now.boxes)) == 0


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_nobody_appears_within_sight(kind: str) -> None:
    steps, _ = rollout(kind, 8.0)
    assert set(np.concatenate([step.boxes.object_id for step in steps])) == set(steps[0].boxes.object_id)


def test_who_crashes_stops_dead_and_stays() -> None:
    steps, crashes = rollout("ima_building")
    time_s, *names = crashes[0]
    assert names == ["ego", "conflict"] and 5.0 < time_s < 6.5
    hit = round(time_s / STEP)
    assert len(overlapping_pairs(steps[hit - 1].boxes)) == 0
    for who in (EGO, CONFLICT):
        places = np.array([step.boxes.center[step.row(who), :2] for step in steps[hit:]])
        assert (places == places[0]).all()
        assert steps[-1].signals[steps[-1].row(who)] & SIGNALS["hazard lights"]


def test_lanes_are_those_below_and_lights_tell_what_drivers_do() -> None:
    steps, _ = rollout("cyclist_right_hook", 6.0)
    start, ego = steps[0], steps[0].row(EGO)
    assert start.lane[ego] == "w_in_1"
    assert start.lane[start.row(CONFLICT)] == "cycle_path_0"
    assert steps[40].signals[ego] & SIGNALS["right indicator"]
    speed = np.array([np.linalg.norm(step.velocity[ego]) for step in steps])
    braking = np.array([bool(step.signals[ego] & SIGNALS["brake light"]) for step in steps])
    slowing = np.diff(speed, prepend=speed[0]) < -0.03
    assert braking.any() and not braking.all()
    assert (braking == slowing)[1:50].all()


def test_a_driven_ego_keeps_its_way_and_brakes_as_hard_as_it_is_told() -> None:
    with ScriptedTraffic(encounter("ima_building"), SEED) as traffic:
        assert traffic.limits(EGO).deceleration_mps2 >= 7.5 and traffic.signals(EGO) == ()
        speed = traffic.speed(EGO)
        route = traffic.route(EGO, 30.0)
        np.testing.assert_allclose(route[0], traffic.actors.boxes.center[0, :2], atol=1e-9)
        assert np.linalg.norm(np.diff(route, axis=0), axis=1).sum() == pytest.approx(30.0, abs=0.1)
        while traffic.speed(EGO) > 0.0:
            last = traffic.speed(EGO)
            traffic.command(EGO, max(0.0, last - 4.0 * STEP))
            traffic.step()
            assert last - traffic.speed(EGO) <= 4.0 * STEP + 1e-9
        assert traffic.time_s == pytest.approx(speed / 4.0, abs=0.1)
        stopped = traffic.actors.boxes.center[0].copy()
        for _ in range(60):
            traffic.step()
        assert not traffic.crashes
        np.testing.assert_array_equal(traffic.actors.boxes.center[0], stopped)
        assert traffic.limits(EGO).speed_mps == pytest.approx(speed)
        traffic.command(EGO, None)
        for _ in range(60):
            traffic.step()
        assert traffic.speed(EGO) == pytest.approx(speed)


def test_followers_stop_behind_an_ego_that_stops() -> None:
    with ScriptedTraffic(encounter("cut_in_merge", control="no_conflict"), SEED) as traffic:
        names = {name: FIRST_ID + k for k, name in enumerate(["ego", "", "truck"])}
        while traffic.speed(names["truck"]) > 0.0 and traffic.time_s < 10.0:
            traffic.command(names["truck"], max(0.0, traffic.speed(names["truck"]) - 0.3))
            traffic.step()
        assert not traffic.crashes
        assert traffic.speed(names["truck"] + 1) < 8.0


def test_a_ghost_is_claimed_and_is_not_there() -> None:
    real, _ = rollout("ped_bus_stop", 4.0)
    with ScriptedTraffic(encounter("ped_bus_stop", control="ghost"), SEED) as traffic:
        assert CONFLICT not in traffic.actors.boxes.object_id
        for _ in range(40):
            traffic.step()
        claims = traffic.claims()
        assert list(claims) == ["bus"] and claims["bus"].name == ("ghost",)
        there = real[40].boxes[real[40].row(CONFLICT) : real[40].row(CONFLICT) + 1]
        np.testing.assert_allclose(claims["bus"].boxes.array, there.array)
        assert CONFLICT not in traffic.actors.boxes.object_id


def test_a_closed_script_moves_no_more() -> None:
    traffic = open_traffic(encounter("ima_building"), SEED)
    assert isinstance(traffic, ScriptedTraffic)
    traffic.close()
    with pytest.raises(TrafficError, match="closed"):
        traffic.step()


def test_ids_are_the_same_in_all_controls() -> None:
    controls = ("", "no_occluder", "no_conflict", "ghost")
    ids = [
        dict(
            zip(
                (a := ScriptedTraffic(encounter("ima_queue", control=c), SEED).actors).name,
                a.boxes.object_id.tolist(),
                strict=True,
            )
        )
        for c in controls
    ]
    for other in ids:
        assert other["ego"] == EGO
        assert other.get("conflict", CONFLICT) == CONFLICT
    assert ids[0] == {**ids[2], "conflict": CONFLICT}
    assert encounter_of(encounter("ima_queue"), SEED).names("ego") == ("ego",)


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_the_goal_lies_behind_the_conflict_and_an_ego_that_drives_on_reaches_it(kind: str) -> None:
    with ScriptedTraffic(encounter(kind, control="no_conflict"), SEED) as traffic:
        left = [traffic.goal_m(EGO)]
        while left[-1] > 0.0 and traffic.time_s < 15.0:
            traffic.command(EGO, traffic.limits(EGO).speed_mps)
            traffic.step()
            left.append(traffic.goal_m(EGO))
        assert left[-1] <= 0.0 and 6.0 < traffic.time_s < 12.0
        assert (np.diff(left) < 0.0).all()
        assert traffic.goal_m(CONFLICT + 1) is None


def test_behind_a_car_that_blocks_the_lane_the_goal_is_to_stand() -> None:
    with ScriptedTraffic(encounter("stalled_after_curve"), SEED) as traffic:
        while not traffic.crashes:
            assert traffic.goal_m(EGO) > 0.0
            traffic.step()
    with ScriptedTraffic(encounter("stalled_after_curve"), SEED) as traffic:
        while traffic.goal_m(EGO) > 0.0 and traffic.time_s < 30.0:
            car, ego = (traffic.actors.boxes.center[row, :2] for row in (1, 0))
            gap = max(float(np.hypot(*(car - ego))) - 8.0, 0.0)
            traffic.command(EGO, min(traffic.limits(EGO).speed_mps, np.sqrt(2.0 * 3.0 * gap)))
            traffic.step()
        assert not traffic.crashes and traffic.speed(EGO) < 1.0 and traffic.time_s < 25.0
