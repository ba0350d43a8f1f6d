"""Overtaking: a driven ego may give it up as long as it is behind the lorry."""

import numpy as np
import pytest

from sim.collisions import overlapping_pairs
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from tests.sim.encounters.test_encounters import encounter

EGO, CONFLICT = FIRST_ID, FIRST_ID + 1


def overtake(seed: int, sees_m: float, control: str = "") -> tuple[list, list, ScriptedTraffic]:
    """Ego at its scripted speed that brakes at 6 m/s2 for a car within sight until that has passed."""
    with ScriptedTraffic(encounter("dnpw_overtake", control=control), seed) as traffic:
        steps, brakes = [traffic.actors], False
        while traffic.time_s < 12.0:
            now = traffic.actors
            if CONFLICT in now.boxes.object_id:
                away = now.boxes.center[now.row(CONFLICT), :2] - now.boxes.center[0, :2]
                ahead = away @ [np.cos(now.boxes.yaw[0]), np.sin(now.boxes.yaw[0])]
                brakes = 0.0 < ahead and np.hypot(*away) < sees_m
            else:
                brakes = False
            speed = traffic.speed(EGO)
            traffic.command(EGO, max(speed - 0.6, 0.0) if brakes else traffic.limits(EGO).speed_mps)
            steps.append(traffic.step())
        return steps, traffic.crashes, traffic


@pytest.mark.parametrize("control", ["", "no_occluder"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_who_brakes_for_the_oncoming_car_is_back_in_the_lane_when_it_passes(seed: int, control: str) -> None:
    steps, crashes, _ = overtake(seed, 70.0, control)
    assert not crashes
    turned = np.abs(np.diff(np.unwrap([step.boxes.yaw[0] for step in steps]))) / 0.1
    assert turned.max() < np.radians(40.0)
    assert not any(len(overlapping_pairs(step.boxes)) for step in steps)


def test_who_does_not_brake_overtakes_into_the_crash() -> None:
    _, crashes, _ = overtake(1, 0.0)
    assert [set(names) for _, *names in crashes] == [{"ego", "conflict"}]


def test_without_the_oncoming_car_it_comes_past_the_lorry() -> None:
    steps, crashes, _ = overtake(1, 70.0, "no_conflict")
    assert not crashes
    last = steps[-1]
    along = [np.cos(last.boxes.yaw[0]), np.sin(last.boxes.yaw[0])]
    lorry = last.boxes.center[last.row(FIRST_ID + 2), :2]
    assert (lorry - last.boxes.center[0, :2]) @ along < 0.0


def test_with_the_lorry_far_ahead_there_is_nothing_to_overtake() -> None:
    with ScriptedTraffic(encounter("dnpw_overtake"), 1) as traffic:
        while traffic.time_s < 14.0 and CONFLICT in traffic.actors.boxes.object_id:
            traffic.command(EGO, 3.0)
            traffic.step()
        for _ in range(150):
            traffic.command(EGO, 10.0)
            traffic.step()
        lanes = {traffic.actors.lane[0]}
        assert not traffic.crashes and lanes <= {"there_0", ""}
