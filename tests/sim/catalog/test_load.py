"""Scenario files: what ships loads, and every mistake gets one line that says what and where."""

from pathlib import Path

import msgspec
import pytest

from sim.catalog.load import list_scenarios, load_scenario
from sim.errors import ScenarioError

GOOD = """
name = "mine"
description = "A test."
[network]
shipped = "game/bs3d/bs.net.xml"
area_m = [471.0, 439.0, 871.0, 839.0]
[demand]
vehicles_per_hour = 100
[agents]
vehicles = 2
[[agents.roadside]]
xyz_m = [690.0, 627.0, 5.0]
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["braunschweig", "four_way", "highway", "ingolstadt", "koenigs_wusterhausen"])
def test_shipped_scenario_loads_under_its_own_name(name: str) -> None:
    assert name in list_scenarios()
    scenario = load_scenario(name)
    assert scenario.name == name and scenario.description
    assert scenario.agents.vehicles >= 3


def test_a_file_of_the_users_loads_by_path_and_by_folder(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    assert load_scenario(path) == load_scenario(tmp_path)
    assert load_scenario(path).demand.vehicles_per_hour == 100.0


def test_a_network_file_is_looked_up_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "road.net.xml").write_text("<net/>")
    path = write(tmp_path, GOOD.replace('shipped = "game/bs3d/bs.net.xml"', 'file = "road.net.xml"'))
    assert Path(load_scenario(path).network.file) == (tmp_path / "road.net.xml").resolve()


def test_polygons_lie_beside_the_scenario_or_below_tools(tmp_path: Path) -> None:
    shipped = GOOD.replace("[demand]", 'polygons = "game/A10KW/osm.poly.xml"\n[demand]')
    assert load_scenario(write(tmp_path, shipped)).network.polygons == "game/A10KW/osm.poly.xml"
    (tmp_path / "town.poly.xml").write_text("<additional/>")
    own = load_scenario(write(tmp_path, shipped.replace("game/A10KW/osm.poly.xml", "town.poly.xml")))
    assert Path(own.network.polygons) == (tmp_path / "town.poly.xml").resolve()


# Each case: what is replaced in the good file, by what, and the words that the message must hold.
MISTAKES = {
    "unknown key": ("vehicles_per_hour", "vehicle_per_hour", ["demand", "'vehicle_per_hour'", "'vehicles_per_hour'?"]),
    "unknown table": ("[demand]", "[demands]", ["top level", "'demands'", "mean 'demand'?"]),
    "unknown nested key": ("xyz_m", "xyz", ["agents.roadside[0]", "'xyz'", "mean 'xyz_m'?"]),
    "wrong type": ("= 100", '= "many"', ["demand.vehicles_per_hour", "expected float", "found many"]),
    "wrong type in a list": ("[690.0, 627.0", '["x", 627.0', ["agents.roadside[0].xyz_m[0]", "expected float"]),
    "too short a list": ("[690.0, 627.0, 5.0]", "[690.0, 627.0]", ["agents.roadside[0].xyz_m", "length 3"]),
    "out of range": ("= 100", "= -1", ["demand.vehicles_per_hour", ">= 0", "found -1"]),
    "not finite": ("627.0", "inf", ["agents.roadside[0].xyz_m[1]", "finite", "found inf"]),
    "missing key": ('description = "A test."', "", ["description", "a value", "nothing"]),
    "missing network file": ("bs.net.xml", "bs.nett.xml", ["network.shipped", "'game/bs3d/bs.net.xml'?"]),
    "outside the package": ("game/bs3d/bs.net.xml", "../bin/netconvert", ["network.shipped", "below tools/"]),
    "missing polygons": (
        "[demand]",
        'polygons = "game/A10KW/osm.pol.xml"\n[demand]',
        ["network.polygons", "beside the scenario or below tools/", "'game/A10KW/osm.poly.xml'?"],
    ),
    "polygons outside": ("[demand]", 'polygons = "../bin/x"\n[demand]', ["network.polygons", "below tools/"]),
    "two sources of buildings": (
        "[demand]",
        'polygons = "game/A10KW/osm.poly.xml"\ncity_mesh = "game/bs3d/bs3.3ds"\n[demand]',
        ["network", "at most one of city_mesh, polygons"],
    ),
    "two networks": ("[network]", '[network]\nfile = "x.net.xml"', ["network", "exactly one of", "shipped, file"]),
    "empty area": ("[471.0, 439.0", "[900.0, 439.0", ["network.area_m", "x_min < x_max"]),
    "unknown class": ("= 100", "= 100\ntype_mix = {cars = 1.0}", ["demand.type_mix", "'cars'", "mean 'car'?"]),
    "sunken roadside unit": ("5.0]", "-5.0]", ["agents.roadside[0].xyz_m", "height above the ground"]),
    "unknown signal": ("[demand]", '[[network.signals]]\njunction = "J"\nphases = [[9.0, "GX"]]\n[demand]', ["'GX'"]),
    "states of two lengths": (
        "[demand]",
        '[[network.signals]]\njunction = "J"\nphases = [[9.0, "G"], [9.0, "rr"]]\n[demand]',
        ["network.signals[0].phases", "one length"],
    ),
    "not TOML": ("[demand]", "[demand", ["not a readable TOML file", "line"]),
    "name with a slash": ('"mine"', '"a/b"', ["name", "matching regex"]),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_told_in_one_line_with_file_field_and_finding(case: str, tmp_path: Path) -> None:
    old, new, words = MISTAKES[case]
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message, message


def test_an_unknown_name_suggests_the_nearest_scenario() -> None:
    with pytest.raises(ScenarioError, match="unknown scenario 'braunschweg'; did you mean 'braunschweig'"):
        load_scenario("braunschweg")


def test_a_missing_path_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no such file"):
        load_scenario(tmp_path / "nothing.toml")


def test_an_encounter_has_variants_by_name() -> None:
    plain, busy = load_scenario("lta_truck"), load_scenario("lta_truck:dense:no_occluder")
    assert plain.conflict is not None and busy.conflict is not None
    assert (busy.name, busy.conflict.traffic, busy.conflict.control) == (
        "lta_truck-dense-no_occluder",
        "dense",
        "no_occluder",
    )
    assert plain.conflict.traffic is msgspec.UNSET
    with pytest.raises(ScenarioError, match="did you mean 'dense'"):
        load_scenario("lta_truck:dence")
    with pytest.raises(ScenarioError, match="which is none"):
        load_scenario("four_way:dense")
    for twice in ("lta_truck:dense:light", "lta_truck:no_occluder:no_conflict"):
        with pytest.raises(ScenarioError, match="expected one, found"):
            load_scenario(twice)


def test_a_folder_without_a_scenario_is_told_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    for name in ("empty", str(tmp_path / "empty")):
        with pytest.raises(
            ScenarioError, match=r"empty: scenario: expected a folder with a scenario\.toml .*, found one"
        ):
            load_scenario(name)
