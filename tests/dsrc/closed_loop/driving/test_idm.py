"""Car following."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.idm import IdmSettings, following_acceleration, free_acceleration

MODEL = IdmSettings()


def test_on_a_free_road_the_speed_converges_from_both_sides() -> None:
    assert free_acceleration(0.0, 14.0, MODEL) == MODEL.acceleration_mps2
    assert free_acceleration(14.0, 14.0, MODEL) == 0.0
    assert -MODEL.deceleration_mps2 < free_acceleration(20.0, 14.0, MODEL) < 0.0
    assert free_acceleration(5.0, 0.0, MODEL) == -MODEL.deceleration_mps2


def test_far_behind_a_leader_it_accelerates_as_on_a_free_road() -> None:
    assert following_acceleration(10.0, 14.0, 1e6, 10.0, MODEL) == pytest.approx(free_acceleration(10.0, 14.0, MODEL))


def test_at_the_wanted_gap_it_keeps_the_speed() -> None:
    gap = MODEL.standing_m + 10.0 * MODEL.headway_s
    assert following_acceleration(10.0, 14.0, gap, 10.0, MODEL) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("speed", [2.0, 10.0, 20.0])
def test_it_grows_with_the_gap_and_with_the_speed_of_the_leader(speed: float) -> None:
    gaps = [following_acceleration(speed, 14.0, gap, 8.0, MODEL) for gap in np.linspace(1.0, 200.0, 60)]
    leads = [following_acceleration(speed, 14.0, 20.0, lead, MODEL) for lead in np.linspace(0.0, 30.0, 60)]
    assert (np.diff(gaps) >= -1e-9).all()
    assert (np.diff(leads) >= -1e-9).all()


def test_standing_close_behind_it_stays() -> None:
    assert following_acceleration(0.0, 14.0, 1.0, 0.0, MODEL) < 0.0
    assert following_acceleration(0.0, 14.0, 10.0, 0.0, MODEL) > 0.0
