"""Encounters of one's own: who meets whom where, what sets whom off, and what is refused."""

import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from sim.catalog.load import load_scenario
from sim.encounters import encounter_of
from sim.encounters.types import HIT_S
from sim.errors import ScenarioError
from sim.scenario import Scenario
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from tests.paths import ROOT


def example() -> str:
    """TOML of the documentation."""
    text = (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8")
    found = [block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if 'kind = "own"' in block]
    assert len(found) == 1
    return str(found[0])


def changed(tmp_path: Path, *changes: tuple[str, str]) -> Scenario:
    """Load the example with some lines replaced."""
    text = example()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scenario.toml").write_text(text, encoding="utf-8")
    return load_scenario(tmp_path)


def test_both_reach_the_conflict_point_at_the_same_time_and_touch_first(tmp_path: Path) -> None:
    scenario = changed(tmp_path)
    for seed in (0, 1, 2):
        layout = encounter_of(scenario, seed).layout
        ego, conflict = layout.actors[:2]
        places = [one.path.at(float(one.place(HIT_S)))[0][:2] for one in (ego, conflict)]
        assert np.hypot(*(places[0] - layout.focus)) < 0.5
        assert np.hypot(*(places[1] - layout.focus)) < 0.15 * 6.0 + 0.5  # jitter
        assert conflict.kind.label == "bicycle"
        with ScriptedTraffic(scenario, seed) as traffic:
            while not traffic.crashes and traffic.time_s < 8.0:
                traffic.step()
        time_s, *names = traffic.crashes[0]
        assert set(names) == {"ego", "conflict"} and HIT_S - 1.0 < time_s < HIT_S + 0.5


def test_parameters_of_its_tables_are_drawn_within_their_ranges(tmp_path: Path) -> None:
    drawn = [encounter_of(changed(tmp_path), seed).parameters["placed[0].at_m"] for seed in range(4)]
    given = tomllib.loads(example())["conflict"]["placed"][0]["at_m"]
    assert all(given[0] <= value <= given[1] for value in drawn) and len(set(drawn)) == 4


def test_controls_take_away_what_they_say(tmp_path: Path) -> None:
    changed(tmp_path)
    names = {
        control: {one.name for one in encounter_of(load_scenario(f"{tmp_path}:{control}"), 0).layout.actors}
        for control in ("no_occluder", "no_conflict", "ghost")
    }
    whole = {one.name for one in encounter_of(load_scenario(tmp_path), 0).layout.actors}
    assert {name for name in whole if name.startswith("truck")} == whole - names["no_occluder"] != set()
    assert names["no_conflict"] == names["ghost"] == whole - {"conflict"}


def first_move_s(traffic: ScriptedTraffic, name: str, drive: Any = None) -> tuple[float, float]:
    """Return when a road user that stands first moves, and how far the ego is along its path then."""
    start = None
    while traffic.time_s < 9.0:
        row = traffic.actors.name.index(name)
        if start is None:
            start = traffic.actors.boxes.center[row].copy()
        if np.hypot(*(traffic.actors.boxes.center[row] - start)[:2]) > 0.01:
            return traffic.time_s, traffic._ego.at_m
        if drive is not None:
            traffic.command(FIRST_ID, drive)
        traffic.step()
    return float("inf"), traffic._ego.at_m


def test_the_place_of_the_ego_sets_off_whom_it_triggers_however_it_is_driven(tmp_path: Path) -> None:
    scenario = changed(tmp_path)
    ego = encounter_of(scenario, 0).layout.actors[0]
    place = float(ego.place(HIT_S)) - 40.0
    with ScriptedTraffic(scenario, 0) as traffic:
        scripted_s, at_m = first_move_s(traffic, "car_1")
    assert place <= at_m < place + 4.0
    with ScriptedTraffic(scenario, 0) as traffic:
        driven_s, at_m = first_move_s(traffic, "car_1", drive=6.0)
    assert place <= at_m < place + 4.0 and driven_s > scripted_s + 0.5


def test_a_time_sets_off_the_conflict_actor_who_still_arrives_with_the_ego(tmp_path: Path) -> None:
    starts = 'road_user = "bicycle"\nstarts = { at_s = 2.0 }'
    scenario = changed(tmp_path, ('road_user = "bicycle"', starts))
    with ScriptedTraffic(scenario, 0) as traffic:
        moves_s, _ = first_move_s(traffic, "conflict")
        assert 2.0 < moves_s < 2.4
        while not traffic.crashes and traffic.time_s < 8.0:
            traffic.step()
    assert set(traffic.crashes[0][1:]) == {"ego", "conflict"}


def test_without_a_street_a_pedestrian_waits_at_the_kerb_and_crosses_the_ego_s(tmp_path: Path) -> None:
    lines = (
        ('conflict = ["left1A1", "A1B1"]\n', ""),
        ('road_user = "bicycle"\n', ""),
        ("[4.0, 6.0]", "1.8\ncross_m = -40"),
    )
    scenario = changed(tmp_path, *lines, ('street = "conflict"', 'street = "ego"'), ("at_m = -40.0", "at_m = 30.0"))
    ego, conflict = encounter_of(scenario, 0).layout.actors[:2]
    assert conflict.kind.label == "pedestrian"
    at_m = ego.path.nearest(conflict.path.at(float(conflict.place(HIT_S)))[0][:2])
    place, heading, _ = ego.path.at(at_m)
    away = conflict.path.at(float(conflict.place(0.0)))[0][:2] - place[:2]
    left = float(away @ [-np.sin(heading), np.cos(heading)])
    assert -6.1 < left < -3.9  # on the right, where the kerb is
    assert float(conflict.place(0.0)) == pytest.approx(float(conflict.place(0.5)))  # it waits


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([('"A1top0_0"]', '"A1top9_0"]')], "conflict.streets.ego: expected lanes of the network, found 'A1top9_0'"),
        ([('["left1A1", "A1B1"]', '["right1B1", "B1top1"]')], "conflict.streets.conflict: expected a way that meets"),
        ([("at_m = [-9.0, -7.0]", "at_m = [-7.0, -9.0]")], r"conflict.placed\[0\].at_m: expected -300 to 300"),
        ([('kind = "truck"\n', 'kind = "truck"\nleft_m = -3.2\n')], "expected a place off the way of the ego"),
        (
            [('kind = "truck"\n', 'kind = "hedge"\n'), ("count = 4\n", ""), ('roles = ["occluder", "helper"]', "")],
            "expected a place beside the lanes, found on A0A1_1",
        ),
        ([("{ ego_before_m = 40.0 }", "{ ego_before_m = 40.0, at_s = 2.0 }")], "expected one of ego_before_m, at_s"),
        ([('street = "next"', 'street = "nxt"')], r"conflict.placed\[0\].street: expected one of conflict.streets"),
        ([("conflict_mps = [4.0, 6.0]", "conflict_mps = 30.0")], "m of road before the conflict point, found"),
        ([('kind = "own"', 'kind = "lta_truck"')], "conflict.streets: expected the lanes of ego, conflict, truck"),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path: Path, changes: list[tuple[str, str]], said: str) -> None:
    with pytest.raises(ScenarioError, match=said) as raised:
        encounter_of(changed(tmp_path, *changes), 0)
    assert "\n" not in str(raised.value)


def test_a_shipped_encounter_says_nothing_of_own_tables_among_its_settings() -> None:
    conflict = load_scenario("lta_truck").conflict
    written = msgspec.to_builtins(conflict)
    assert {"road_user", "starts", "placed"} & written.keys() == set() and written["kind"] == "lta_truck"
