"""OpenDRIVE as others write it: every kind of map gives drives, with its side, heights and objects."""

import logging
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from sim.catalog.import_map import import_map
from sim.catalog.load import load_scenario
from sim.mesh.materials import material_index
from sim.roads.convert import convert_map
from sim.roads.network import Network
from sim.roads.networks import read_network
from sim.roads.polygons import read_outlines
from sim.world.build import build_world
from sim.world.furniture.map_objects import read_map_objects

maps = pytest.importorskip("tests.sim.catalog.opendrive_maps", reason="needs scenariogeneration")


def converted(source: Path, folder: Path) -> Network:
    folder.mkdir()
    return read_network(convert_map(source, folder).net)


@pytest.mark.parametrize("kind", ["straight", "tee", "ring"])
def test_a_map_gives_a_drive_with_two_seeds(kind: str, tmp_path: Path) -> None:
    scenario = load_scenario(import_map(maps.KINDS[kind](tmp_path), out=tmp_path / "made", seeds=(1, 2)))
    assert scenario.agents.vehicles == 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", maps.KINDS)
def test_a_map_of_every_kind_gives_drives_with_ten_seeds(kind: str, tmp_path: Path) -> None:
    scenario = load_scenario(import_map(maps.KINDS[kind](tmp_path), out=tmp_path / "made"))
    assert scenario.agents.vehicles == 3


@pytest.mark.parametrize(
    ("kind", "links"),
    [
        ("ramp", {"-0": {"-1", "-2"}}),
        ("roundabout", {f"-{k}": {f"-{(k + 1) % 4}", f"-{10 + (k + 1) % 4}"} for k in range(4)}),
    ],
)
def test_ways_part_at_ramps_and_roundabouts(kind: str, links: dict[str, set[str]], tmp_path: Path) -> None:
    net = converted(maps.KINDS[kind](tmp_path), tmp_path / "out")
    found = {edge.getID(): {after.getID() for after in edge.getOutgoing()} for edge in net.getEdges(False)}
    assert {name: after for name, after in found.items() if len(after) > 1} == links


def test_the_lanes_along_a_left_hand_road_lie_on_its_left(tmp_path: Path) -> None:
    """ASAM OpenDRIVE 1.8, 10.2: with LHT the lanes of positive number lead along the road."""
    net = converted(maps.left_hand(tmp_path), tmp_path / "out")
    assert net.kerb_side == 1.0
    lanes = {}
    for edge in net.getEdges(False):
        shape = [np.array(lane.getShape())[:, :2] for lane in edge.getLanes() if lane.allows("passenger")]
        lanes[float(np.sign(shape[0][-1, 0] - shape[0][0, 0]))] = sorted(float(line[0, 1]) for line in shape)
    assert lanes[1.0] == pytest.approx([1.75, 5.25], abs=0.1) and lanes[-1.0] == pytest.approx([-1.75], abs=0.1)


def test_roads_and_ground_have_the_heights_of_the_map(tmp_path: Path) -> None:
    made = import_map(maps.crest(tmp_path), out=tmp_path / "made", seeds=(1,))
    scenario = load_scenario(made)
    net = read_network(made / "map.net.xml")
    corners = np.array([c for edge in net.getEdges(False) for lane in edge.getLanes() for c in lane.getShape3D()])
    share = np.minimum(corners[:, 0], 400.0 - corners[:, 0]) / 200.0
    assert np.abs(corners[:, 2] - 8.0 * share**2 * (3.0 - 2.0 * share)).max() < 0.05
    mesh = build_world(scenario, 1)
    roads = mesh.triangles[mesh.face_attributes["material"] == material_index("asphalt")]
    assert roads[..., 2].max() == pytest.approx(8.0, abs=0.2) and roads[..., 2].min() < 3.0


def test_objects_stand_where_the_map_has_them(tmp_path: Path) -> None:
    out = tmp_path / "out"
    converted(maps.with_things(tmp_path), out)
    (house,) = read_outlines(out / "map.poly.xml")
    assert house.height_m == 9.0 and house.shape.bounds == pytest.approx((192.0, 20.0, 208.0, 30.0), abs=0.01)
    found = read_map_objects(out / "map.poly.xml")
    places = {kind: place.round(2).tolist() for kind, place in found.points.items()}
    assert places == {"tree": [[150.0, -9.0]], "pole": [[170.0, -9.0]], "lamp": [[190.0, -9.0]]}
    ((kind, line, height_m),) = found.barriers
    assert kind == "guard_rail" and height_m == 0.8
    assert line.bounds == pytest.approx((100.0, 6.0, 200.0, 6.0), abs=0.01)


def test_objects_follow_the_reference_line(tmp_path: Path) -> None:
    """A tree in the middle of a lane stands where netconvert draws the lane: on a line, a spiral and an arc."""
    source, out = maps.curve(tmp_path), tmp_path / "out"
    root = ET.parse(source)
    road = root.find("road")
    assert road is not None
    things = ET.SubElement(road, "objects")
    for k, s in enumerate((10.0, 150.0, 250.0, 320.0)):
        ET.SubElement(things, "object", type="tree", id=str(k), s=str(s), t="-1.75", zOffset="0")
    root.write(source)
    net = converted(source, out)
    trees = read_map_objects(out / "map.poly.xml").points["tree"]
    inner = np.concatenate([_dense(edge.getShape()) for edge in net.getEdges(False)])
    assert np.hypot(*(trees[:, None] - inner[None]).transpose(2, 0, 1)).min(axis=1).max() < 0.1


def _dense(shape: object) -> np.ndarray:
    line = np.array(shape)[:, :2]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(0.0, along[-1], 0.1)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def test_odd_signals_and_objects_are_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source, out = maps.straight(tmp_path), tmp_path / "out"
    text = source.read_text()
    odd = '<signals><signal id="7" s="10" t="2" type="" dynamic="no" orientation="+"/></signals></road>'
    source.write_text(text.replace("</road>", odd))
    with caplog.at_level(logging.WARNING):
        net = converted(source, out)
    assert len(net.getEdges(False)) == 2
    assert "straight.xodr: left out 1 x signal without a usable attribute 'type'" in caplog.text


def test_values_that_are_no_numbers_and_objects_without_a_place_are_left_out_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A rail of no length that repeats without an end stays; netconvert, which would repeat it for ever, has none."""
    source, out = maps.straight(tmp_path), tmp_path / "out"
    odd = (
        '<objects><object id="1" type="building"/><object id="2" type="tree" s="abc" t="3"/>'
        '<object id="3" type="barrier" s="30" t="8" length=""><repeat s="30" length="50"/></object></objects>'
        '<signals><signal id="4" s="x" t="3" type="274" dynamic="no" orientation="+"/>'
        '<signal id="5" s="20" t="3" type="1000001" dynamic="yes" orientation="+"><validity fromLane="x"/></signal>'
        "</signals></road>"
    )
    source.write_text(source.read_text().replace("</road>", odd))
    with caplog.at_level(logging.WARNING):
        net = converted(source, out)
    assert len(net.getEdges(False)) == 2
    assert read_map_objects(out / "map.poly.xml").barriers[0][1].length == pytest.approx(50.0)
    for named in (
        "2 x object without a usable place or size",
        "1 x signal without a usable attribute 's'",
        "1 x validity without a usable attribute 'fromLane'",
    ):
        assert f"straight.xodr: left out {named}" in caplog.text


def test_links_to_roads_that_are_not_there_are_left_out_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = maps.road(maps.xodr.Line(400))
    source = maps.saved(tmp_path, "cut", one)
    root = ET.parse(source)
    link = root.find("road/link")
    assert link is not None
    ET.SubElement(link, "successor", elementType="road", elementId="77", contactPoint="start")
    root.write(source)
    with caplog.at_level(logging.WARNING):
        net = converted(source, tmp_path / "out")
    assert len(net.getEdges(False)) == 2
    assert "cut.xodr: left out 1 x link to a road that is not there" in caplog.text


def test_a_namespace_is_read_over(tmp_path: Path) -> None:
    source = maps.straight(tmp_path)
    source.write_text(source.read_text().replace("<OpenDRIVE", '<OpenDRIVE xmlns="http://code.asam.net/simulation"', 1))
    assert len(converted(source, tmp_path / "out").getEdges(False)) == 2


@pytest.mark.parametrize(
    ("limits", "speeds"),
    [
        ([{"max": "30", "unit": "km/h"}], {"8.33"}),
        ([{"max": "30", "unit": "mph"}, {"max": "10"}], {"13.41", "10.00"}),
        ([{"max": "no limit"}], {"13.89"}),
    ],
)
def test_limits_of_roads_are_those_of_their_lanes_for_vehicles(
    tmp_path: Path, limits: list[dict[str, str]], speeds: set[str]
) -> None:
    source = maps.straight(tmp_path)
    tree = ET.parse(source)
    for road in tree.iter("road"):
        for kind in road.findall("type"):
            road.remove(kind)
        for place, limit in enumerate(limits):
            kind = ET.Element("type", {"s": f"{200 * place}", "type": "town"})
            kind.append(ET.Element("speed", limit))
            road.insert(1 + place, kind)
    tree.write(source)
    net = convert_map(source, tmp_path).net.read_text(encoding="utf-8")
    assert set(re.findall(r'<lane id="[^:][^>]*? speed="([^"]*)"', net)) == speeds
