"""Safe speed of encounters: what an ego may drive that stops for what it sees itself."""

import pytest

from sensors.recording.encounter_check import BRAKING_MPS2, LATENCY_S
from sensors.recording.safe_speed import safe_speed
from tests.sim.encounters.test_encounters import encounter


def test_a_house_nearer_to_the_road_lowers_the_safe_speed() -> None:
    near, far = (
        safe_speed(encounter("ima_building", parameters={"setback_m": setback_m, "from_left": 0.0}), 1)
        for setback_m in (2.0, 6.0)
    )
    assert near is not None and far is not None
    assert near.safe_mps + 0.5 < far.safe_mps < far.comes_mps
    assert near.comes_mps == far.comes_mps
    assert near.costs_s > far.costs_s


@pytest.mark.slow
def test_without_the_occluder_the_speed_of_the_lane_is_safe() -> None:
    hidden, free = (
        safe_speed(encounter("ima_building", parameters={"setback_m": 2.0}, control=control), 1)
        for control in ("", "no_occluder")
    )
    assert hidden is not None and free is not None
    assert hidden.safe_mps < free.comes_mps - 1.0
    assert free.safe_mps == pytest.approx(free.comes_mps, abs=0.3)
    assert free.costs_s < 0.01
    stops_m = LATENCY_S * hidden.safe_mps + 0.5 * hidden.safe_mps**2 / BRAKING_MPS2
    assert 1.0 < stops_m < 15.0


@pytest.mark.parametrize("kind", ["eebl_chain", "dnpw_overtake"])
def test_where_the_gap_decides_there_is_no_safe_speed(kind: str) -> None:
    assert safe_speed(encounter(kind), 1) is None
