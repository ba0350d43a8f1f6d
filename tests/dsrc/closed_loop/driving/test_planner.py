"""A driver with the truth: facts about what it does on a straight street."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.planner import PlannerSettings, PlanningDriver
from dsrc.closed_loop.driving.prediction import PredictionSettings
from tests.dsrc.closed_loop.driving.world import CAR, Other, ego_at, run, tracks_of


def test_with_nobody_there_it_reaches_the_limit_and_keeps_it() -> None:
    alone = run(PlanningDriver(), speed=0.0, seconds=20.0)
    assert alone.speed[-1] == pytest.approx(14.0, abs=0.2)
    assert max(alone.speed) <= 14.01
    assert alone.decisions[-1].reason == "free"


def test_above_the_limit_it_slows_down_gently() -> None:
    fast = run(PlanningDriver(), speed=20.0, limit=10.0, seconds=15.0)
    assert fast.speed[-1] == pytest.approx(10.0, abs=0.6)
    assert fast.hardest <= 2.6


@pytest.mark.parametrize("speed", [3.0, 8.0, 14.0, 20.0])
def test_it_stops_behind_a_standing_car_without_a_full_brake(speed: float) -> None:
    stopped = run(PlanningDriver(), [Other(100.0, 0.0)], speed=speed, limit=speed, seconds=40.0)
    gap = 100.0 - 0.5 * CAR[0] - stopped.x[-1] - 0.5 * CAR[0]
    assert not stopped.hit
    assert stopped.speed[-1] < 0.05
    assert 1.5 <= gap <= 4.0
    assert stopped.hardest <= 4.0
    assert stopped.decisions[-1].reason == "follow"
    assert stopped.decisions[-1].track == 0


def test_it_brakes_fully_only_when_nothing_less_is_enough() -> None:
    """22 m before a standing car that it sees too late: 14 m/s need 4.9 m/s2 to its bumper; from 15 m 7.5 and more."""
    late = run(PlanningDriver(), [Other(22.0 + CAR[0], 0.0)], seconds=6.0)
    assert not late.hit
    assert 4.5 <= late.hardest <= 7.5
    assert "emergency" in {decision.reason for decision in late.decisions}
    later = run(PlanningDriver(), [Other(16.0 + CAR[0], 0.0)], seconds=6.0)
    assert later.hardest == pytest.approx(7.5)
    assert not later.hit


def test_where_it_cannot_stop_it_hits_as_slowly_as_it_can() -> None:
    hopeless = run(PlanningDriver(), [Other(8.0 + CAR[0], 0.0)], seconds=2.0)
    assert hopeless.hit
    assert hopeless.decisions[0].acceleration_mps2 == pytest.approx(-7.5)
    assert hopeless.decisions[0].reason == "emergency"


@pytest.mark.parametrize("speed", [8.0, 14.0, 30.0])
@pytest.mark.parametrize("width", [1.85, 2.55])
def test_it_never_brakes_for_oncoming_traffic_in_the_other_lane(speed: float, width: float) -> None:
    column = [Other(40.0 + 35.0 * k, 3.2, -speed, 0.0, size=(8.0, width, 3.0)) for k in range(8)]
    passed = run(PlanningDriver(), column)
    assert min(passed.speed) > 13.9


def test_it_brakes_for_oncoming_traffic_in_its_own_lane() -> None:
    met = run(PlanningDriver(), [Other(120.0, 0.0, -10.0, 0.0)], seconds=3.0)
    assert met.speed[-1] < 12.0


def test_a_car_that_follows_is_no_obstacle() -> None:
    followed = run(PlanningDriver(), [Other(-8.0, 0.0, 18.0, 0.0)], seconds=0.4)
    assert followed.hardest <= 0.01


def test_a_parked_car_beside_its_lane_is_passed() -> None:
    """The gap between the boxes is 0.35 m."""
    beside = [Other(40.0 + 6.0 * k, -CAR[1] - 0.35) for k in range(5)]
    assert min(run(PlanningDriver(), beside).speed) > 13.9


def test_it_follows_a_slower_car_at_a_safe_gap() -> None:
    driver, lead = PlanningDriver(), Other(40.0, 0.0, 8.0, 0.0)
    behind = run(driver, [lead], seconds=30.0)
    gap = 40.0 + 8.0 * 29.9 - behind.x[-1] - CAR[0]
    assert behind.speed[-1] == pytest.approx(8.0, abs=0.3)
    assert 0.9 * 8.0 < gap < 2.5 * 8.0
    assert behind.hardest <= 3.0
    assert behind.decisions[-1].reason == "follow"


@pytest.mark.parametrize("brakes", [4.0, 6.0, 8.0])
def test_it_stops_behind_a_leader_that_brakes_hard(brakes: float) -> None:
    lead = Other(14.0 * 1.2 + CAR[0], 0.0, 14.0, 0.0, brakes)
    stopped = run(PlanningDriver(), [lead], seconds=8.0)
    assert not stopped.hit
    assert stopped.speed[-1] < 0.1


@pytest.mark.parametrize("arrives_s", np.arange(1.5, 6.0, 0.5))
@pytest.mark.parametrize("speed", [6.0, 14.0])
def test_a_crossing_car_is_let_pass_or_is_passed_with_margin(arrives_s: float, speed: float) -> None:
    """Both would be at x = 50 about 3.6 s from now; the times of passage differ by 0.5 s and more at the end."""
    crossing = Other(50.0, -speed * arrives_s, 0.0, speed)
    met = run(PlanningDriver(), [crossing], seconds=9.0)
    x, time_s = np.array(met.x), 0.1 * np.arange(len(met.x))
    inside = (x > 50.0 - 0.5 * (CAR[0] + CAR[1])) & (x < 50.0 + 0.5 * (CAR[0] + CAR[1]))
    lateral = np.abs(-speed * arrives_s + speed * time_s)
    gap_s = np.maximum(lateral[inside] - 0.5 * (CAR[0] + CAR[1]), 0.0) / speed
    assert not met.hit
    assert gap_s.min() > 0.4
    assert met.x[-1] > 50.0


def test_it_starts_again_when_a_standing_obstacle_leaves() -> None:
    waits = run(PlanningDriver(), [Other(40.0, 0.0, until_s=10.0)], seconds=20.0)
    assert waits.speed[99] < 0.1
    assert waits.speed[-1] > 13.0


def test_a_pedestrian_who_stands_beside_the_road_does_not_stop_it_and_one_who_walks_does() -> None:
    person = {"label": "pedestrian", "size": (0.6, 0.6, 1.8)}
    stands, walks = Other(50.0, -4.0, **person), Other(50.0, -5.0, 0.0, 1.5, **person)
    assert min(run(PlanningDriver(), [stands]).speed) > 13.9
    met = run(PlanningDriver(), [walks])
    assert not met.hit
    assert min(met.speed) < 12.0
    assert met.x[-1] > 60.0


def test_it_stops_at_red_with_its_front_before_the_line_and_goes_at_green() -> None:
    held = run(PlanningDriver(), line_x=80.0, seconds=30.0, green_s=20.0)
    fronts = np.array(held.x[:200]) + 0.5 * CAR[0]
    assert fronts.max() <= 80.0
    assert fronts.max() > 77.0
    assert held.speed[199] < 0.1
    assert held.speed[-1] > 12.0
    assert held.hardest <= 3.5
    assert held.decisions[150].reason == "signal"


def test_at_yellow_it_stops_where_that_is_comfortable_and_passes_where_it_is_not() -> None:
    """14 m/s stop comfortably, at 3 m/s2, within 33 m."""
    near = run(PlanningDriver(), line_x=15.0 + 0.5 * CAR[0], state="yellow", seconds=3.0)
    assert min(near.speed) > 13.5
    far = run(PlanningDriver(), line_x=45.0 + 0.5 * CAR[0], state="yellow", seconds=12.0)
    assert max(far.x) + 0.5 * CAR[0] <= 45.0 + 0.5 * CAR[0]
    assert far.hardest <= 4.0


def test_equal_inputs_give_equal_decisions() -> None:
    others = [Other(50.0, -30.0, 0.0, 9.0), Other(70.0, 0.0), Other(60.0, 3.2, -12.0, 0.0)]
    first, second = (run(PlanningDriver(), others, seconds=4.0) for _ in range(2))
    assert first.decisions == second.decisions


def test_without_a_route_ahead_it_still_decides() -> None:
    ego = ego_at(0.0, 5.0)
    short = type(ego)(**{**{f: getattr(ego, f) for f in ego.__slots__}, "route": np.zeros((2, 2))})
    decision = PlanningDriver().decide(short, tracks_of([Other(30.0, 0.0)], 0.0))
    assert np.isfinite(decision.acceleration_mps2)


@pytest.mark.parametrize("needed_mps2", [8.0, 10.0, 12.0, 14.0])
def test_no_plan_ends_faster_than_the_ego_can_brake_after_it(needed_mps2: float) -> None:
    """A driver who foresees one second stops all the same where braking from now on is enough."""
    speed = 20.0
    short = PlannerSettings(prediction=PredictionSettings(horizon_s=1.0))
    stopped = run(PlanningDriver(short), [Other(speed**2 / needed_mps2 + CAR[0], 0.0)], speed=speed, limit=speed)
    assert not stopped.hit
    assert stopped.speed[-1] < 0.1
