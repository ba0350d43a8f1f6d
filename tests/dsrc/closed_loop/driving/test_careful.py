"""The reference driver of UN R157: how late it reacts, and how hard."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.careful import G_MPS2, CarefulDriver, CarefulSettings
from dsrc.closed_loop.driving.planner import PlanningDriver
from tests.dsrc.closed_loop.driving.world import CAR, Other, run


def test_it_brakes_at_its_times_and_its_ramp_for_a_car_that_appears() -> None:
    """First sight at 2.0 s; then 0.4 s of perception, 0.75 s of reaction, 0.6 s of ramp to 0.774 g."""
    at = 2.0
    appears = Other(14.0 * at + 26.0 + CAR[0], 0.0, from_s=at)
    met = run(CarefulDriver(), [appears], seconds=5.0)
    braking = np.array([-decision.acceleration_mps2 for decision in met.decisions])
    first = int(np.argmax(braking > 0.3)) * 0.1
    assert first == pytest.approx(at + 0.4 + 0.75, abs=0.15)
    full = int(np.argmax(braking > 0.774 * G_MPS2 - 0.1)) * 0.1
    assert full - first == pytest.approx(0.6, abs=0.15)
    assert braking.max() == pytest.approx(0.774 * G_MPS2, abs=0.1)


def test_a_driver_without_delay_avoids_a_crash_that_it_cannot() -> None:
    appears = Other(28.0 + 19.0 + CAR[0], 0.0, from_s=2.0)
    assert run(CarefulDriver(), [appears], seconds=6.0).hit
    assert not run(PlanningDriver(), [appears], seconds=6.0).hit


def test_what_it_sees_early_enough_it_avoids() -> None:
    for others in ([Other(90.0, 0.0)], [Other(60.0, -60.0, 0.0, 14.0)]):
        assert not run(CarefulDriver(), others, seconds=10.0).hit


def test_it_drives_as_anyone_where_there_is_no_risk() -> None:
    alone, line = run(CarefulDriver(), speed=0.0, seconds=15.0), run(CarefulDriver(), line_x=80.0, seconds=15.0)
    assert alone.speed[-1] > 13.5
    assert max(line.x) + 0.5 * CAR[0] <= 80.0


def test_a_slower_reaction_is_never_better() -> None:
    appears = [Other(28.0 + 30.0 + CAR[0], 0.0, from_s=2.0)]
    impact = []
    for reaction_s in (0.0, 0.75, 1.5):
        met = run(CarefulDriver(settings=CarefulSettings(reaction_s=reaction_s)), appears, seconds=6.0)
        impact.append(met.speed[int(np.argmax(np.array(met.x) > 28.0 + 29.5))] if met.hit else 0.0)
    assert impact == sorted(impact)
    assert impact[-1] > 0.0
