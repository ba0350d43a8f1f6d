"""Networks: shipped ones are found, made ones depend on options and seed only."""

from pathlib import Path

import msgspec
import pytest
from shapely.geometry import LineString, Point

from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from sim.roads.networks import read_network, resolve_network
from sim.scenario import NetworkSpec, Scenario

SQUARE = {"rand": True, "rand.iterations": 12}


def with_network(**fields: object) -> Scenario:
    return msgspec.structs.replace(load_scenario("four_way"), network=NetworkSpec(**fields))


def test_one_seed_makes_the_same_bytes_and_another_makes_another_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario, made = with_network(generate=SQUARE), []
    for run, seed in enumerate((7, 7, 8)):
        monkeypatch.setenv("DSRC_CACHE", str(tmp_path / f"cache{run}"))
        made.append(resolve_network(scenario, seed).read_bytes())
    assert made[0] == made[1]
    assert made[0] != made[2]
    assert b"<!--" not in made[0]


def test_a_made_network_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    path = resolve_network(with_network(generate=SQUARE), 1)
    changed = path.stat().st_mtime_ns
    assert resolve_network(with_network(generate=SQUARE), 1) == path
    assert path.stat().st_mtime_ns == changed
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_wrong_option_of_netgenerate_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    with pytest.raises(ScenarioError, match=r"four_way: network.generate: netgenerate refuses .*grid.numbr"):
        resolve_network(with_network(generate={"grid": True, "grid.numbr": 2}), 0)


def test_a_seed_of_any_size_makes_a_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    assert resolve_network(with_network(generate=SQUARE), 2**31 + 7) == resolve_network(
        with_network(generate=SQUARE), 7
    )


def test_a_file_that_is_no_network_is_told(tmp_path: Path) -> None:
    path = tmp_path / "bad.net.xml"
    path.write_text("<net><edge")
    with pytest.raises(ScenarioError, match=r"bad\.net\.xml: not a readable SUMO network"):
        read_network(path)
    path.write_text('<net version="1.20"></net>')
    with pytest.raises(ScenarioError, match="at least one edge"):
        read_network(path)


@pytest.mark.parametrize("name", ["braunschweig", "four_way", "ingolstadt"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_roadside_units_stand_near_a_road_and_not_on_it(name: str, seed: int) -> None:
    scenario = load_scenario(name)
    net = read_network(resolve_network(scenario, seed))
    lanes = [lane for edge in net.getEdges() for lane in edge.getLanes() if lane.allows("passenger")]
    assert scenario.agents.roadside
    for unit in scenario.agents.roadside:
        place = Point(unit.xyz_m[:2])
        gaps = [LineString([p[:2] for p in k.getShape()]).distance(place) - 0.5 * k.getWidth() for k in lanes]
        assert 1.5 < min(gaps) < 15.0
        assert 4.0 <= unit.xyz_m[2] <= 6.0


@pytest.mark.parametrize(
    "option", ["save-configuration", "message-log", "plain-output-prefix", "junctions.join-output"]
)
def test_a_scenario_cannot_have_files_written(tmp_path: Path, option: str) -> None:
    (tmp_path / "precious").write_text("mine")
    scenario = with_network(generate={**SQUARE, option: str(tmp_path / "precious")})
    with pytest.raises(ScenarioError, match=rf"network.generate: expected options of netgenerate .* found {option}$"):
        resolve_network(scenario, 1)
    assert (tmp_path / "precious").read_text() == "mine"
