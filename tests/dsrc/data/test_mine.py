"""Encounters mined from a small map: hidden by rays, the same for the same seed, driven by whoever sees everybody."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import dsrc
from dsrc.closed_loop.campaign.read import read_campaign
from dsrc.data.mine import TABLE, mine
from sensors.recording.encounter_check import CONFLICT_ID, EGO_ID, last_chance, prove_encounter, roll_out
from sensors.recording.mining import PROVEN, Finding, judge
from sensors.recording.static_scene import static_scene
from sensors.scan.line_of_sight import seen_share
from sim.catalog.conflicts import find_conflicts, scenario_text
from sim.catalog.load import load_scenario, scenarios_in
from sim.encounters import with_encounter
from sim.errors import ScenarioError, SettingsError
from sim.roads.networks import read_network, resolve_network
from sim.scenario import AgentRule, NetworkSpec, Scenario

GRID: dict[str, Any] = {"grid": True, "grid.number": 2, "grid.length": 150.0, "grid.attach-length": 150.0}


def place(**generate: Any) -> Scenario:
    network = NetworkSpec(generate={**GRID, "default.lanenumber": 2, **generate})
    return Scenario(name="grid", description="", network=network, agents=AgentRule(lidar="vlp-16"))


@pytest.fixture(scope="module", autouse=True)
def one_place_at_once() -> Iterator[None]:
    """The first places prove enough."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsrc.data.mine._BATCH", 1)
        yield


@pytest.fixture(scope="module")
def mined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Finding]]:
    out = tmp_path_factory.mktemp("mined")
    return out, mine(place(), out, count=1)


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_mined_encounter_is_a_scenario_whose_road_user_is_hidden_by_rays(mined: tuple[Path, list[Finding]]) -> None:
    out, findings = mined
    kept = next(one for one in findings if one.verdict == PROVEN)
    assert kept.scenario is not None and kept.hidden_s is not None and kept.hidden_s > 1.0 and kept.helper
    (path,) = scenarios_in(str(out))
    scenario = load_scenario(path)
    assert scenario == kept.scenario
    proof = prove_encounter(scenario, scenario.seed)
    assert proof.holds and proof.helper == kept.helper
    whole = with_encounter(scenario, scenario.seed)
    drive = roll_out(whole, scenario.seed)
    _, _, limit = last_chance(drive, scenario.step_s)
    now = drive.steps[limit]
    eye = now.boxes.center[now.row(EGO_ID)] + np.array([0.0, 0.0, 1.2])
    share = seen_share(
        static_scene(whole, scenario.seed), now.boxes, eye[None], [EGO_ID], np.array([now.row(CONFLICT_ID)])
    )
    assert share[0, 0] < 0.5


def test_the_same_seed_gives_the_same_files_and_an_edited_one_stays(
    mined: tuple[Path, list[Finding]], tmp_path: Path
) -> None:
    out, findings = mined
    assert mine(place(), tmp_path, count=1) == findings
    assert files(tmp_path) == files(out) and TABLE in files(out)
    (path,) = scenarios_in(str(tmp_path))
    toml = Path(path) / "scenario.toml"
    toml.write_text(toml.read_text(encoding="utf-8") + "# mine\n", encoding="utf-8")
    mine(place(), tmp_path, count=1)
    assert toml.read_text(encoding="utf-8").endswith("# mine\n")


def test_who_sees_everybody_arrives_and_no_control_crashes(mined: tuple[Path, list[Finding]]) -> None:
    (path,) = scenarios_in(str(mined[0]))
    for name in (path, f"{path}:no_occluder", f"{path}:no_conflict"):
        outcome = dsrc.ClosedLoop(name, dsrc.open_perception("truth")).run(seed=0)
        assert outcome == "arrived", name


@pytest.mark.slow
def test_who_crosses_a_slow_street_behind_parked_vans_is_hidden_until_braking_is_too_late() -> None:
    base = place(**{"default.lanenumber": 1, "default.speed": 8.3})
    places = find_conflicts(base, read_network(resolve_network(base, 0)), 0)
    streets = [row for row in places if row[0].kind == "pedestrian"]
    assert judge(streets[0], base, 0)[0].verdict == PROVEN


def test_a_plan_takes_a_folder_of_scenarios_and_their_variants(
    mined: tuple[Path, list[Finding]], tmp_path: Path
) -> None:
    out, _ = mined
    plan = tmp_path / "plan.toml"
    text = f'name = "mined"\nscenarios = ["{out}", "{out}:no_conflict"]\nclean_seeds = 1\n'
    plan.write_text(text + '[[perceptions]]\nname = "truth"\nuses = "truth"\n', encoding="utf-8")
    (path,) = scenarios_in(str(out))
    assert read_campaign(plan).scenarios == (path, f"{path}:no_conflict")


def test_the_text_of_a_scenario_is_the_scenario(tmp_path: Path) -> None:
    for name in ("braunschweig", "braunschweig_lta_truck", "helsinki"):
        scenario = load_scenario(name)
        (tmp_path / "scenario.toml").write_text(scenario_text(scenario), encoding="utf-8")
        assert load_scenario(tmp_path) == scenario


def test_a_map_without_conflicts_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "road.net.xml").write_text(
        '<net version="1.20"><location netOffset="0,0" convBoundary="0,0,90,0" origBoundary="0,0,90,0" '
        'projParameter="!"/><edge id="a" from="m" to="n" priority="1"><lane id="a_0" index="0" speed="30" '
        'length="90" shape="0,0 90,0"/></edge><junction id="m" type="dead_end" x="0" y="0" incLanes="" intLanes="" '
        'shape="0,0"/><junction id="n" type="dead_end" x="90" y="0" incLanes="a_0" intLanes="" shape="90,0"/></net>',
        encoding="utf-8",
    )
    network = NetworkSpec(file=str(tmp_path / "road.net.xml"), round=False)
    road = msgspec.structs.replace(place(), name="road", network=network)
    with pytest.raises(ScenarioError, match=r"road: network: expected roads that cross or merge.*found none"):
        mine(road, tmp_path / "out")
    with pytest.raises(SettingsError, match="count: expected at least 1, found 0"):
        mine(road, tmp_path / "out", count=0)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "road.net.xml").write_text("<net/>", encoding="utf-8")
    with pytest.raises(SettingsError, match=r"other/road\.net\.xml: file: expected that of .*, found another"):
        mine(road, tmp_path / "other")
    with pytest.raises(ScenarioError, match="lta_truck: network: expected a map"):
        mine(load_scenario("lta_truck"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
