"""Encounters: every kind is laid out on its lanes, draws are reproducible, controls take away what they say."""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import shapely

from sim.catalog.load import list_scenarios, load_scenario
from sim.collisions import overlapping_pairs
from sim.encounters import ENCOUNTERS, encounter_of, network_file, with_encounter
from sim.encounters.following import closing_s
from sim.encounters.lane_paths import LanePath, lane_paths_of
from sim.encounters.paths import PathBuilder, ReferencePath, SpeedProfile
from sim.errors import ScenarioError
from sim.roads.networks import read_network, resolve_network
from sim.scenario import AgentRule, EncounterSpec, Scenario
from sim.world.roads.streets import read_streets
from tests.paths import ROOT


def encounter(kind: str, **conflict: Any) -> Scenario:
    spec = EncounterSpec(kind=kind, **conflict)
    return Scenario(name=kind, description="", agents=AgentRule(), conflict=spec, warmup_s=0.0, duration_s=12.0)


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_a_shipped_scenario_of_its_name_has_each_encounter(kind: str) -> None:
    assert kind in list_scenarios()
    scenario = load_scenario(kind)
    assert scenario.conflict is not None and scenario.conflict.kind == kind
    assert scenario.warmup_s == 0.0 and scenario.description


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_parameters_are_drawn_within_their_ranges_and_from_streams_of_their_own(kind: str) -> None:
    drawn = encounter_of(encounter(kind), 7).parameters
    for parameter in ENCOUNTERS[kind].parameters:
        assert parameter.low <= parameter.draw[0] <= drawn[parameter.name] <= parameter.draw[1] <= parameter.high
        if parameter.whole:
            assert drawn[parameter.name] == round(drawn[parameter.name])
    fixed = ENCOUNTERS[kind].parameters[0]
    value = fixed.low if not math.isclose(drawn[fixed.name], fixed.low) else fixed.high
    others = encounter_of(encounter(kind, parameters={fixed.name: value}), 7).parameters
    assert others == drawn | {fixed.name: value}
    assert encounter_of(encounter(kind, draw=1), 7).parameters != drawn


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_equal_seeds_lay_out_the_same_and_bodies_do_not_overlap_at_the_start(kind: str) -> None:
    from sim.traffic.script import ScriptedTraffic

    first, second = (ScriptedTraffic(encounter(kind), 3).actors for _ in range(2))
    assert first.name == second.name and first.model == second.model
    assert first.boxes.array.tobytes() == second.boxes.array.tobytes()
    assert first.name[:2] == ("ego", "conflict")
    assert len(overlapping_pairs(first.boxes)) == 0


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_motor_vehicles_stay_on_the_road_and_nothing_stands_in_their_way(kind: str) -> None:
    scenario = with_encounter(encounter(kind), 3)
    layout = encounter_of(scenario, 3).layout
    streets = read_streets(read_network(network_file(scenario, 3)), scenario.network.area_m, 60.0)
    window = shapely.box(*streets.window)
    solid = shapely.union_all([structure.outline for structure in layout.structures])
    assert (solid & streets.road).area < 0.01
    for someone in layout.actors:
        if someone.kind.label in ("pedestrian", "bicycle"):
            continue
        start = max(someone.start_m, 0.0)
        end = min(float(someone.place(8.0)), someone.path.length)
        at = np.arange(start, max(end, start + 0.5), 1.0)
        places = shapely.points(someone.path.at(at)[0][:, :2])
        inside = places[shapely.contains(window, places)]
        assert shapely.dwithin(streets.road, inside, 0.3).all(), someone.name
        assert not shapely.dwithin(solid, inside, 0.5 * someone.kind.size[1]).any(), someone.name


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_the_documents_tell_its_parameters_and_show_it(kind: str) -> None:
    docs = ROOT / "docs"
    text = (docs / "scenarios.md").read_text()
    section = text.split(f"### `{kind}`")[1].split("### `")[0]
    for parameter in ENCOUNTERS[kind].parameters:
        low, high = parameter.draw
        assert f"| `{parameter.name}` | {low:g} to {high:g} | {parameter.low:g} to {parameter.high:g} |" in section
    for view in ("above", "ego"):
        picture = f"pictures/scenarios/{kind}_{view}.png"
        assert f"]({picture})" in section
        assert 0 < (docs / picture).stat().st_size <= 150_000


def test_controls_take_away_what_they_say() -> None:
    plain = encounter_of(encounter("ped_bus_stop"), 1)
    assert plain.names("conflict") == ("conflict",) and not plain.ghosts
    free = encounter_of(encounter("ped_bus_stop", control="no_occluder"), 1)
    assert not free.names("occluder") and free.names("conflict")
    alone = encounter_of(encounter("ped_bus_stop", control="no_conflict"), 1)
    assert not alone.names("conflict") and alone.names("occluder")
    ghost = encounter_of(encounter("ped_bus_stop", control="ghost"), 1)
    assert not ghost.names("conflict")
    assert [(one.actor.name, one.claimed_by) for one in ghost.ghosts] == [("ghost", "bus")]
    assert ghost.parameters == plain.parameters == free.parameters == alone.parameters


def test_the_agents_are_the_ego_and_its_helpers() -> None:
    scenario = with_encounter(encounter("lta_truck"), 1)
    assert scenario.agents.named == ("ego", "truck", "follower")
    assert len(scenario.agents.roadside) == 1
    assert scenario.network.area_m is not None


MISTAKES = {
    "kind": ({"kind": "ima_bulding"}, ["conflict.kind", "found ima_bulding", "did you mean 'ima_building'?"]),
    "parameter": (
        {"kind": "ima_building", "parameters": {"ego_mp": 9.0}},
        ["conflict.parameters", "parameters of ima_building", "'ego_mp'", "did you mean 'ego_mps'?"],
    ),
    "too fast": (
        {"kind": "ima_building", "parameters": {"ego_mps": 40.0}},
        ["conflict.parameters.ego_mps", "8 to 17", "found 40"],
    ),
    "upside down": (
        {"kind": "ima_building", "parameters": {"ego_mps": [12.0, 9.0]}},
        ["conflict.parameters.ego_mps", "[low, high]", "[12.0, 9.0]"],
    ),
    "half a car": (
        {"kind": "ima_queue", "parameters": {"queue": 2.5}},
        ["conflict.parameters.queue", "whole numbers", "2.5"],
    ),
    "control": ({"kind": "ima_building", "control": "no_oclcuder"}, ["conflict.control", "no_oclcuder"]),
    "who drives": ({"kind": "ima_building"}, ["agents.vehicles", "none, as its encounter names them", "found 1"]),
    "no kind": ({}, ["conflict.kind", "a value", "nothing"]),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_told_in_one_line_with_file_field_and_finding(case: str, tmp_path: Path) -> None:
    table, words = MISTAKES[case]
    lines = ['name = "mine"', 'description = ""', "[agents]", "vehicles = 1", "[conflict]"]
    lines += [f"{key} = {value!r}" for key, value in table.items() if key != "parameters"]
    lines += ["[conflict.parameters]"] + [f"{key} = {value}" for key, value in table.get("parameters", {}).items()]
    path = tmp_path / "scenario.toml"
    path.write_text("\n".join(lines))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert "\n" not in message and message.startswith(str(path))
    for word in words:
        assert word in message


ON_A_MAP = """
name = "mine"
description = ""
[network]
shipped = "game/bs3d/bs.net.xml"
[conflict]
kind = "lta_truck"
[conflict.streets]
ego = ["166445412_1", "23204862_1"]
conflict = ["166445407_0", "30425847#0_0"]
truck = ["166445407_1", "29136063#0_1"]
[agents]
"""

STREET_MISTAKES = {
    "not on maps": ("lta_truck", "ped_bus_stop", ["network", "none for ped_bus_stop", "red_light_runner, lta_truck"]),
    "no way of the truck": ("truck =", "lorry =", ["conflict.streets", "ego, conflict, truck", "lorry"]),
    "no network": ('[network]\nshipped = "game/bs3d/bs.net.xml"', "", ["conflict.streets", "none without a network"]),
    "no such lane": ("166445407_1", "166445407_7", ["conflict.streets.truck", "lanes of the network", "'166445407_"]),
    "not connected": ("29136063#0_1", "23207363#0_0", ["conflict.streets.truck", "166445407_1 leads to"]),
}


@pytest.mark.parametrize("case", STREET_MISTAKES)
def test_wrong_streets_are_told_in_one_line(case: str, tmp_path: Path) -> None:
    old, new, words = STREET_MISTAKES[case]
    assert old in ON_A_MAP
    path = tmp_path / "scenario.toml"
    path.write_text(ON_A_MAP.replace(old, new, 1))
    with pytest.raises(ScenarioError) as caught:
        encounter_of(load_scenario(path), 1)
    for word in words:
        assert word in str(caught.value)


def test_paths_on_a_map_follow_its_lanes(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(ON_A_MAP)
    scenario = load_scenario(path)
    net = read_network(resolve_network(scenario, 1))
    for street in lane_paths_of("mine", net, scenario.conflict.streets).values():
        assert street.stop_m > 100.0 and street.path.length > 300.0
        assert np.abs(np.gradient(street.path.heading, street.path.along)).max() < 0.15
    ego = encounter_of(scenario, 1).layout.actors[0]
    stop = net.getLane("166445412_1").getShape()[-1]
    place, _, _ = ego.path.at(ego.path.nearest(stop))
    np.testing.assert_allclose(place[:2], stop, atol=0.3)


def test_a_scenario_without_network_and_without_conflict_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text('name = "mine"\ndescription = ""\n[agents]\nvehicles = 1\n')
    with pytest.raises(ScenarioError, match="network: expected exactly one of"):
        load_scenario(path)


def test_an_encounter_survives_a_round_trip_through_a_file() -> None:
    scenario = encounter("ima_queue", parameters={"ego_mps": (12.0, 13.0), "queue": 3.0}, control="ghost", draw=4)
    assert msgspec.convert(msgspec.to_builtins(scenario), Scenario) == scenario
    assert msgspec.json.decode(msgspec.json.encode(scenario), type=Scenario) == scenario


def test_a_path_turns_smoothly_and_ends_where_it_was_drawn() -> None:
    path = PathBuilder(0.0, 0.0).straight(30.0).turn(8.0, 0.5 * math.pi).straight(20.0).path()
    np.testing.assert_allclose(path.points[0, :2], [0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(path.points[-1, :2], [38.0, 28.0], atol=0.02)
    assert path.length == pytest.approx(50.0 + 4.0 * math.pi, rel=5e-3)
    curvature = np.gradient(path.heading, path.along)
    assert curvature.max() < 1.1 / 8.0
    assert np.abs(np.diff(curvature)).max() < 0.4 / 8.0
    place, heading, _ = path.at(path.length)
    assert heading == pytest.approx(0.5 * math.pi, abs=1e-3)
    assert path.nearest(place[:2]) == pytest.approx(path.length)


def test_a_lane_change_moves_aside_and_keeps_the_heading() -> None:
    path = PathBuilder(0.0, 0.0).straight(10.0).shift(-3.5, 40.0).straight(10.0).path()
    np.testing.assert_allclose(path.points[-1, :2], [60.0, -3.5], atol=0.02)
    assert path.heading[-1] == pytest.approx(0.0, abs=1e-3)
    assert path.heading.min() == pytest.approx(math.atan2(-3.5 * 1.875, 40.0), abs=0.02)


def test_a_path_through_slopes_pitches() -> None:
    path = ReferencePath.through([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [100.0, 0.0, 5.0]])
    assert path.at(20.0)[2] == pytest.approx(0.0, abs=1e-6)
    assert path.at(90.0)[2] == pytest.approx(-math.atan(0.1), abs=1e-3)


def test_the_distance_of_a_speed_profile_is_the_integral_of_its_speed() -> None:
    pace = SpeedProfile.change(10.0, 4.0, 2.0, 3.0)
    np.testing.assert_allclose(pace.at([0.0, 2.0, 3.0, 4.0, 9.0]), [10.0, 10.0, 7.0, 4.0, 4.0])
    np.testing.assert_allclose(pace.distance([-1.0, 0.0, 2.0, 4.0, 5.0]), [-10.0, 0.0, 20.0, 34.0, 38.0])
    assert SpeedProfile.steady(3.0).distance(4.0) == pytest.approx(12.0)


@pytest.mark.parametrize(("gap_m", "brakes_mps2"), [(60.0, 6.0), (20.0, 4.0), (9.0, 8.0)])
def test_the_crash_of_the_chain_comes_when_the_gap_to_the_braking_car_is_used_up(
    gap_m: float, brakes_mps2: float
) -> None:
    """A follower at constant speed and a leader that brakes to a standstill, step by step."""
    speed, step_s = 16.0, 1e-4
    time_s = np.arange(0.0, 30.0, step_s)
    braked_s = np.minimum(time_s, speed / brakes_mps2)
    left_m = gap_m + speed * braked_s - 0.5 * brakes_mps2 * braked_s**2 - speed * time_s
    assert closing_s(gap_m, speed, brakes_mps2) == pytest.approx(time_s[left_m <= 0.0][0], abs=2 * step_s)


@pytest.mark.parametrize("kind", ["lta_truck", "red_light_runner"])
def test_an_encounter_on_a_left_driving_map_mirrors_that_on_a_right_driving_one(kind: str) -> None:
    """Approaches from south, north and east, lanes of 3.5 m; lights are SUMO's bits: 1 right, 2 left."""
    lines = {
        "ego": [(1.75, -90), (1.75, -6), (-6, 1.75), (-90, 1.75)],
        "oncoming": [(-5.25, 90), (-5.25, -90)],
        "truck": [(-1.75, 90), (-1.75, 6), (6, -1.75), (90, -1.75)],
        "crossing": [(90, 5.25), (-90, 5.25)],
        "mate": [(5.25, -90), (5.25, 90)],
    }
    conflict = "oncoming" if kind == "lta_truck" else "crossing"
    named = {"ego": "ego", "conflict": conflict, "truck": "truck", "mate": "mate", "opposite": "oncoming"}
    drawn = encounter_of(encounter(kind), 3).parameters
    layouts = []
    for x_sign in (1.0, -1.0):
        streets = {
            role: LanePath(ReferencePath.through(np.array(lines[name]) * [x_sign, 1.0]), 80.0, -x_sign)
            for role, name in named.items()
        }
        on_streets = ENCOUNTERS[kind].on_streets
        assert on_streets is not None
        layouts.append(on_streets(drawn, np.random.default_rng(1), streets).actors)
    right, left = layouts
    mirrored = {1: 2, 2: 1}
    assert len(right) == len(left) > 3
    for one, other in zip(right, left, strict=True):
        assert (one.name, one.type_name, one.size) == (other.name, other.type_name, other.size)
        assert np.allclose(one.path.points * [-1.0, 1.0, 1.0], other.path.points, atol=1e-6)
        assert one.start_m == pytest.approx(other.start_m)
        assert [(mirrored[bits], *times) for bits, *times in one.lights] == [tuple(light) for light in other.lights]
