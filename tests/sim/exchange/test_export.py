"""Exported scenarios: valid by the standards, and the seed's traffic when they are played by the standard's rules."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from sim.catalog.load import load_scenario
from sim.encounters import network_file
from sim.exchange.export import export
from sim.roads.networks import read_network
from sim.roads.opendrive import OpenDrive
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.open import open_traffic
from sim.traffic.tracks.base import to_log
from sim.traffic.tracks.open import read_tracks

SEED = 0


@pytest.fixture(scope="module", params=["lta_truck", "ped_bus_stop"])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scenario, Path, Path]:
    scenario = load_scenario(request.param)
    story, roads = export(scenario, SEED, tmp_path_factory.mktemp("out"))
    return scenario, story, roads


def traffic_of(scenario: Scenario) -> list[Actors]:
    with open_traffic(scenario, SEED) as traffic:
        return [traffic.actors, *(traffic.step() for _ in range(round(scenario.duration_s / traffic.step_s)))]


def played(story: Path, time_s: float) -> dict[str, np.ndarray]:
    """Return middle and heading of every box at a time, by the rules of the standard alone.

    Trajectories are interpolated linearly between vertices, headings by the shortest arc; the box has its centre in the
    axes of the reference point.
    """
    root = ET.parse(story).getroot()
    places: dict[str, np.ndarray] = {}
    for private in root.findall("Storyboard/Init/Actions/Private"):
        world = private.find("PrivateAction/TeleportAction/Position/WorldPosition")
        assert world is not None
        places[private.attrib["entityRef"]] = np.array([float(world.attrib[key]) for key in "xyzh"])
    for group in root.iter("ManeuverGroup"):
        name = group.findall("Actors/EntityRef")[0].attrib["entityRef"]
        vertices = list(group.iter("Vertex"))
        if vertices:
            times = [float(one.attrib["time"]) for one in vertices]
            worlds = [one.findall("Position/WorldPosition")[0].attrib for one in vertices]
            rows = np.array([[float(one[key]) for key in "xyzh"] for one in worlds])
            rows[:, 3] = np.unwrap(rows[:, 3])
            places[name] = np.array([np.interp(time_s, times, column) for column in rows.T])
    for one in root.iter("ScenarioObject"):
        center = one.findall("./*/BoundingBox/Center")[0].attrib
        x, y, z, h = places[one.attrib["name"]]
        ahead, left, up = (float(center[key]) for key in "xyz")
        middle = [x + np.cos(h) * ahead - np.sin(h) * left, y + np.sin(h) * ahead + np.cos(h) * left, z + up]
        places[one.attrib["name"]] = np.array([*middle, h])
    return places


def test_the_boxes_are_where_the_traffic_is(exported: tuple[Scenario, Path, Path]) -> None:
    scenario, story, _ = exported
    steps = traffic_of(scenario)
    moved = 0.0
    for actors in steps[:: len(steps) // 8]:
        places = played(story, actors.time_s - steps[0].time_s)
        for row, name in enumerate(actors.name):
            np.testing.assert_allclose(places[name][:3], actors.boxes.center[row], atol=1e-4)
            turn = places[name][3] - actors.boxes.yaw[row]
            assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-4
            moved = max(moved, float(np.hypot(*actors.velocity[row])))
    assert moved > 1.0


def test_it_comes_back_as_tracks(exported: tuple[Scenario, Path, Path]) -> None:
    scenario, story, _ = exported
    steps = traffic_of(scenario)
    (recording,) = read_tracks(story)
    log = to_log(story, recording)
    assert len(log) == len(steps)
    assert len(recording.lanes) > 0
    for k in range(0, len(steps), 10):
        for row, name in enumerate(steps[k].name):
            found = log[k].boxes.center[log[k].name.index(name)]
            np.testing.assert_allclose(found, steps[k].boxes.center[row], atol=0.01)


def test_the_roads_are_those_of_the_network(exported: tuple[Scenario, Path, Path]) -> None:
    scenario, _, roads = exported
    drive = OpenDrive(roads)
    outside = 0
    lanes = [
        lane
        for edge in read_network(network_file(scenario, SEED)).getEdges(withInternal=False)
        for lane in edge.getLanes()
        if lane.allows("passenger")
    ]
    for lane in lanes:
        line = np.array(lane.getShape())
        place = drive.nearest(*(0.5 * (line[0] + line[1])).tolist())
        outside += place is None or abs(place.offset) > 0.1
    assert len(lanes) > 1
    assert outside == 0


def test_the_same_seed_writes_the_same_bytes(exported: tuple[Scenario, Path, Path], tmp_path: Path) -> None:
    scenario, story, roads = exported
    again = export(scenario, SEED, tmp_path)
    assert [path.read_bytes() for path in again] == [story.read_bytes(), roads.read_bytes()]


def test_both_files_are_valid_by_the_standards_schemas(exported: tuple[Scenario, Path, Path]) -> None:
    scenariogeneration = pytest.importorskip("scenariogeneration")
    xmlschema = pytest.importorskip("xmlschema")
    from scenariogeneration import xosc

    schemas = Path(scenariogeneration.__file__).parents[1] / "schemas"
    scenario, story, roads = exported
    xmlschema.XMLSchema(str(schemas / "OpenSCENARIO_1_1.xsd")).validate(str(story))
    xmlschema.XMLSchema(str(schemas / "opendrive_17_core.xsd")).validate(str(roads))
    parsed = xosc.ParseOpenScenario(str(story))
    assert len(parsed.entities.scenario_objects) == len(traffic_of(scenario)[0])
