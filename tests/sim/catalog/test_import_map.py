"""A map becomes a scenario by one call: OpenStreetMap in all its packings, SUMO's own networks, OpenDRIVE."""

import bz2
import gzip
import json
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
import shapely

from dsrc.__main__ import main
from dsrc.data.write import generate
from sim.catalog.import_map import import_map
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from sim.mesh.materials import material_index
from sim.roads.convert import convert_map
from sim.roads.networks import read_network, resolve_network
from sim.roads.osm import pbf_to_xml
from sim.roads.polygons import read_outlines
from sim.roads.tools import sumo_home
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world
from sim.world.furniture.map_objects import read_map_objects
from tests.sim.world.hills import hilly_scenario

M_PER_DEG = 111_194.9
"""Of latitude; at the equator, where the town lies, of longitude too."""


def town(heights: bool = False) -> str:
    """Return two crossing streets with signals, three houses, a tree, a lamp, a pole, a hedge, a fence and a wall."""
    nodes: list[str] = []
    ways: list[str] = []

    def place(x: float, y: float, **tags: str) -> int:
        if heights:
            tags["ele"] = f"{100.0 + 0.05 * x:.2f}"
        inner = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        number = len(nodes) + 1
        nodes.append(f'<node id="{number}" lat="{y / M_PER_DEG:.8f}" lon="{3.0 + x / M_PER_DEG:.8f}">{inner}</node>')
        return number

    def way(places: list[int], **tags: str) -> None:
        inner = "".join(f'<nd ref="{ref}"/>' for ref in places)
        inner += "".join(f'<tag k="{key.replace("__", ":")}" v="{value}"/>' for key, value in tags.items())
        ways.append(f'<way id="{900 + len(ways)}">{inner}</way>')

    def house(x: float, y: float, size: float, **tags: str) -> None:
        corners = [place(x, y), place(x + size, y), place(x + size, y + size), place(x, y + size)]
        way([*corners, corners[0]], building="yes", **tags)

    middle = place(0, 0, highway="traffic_signals")
    for kind, ends in (("secondary", ((-250, 0), (250, 0))), ("residential", ((0, -250), (0, 250)))):
        first, last = (place(*end) for end in ends)
        way([first, middle, last], highway=kind, maxspeed="50", lanes="2")
    house(30, 30, 20, height="12.5")
    house(-60, 30, 24, building__levels="4")
    house(40, -70, 18)
    place(60, 17, natural="tree")
    place(80, 12, highway="street_lamp")
    place(100, 13, man_made="utility_pole")
    for y, barrier in ((16, "hedge"), (19, "fence"), (22, "wall")):
        way([place(-120, y), place(-90, y)], barrier=barrier)
    return f'<?xml version="1.0"?><osm version="0.6">{"".join(nodes)}{"".join(ways)}</osm>'


def field(number: int, value: bytes | int) -> bytes:
    """Return a field of protocol buffers."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def zigzag(values: list[int]) -> bytes:
    steps = np.diff([0, *values]).tolist()
    return b"".join(varint((step << 1) ^ (step >> 63)) for step in steps)


def packed_file(path: Path) -> None:
    """Write a .osm.pbf by hand: two nodes, one of them a tree, and a way between them."""
    strings = [b"", b"natural", b"tree", b"highway", b"residential"]
    table = b"".join(field(1, text) for text in strings)
    lat, lon = [600_000_000, 600_001_000], [-250_000_000, -249_990_000]
    dense = field(1, zigzag([7, 9])) + field(8, zigzag(lat)) + field(9, zigzag(lon))
    dense += field(10, varint(1) + varint(2) + varint(0) + varint(0))
    way = field(1, 5) + field(2, varint(3)) + field(3, varint(4)) + field(8, zigzag([7, 9]))
    block = field(1, table) + field(2, field(2, dense)) + field(2, field(3, way))
    data = b""
    features = field(4, b"OsmSchema-V0.6") + field(4, b"DenseNodes")
    for kind, content in ((b"OSMHeader", features), (b"OSMData", block)):
        blob = field(2, len(content)) + field(3, zlib.compress(content))
        header = field(1, kind) + field(3, len(blob))
        data += struct.pack(">I", len(header)) + header + blob
    path.write_bytes(data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("town")
    (base / "town.osm").write_text(town(), encoding="utf-8")
    return import_map(base / "town.osm", out=base / "made", seeds=(1,))


@pytest.mark.parametrize("kind", ["geom.osm", "geom.json", "nodes.json"])
def test_what_overpass_sends_is_read_like_the_file_itself(kind: str, tmp_path: Path) -> None:
    """After the Overpass API's manual, "Out": with `geom` ways hold the places of their nodes, in XML and JSON."""
    places = {"1": (52.0, 9.0), "2": (52.0015, 9.004), "3": (52.002, 9.008)}
    way = {"type": "way", "id": 10, "nodes": [1, 2, 3], "tags": {"highway": "primary", "lanes": "2"}}
    nodes = [{"type": "node", "id": int(name), "lat": lat, "lon": lon} for name, (lat, lon) in places.items()]
    geometry = [{"lat": lat, "lon": lon} for lat, lon in places.values()]
    refs = "".join(f'<nd ref="{name}" lat="{lat}" lon="{lon}"/>' for name, (lat, lon) in places.items())
    tags = '<tag k="highway" v="primary"/><tag k="lanes" v="2"/>'
    texts = {
        "geom.osm": f'<osm version="0.6"><way id="10"><bounds/>{refs}{tags}</way></osm>',
        "geom.json": json.dumps({"version": 0.6, "elements": [way | {"geometry": geometry}]}),
        "nodes.json": json.dumps({"version": 0.6, "elements": [way, *nodes]}),
    }
    usual = "".join(f'<node id="{name}" lat="{lat}" lon="{lon}"/>' for name, (lat, lon) in places.items())
    refs = "".join(f'<nd ref="{name}"/>' for name in places)
    texts["map.osm"] = f'<osm version="0.6">{usual}<way id="10">{refs}{tags}</way></osm>'
    networks = []
    for name in (kind, "map.osm"):
        (tmp_path / name).write_text(texts[name])
        (tmp_path / f"of {name}").mkdir()
        networks.append(read_network(convert_map(tmp_path / name, tmp_path / f"of {name}").net))
    shapes = [{edge.getID(): edge.getShape() for edge in net.getEdges(False)} for net in networks]
    assert len(shapes[0]) == 2 and shapes[0] == shapes[1]


def test_geojson_is_named_for_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(ScenarioError, match="JSON of the Overpass API, found FeatureCollection"):
        convert_map(tmp_path / "map.json", tmp_path)


def test_an_extract_becomes_a_scenario_around_its_junction(folder: Path) -> None:
    scenario = load_scenario(folder)
    assert scenario.name == "town" and "OpenStreetMap" in scenario.attribution
    net = read_network(resolve_network(scenario, 1))
    assert len(net.getTrafficLights()) == 1
    x, y = scenario.demand.focus_m or (0.0, 0.0)
    junction = min(net.getTrafficLights()[0].getEdges(), key=str).getToNode().getCoord()
    assert np.hypot(x - junction[0], y - junction[1]) < 1.0
    x_min, y_min, x_max, y_max = scenario.network.area_m or (0.0, 0.0, 0.0, 0.0)
    assert x_min < x < x_max and y_min < y < y_max


def test_houses_have_the_heights_of_their_tags(folder: Path) -> None:
    scenario = load_scenario(folder)
    found = {round(outline.shape.area, -1): outline.height_m for outline in read_outlines(folder / "map.poly.xml")}
    assert found == {400.0: 12.5, 570.0: 12.0, 320.0: None}
    mesh = build_world(scenario, 1)
    material = mesh.face_attributes["material"]
    roofs = mesh.triangles[material == material_index("roof")]
    x, y = scenario.demand.focus_m or (0.0, 0.0)
    for at, height in (((40.0, 40.0), 12.5), ((-48.0, 42.0), 12.0)):
        near = np.hypot(*(roofs.mean(axis=1)[:, :2] - [x + at[0], y + at[1]]).T) < 12.0
        assert near.any() and roofs[near][:, :, 2].max() == pytest.approx(height, abs=0.01)


def test_trees_lamps_poles_hedges_fences_and_walls_stand_where_the_map_has_them(folder: Path) -> None:
    scenario = load_scenario(folder)
    map_objects = read_map_objects(folder / "map.poly.xml")
    assert {kind: len(places) for kind, places in map_objects.points.items()} == {"tree": 1, "lamp": 1, "pole": 1}
    assert sorted(kind for kind, _, _ in map_objects.barriers) == ["fence", "hedge", "wall"]
    mesh = build_world(scenario, 1)
    material = mesh.face_attributes["material"]
    middle = mesh.triangles.mean(axis=1)
    x, y = scenario.demand.focus_m or (0.0, 0.0)
    for kind, at, reach, height in (
        ("leaves", (60, 17), 3.0, 4.0), ("metal", (80, 12), 1.0, 6.0), ("metal", (100, 13), 1.0, 7.9),
        ("hedge", (-105, 16), 16.0, 1.5), ("metal", (-105, 19), 16.0, 1.1), ("brick", (-105, 22), 16.0, 1.7),
    ):  # fmt: skip
        there = (material == material_index(kind)) & (np.hypot(*(middle[:, :2] - [x + at[0], y + at[1]]).T) < reach)
        assert there.any(), (kind, at)
        assert mesh.triangles[there][:, :, 2].max() >= height


@pytest.mark.slow
def test_one_map_makes_the_same_bytes_every_time(folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "town.osm"
    source.write_text(town(), encoding="utf-8")
    again = import_map(source, out=tmp_path / "again", seeds=(1,))
    assert [path.name for path in sorted(again.iterdir())] == ["map.net.xml", "map.poly.xml", "scenario.toml"]
    for path in again.iterdir():
        assert path.read_bytes() == (folder / path.name).read_bytes()


@pytest.mark.parametrize(("ending", "pack"), [(".osm.gz", gzip.compress), (".osm.bz2", bz2.compress)])
def test_a_packed_extract_is_the_same_map(
    folder: Path, tmp_path: Path, ending: str, pack: Callable[[bytes], bytes]
) -> None:
    source = tmp_path / f"town{ending}"
    source.write_bytes(pack(town().encode()))
    made = convert_map(source, tmp_path)
    for path, name in ((made.net, "map.net.xml"), (made.polygons, "map.poly.xml")):
        assert path is not None and path.read_bytes() == (folder / name).read_bytes()


def test_the_binary_form_of_an_extract_is_read(tmp_path: Path) -> None:
    packed_file(tmp_path / "two.osm.pbf")
    pbf_to_xml(tmp_path / "two.osm.pbf", tmp_path / "two.osm")
    nodes = {node.get("id"): node for node in ElementTree.parse(tmp_path / "two.osm").getroot()}
    assert [(n.get("lat"), n.get("lon")) for n in (nodes["7"], nodes["9"])] == [("60", "-25"), ("60.0001", "-24.999")]
    assert [tag.attrib for tag in nodes["7"]] == [{"k": "natural", "v": "tree"}] and len(nodes["9"]) == 0
    assert [dict(part.attrib) for part in nodes["5"]] == [
        {"ref": "7"},
        {"ref": "9"},
        {"k": "highway", "v": "residential"},
    ]


@pytest.mark.parametrize("length", [0, 3, -7])
def test_a_binary_extract_that_is_cut_short_is_one_line(tmp_path: Path, length: int) -> None:
    packed_file(tmp_path / "two.osm.pbf")
    (tmp_path / "two.osm.pbf").write_bytes((tmp_path / "two.osm.pbf").read_bytes()[:length])
    with pytest.raises(ScenarioError, match=r"two\.osm\.pbf: not a readable \.osm\.pbf file: .+") as caught:
        pbf_to_xml(tmp_path / "two.osm.pbf", tmp_path / "two.osm")
    assert "\n" not in str(caught.value)


def test_a_binary_extract_has_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.roads.osm._CHECKED_EVERY", 1)
    monkeypatch.setattr("sim.roads.osm.MOST_BYTES", -1)
    packed_file(tmp_path / "two.osm.pbf")
    with pytest.raises(ScenarioError, match="more than -1 bytes when unpacked"):
        pbf_to_xml(tmp_path / "two.osm.pbf", tmp_path / "two.osm")


def test_roads_and_ground_follow_the_heights_of_an_extract(tmp_path: Path) -> None:
    (tmp_path / "hill.osm").write_text(town(heights=True), encoding="utf-8")
    scenario = load_scenario(import_map(tmp_path / "hill.osm", out=tmp_path / "hill", seeds=(1,)))
    net = read_network(resolve_network(scenario, 1))
    heights = [corner[2] for edge in net.getEdges(False) for lane in edge.getLanes() for corner in lane.getShape3D()]
    assert np.ptp(heights) == pytest.approx(25.0, abs=2.0)
    mesh = build_world(scenario, 1)
    roads = mesh.triangles[mesh.face_attributes["material"] == material_index("asphalt")]
    slope = np.polyfit(roads.mean(axis=1)[:, 0], roads.mean(axis=1)[:, 2], 1)[0]
    assert slope == pytest.approx(0.05, abs=0.005)


def test_a_network_of_sumo_keeps_its_heights_and_its_streets(tmp_path: Path) -> None:
    source = Path(hilly_scenario(tmp_path).network.file)
    packed = tmp_path / "hilly.net.xml.gz"
    packed.write_bytes(gzip.compress(source.read_bytes()))
    made = import_map(packed, out=tmp_path / "made", seeds=(1,))
    ours, theirs = (read_network(path) for path in (made / "map.net.xml", source))
    assert {edge.getID() for edge in ours.getEdges(False)} == {edge.getID() for edge in theirs.getEdges(False)}
    for edge in theirs.getEdges(False):
        way = [
            shapely.LineString([p[:2] for p in net.getEdge(edge.getID()).getLanes()[1].getShape()])
            for net in (ours, theirs)
        ]
        assert way[0].hausdorff_distance(way[1]) < 4.0
    z = [corner[2] for edge in ours.getEdges(False) for corner in edge.getLanes()[1].getShape3D()]
    assert min(z) < 412.0 and max(z) > 437.0


def test_an_opendrive_file_comes_back_as_the_streets_it_was_written_from(tmp_path: Path) -> None:
    source = Path(hilly_scenario(tmp_path).network.file)
    xodr = tmp_path / "hilly.xodr"
    command = [str(sumo_home() / "bin" / "netconvert"), "-s", str(source), "--opendrive-output", str(xodr)]
    subprocess.run(command, check=True, capture_output=True)
    scenario = load_scenario(import_map(xodr, name="hills", out=tmp_path / "made", seeds=(1,)))
    assert scenario.name == "hills" and not scenario.attribution
    ours = read_network(resolve_network(scenario, 1))
    lanes = [lane for edge in ours.getEdges(False) for lane in edge.getLanes() if lane.allows("passenger")]
    theirs = [lane for edge in read_network(source).getEdges(False) for lane in edge.getLanes()[1:]]
    assert sum(lane.getLength() for lane in lanes) == pytest.approx(sum(lane.getLength() for lane in theirs), rel=0.05)
    with SumoTraffic(msgspec.structs.replace(scenario, warmup_s=40.0), 1) as traffic:
        assert (~traffic.actors.parked()).sum() > 3


@pytest.mark.slow
def test_the_command_tries_ten_seeds_and_says_what_takes_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "town.osm").write_text(town(), encoding="utf-8")
    main(["scenario", "import", str(tmp_path / "town.osm"), "--out", str(tmp_path / "x")])
    assert f"dsrc generate {tmp_path / 'x'}" in capsys.readouterr().err
    assert load_scenario(tmp_path / "x").name == "town"


def test_generate_takes_the_folder(folder: Path, tmp_path: Path) -> None:
    scenario = load_scenario(folder)
    agents = msgspec.structs.replace(scenario.agents, lidar="debug-16")
    drive = generate(msgspec.structs.replace(scenario, agents=agents), tmp_path / "data", frames=2)
    assert len(list(drive.glob("*/000001.pcd"))) >= 3


BROKEN = {
    "cut.osm": ("<osm><node", "netconvert refuses it"),
    "empty.osm": ('<osm version="0.6"></osm>', "highways: expected roads open to passenger cars"),
    "cut.xodr": ("<OpenDRIVE>", "netconvert refuses it"),
    "cut.net.xml": ("<net><edge", "netconvert refuses it"),
    "text.osm.pbf": ("no such thing", "not a readable .osm.pbf file"),
    "text.osm.gz": ("no such thing", "not a readable .osm.gz file"),
    "path.osm": (town().replace('"secondary"', '"footway"').replace('"residential"', '"footway"'), ""),
    "map.png": ("", "a name that ends in"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_bad_file_is_told_in_one_line_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    text, said = BROKEN[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ScenarioError) as caught:
        import_map(tmp_path / name, out=tmp_path / "made")
    assert name in str(caught.value) and said in str(caught.value) and "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_missing_file_and_a_full_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"gone\.osm: file not found"):
        import_map(tmp_path / "gone.osm", out=tmp_path / "made")
    (tmp_path / "town.osm").write_text(town(), encoding="utf-8")
    with pytest.raises(ScenarioError, match="expected a folder that is empty"):
        import_map(tmp_path / "town.osm", out=tmp_path)
    with pytest.raises(ScenarioError, match="name: expected letters"):
        import_map(tmp_path / "town.osm", name="a b", out=tmp_path / "made")
