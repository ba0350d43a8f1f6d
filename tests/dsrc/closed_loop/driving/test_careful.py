"""The reference driver of UN R157: how late it reacts, and how hard."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.careful import G_MPS2, CarefulDriver, CarefulSettings
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.types import Decision
from tests.dsrc.closed_loop.driving.world import CAR, Other, ego_at, run, tracks_of


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


@pytest.mark.parametrize("routine", [0.0, 1.2])
def test_braking_that_has_begun_goes_on_while_it_reacts_to_a_harder_need(
    monkeypatch: pytest.MonkeyPatch, routine: float
) -> None:
    driver, wanted = CarefulDriver(), iter([routine] * 10 + [4.0] * 30)
    monkeypatch.setattr(driver._planner, "decide", lambda ego, tracks: Decision(-next(wanted), "follow"))
    ahead, times = tracks_of([Other(60.0, 0.0)], 0.0), 0.1 * np.arange(40)
    braking = [-driver.decide(ego_at(0.0, 14.0, time_s), ahead).acceleration_mps2 for time_s in times]
    assert braking[:17] == pytest.approx([routine] * 17)  # 0.7 s after the need, within the reaction
    assert (np.diff(braking) >= -1e-9).all() and braking[-1] == pytest.approx(4.0)
