"""The follower of the Intelligent Driver Model neither hits what stands nor stands where the road is free."""

import math

import pytest

from dsrc.closed_loop.idm import IdmSettings, idm_acceleration


def roll(speed: float, gap: float, lead_speed: float, seconds: float = 60.0) -> tuple[float, float, float]:
    """Follow a leader of constant speed; return (speed, gap, smallest gap)."""
    smallest = gap
    for _ in range(int(seconds / 0.1)):
        acceleration = idm_acceleration(speed, 14.0, gap, lead_speed)
        speed = max(0.0, speed + 0.1 * acceleration)
        gap += 0.1 * (lead_speed - speed)
        smallest = min(smallest, gap)
    return speed, gap, smallest


def test_a_free_road_is_driven_at_the_desired_speed() -> None:
    speed, _, _ = roll(0.0, math.inf, 0.0)
    assert speed == pytest.approx(14.0, abs=0.2)


def test_a_standing_car_is_approached_and_not_touched() -> None:
    speed, gap, smallest = roll(14.0, 60.0, 0.0)
    assert speed < 0.1
    assert smallest > 1.0
    assert gap < 5.0


def test_a_leader_is_followed_at_its_speed_with_the_time_gap() -> None:
    speed, gap, _ = roll(14.0, 80.0, 8.0)
    settings = IdmSettings()
    assert speed == pytest.approx(8.0, abs=0.1)
    assert gap >= settings.jam_gap + settings.headway_s * 8.0 - 0.1


@pytest.mark.parametrize("gap", [0.0, 0.5, 5.0, math.inf])
def test_the_limits_of_the_car_hold(gap: float) -> None:
    settings = IdmSettings()
    acceleration = idm_acceleration(15.0, 14.0, gap, -10.0)
    assert -settings.max_deceleration <= acceleration <= settings.max_acceleration


def test_a_nearer_obstacle_never_makes_it_accelerate_more() -> None:
    values = [idm_acceleration(10.0, 14.0, gap, 5.0) for gap in (2.0, 5.0, 10.0, 20.0, 40.0, math.inf)]
    assert values == sorted(values)
