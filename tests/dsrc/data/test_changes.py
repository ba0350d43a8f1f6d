"""Scenarios with other sensors, agents or another place."""

from pathlib import Path

import pytest

from dsrc.data.changes import HALF_M, at_place
from dsrc.data.write import generate
from sim.catalog.load import load_scenario
from sim.errors import SettingsError


def test_a_place_is_the_middle_of_the_area_and_of_the_trips_and_keeps_the_units_around_it() -> None:
    scenario = load_scenario("four_way")
    (unit,) = scenario.agents.roadside
    x, y = unit.xyz_m[:2]
    here = at_place(scenario, f"{x},{y}")
    assert here.network.area_m == (x - HALF_M, y - HALF_M, x + HALF_M, y + HALF_M)
    assert here.demand.focus_m == (x, y) and here.agents.roadside == (unit,)
    assert at_place(scenario, (x + HALF_M + 1.0, y)).agents.roadside == ()


@pytest.mark.parametrize("at", ["1", "1,2,3", "a,b", "nan,1", "inf,1", (1.0,), (1.0, "x")])
def test_a_place_is_two_numbers(at: str) -> None:
    with pytest.raises(SettingsError, match="--at: expected two numbers X,Y"):
        at_place(load_scenario("four_way"), at)


def test_an_encounter_has_its_own_place() -> None:
    with pytest.raises(SettingsError, match="leave out --at"):
        at_place(load_scenario("lta_truck"), "1,2")


def test_an_encounter_names_who_carries_a_lidar(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="--vehicles: expected none, as the encounter lta_truck names who"):
        generate("lta_truck", out=tmp_path, vehicles=1)
