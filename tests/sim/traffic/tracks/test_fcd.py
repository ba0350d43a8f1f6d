"""SUMO's FCD output, written by SUMO: boxes lie behind the front bumper, headings are those of the streets."""

import gzip
import logging
import math
import re
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from sim.errors import DataError
from sim.roads.tools import run_tool, sumo_home
from sim.traffic.tracks.base import Track
from sim.traffic.tracks.open import read_tracks

NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/><node id="c" x="200" y="300"/></nodes>'
EDGES = """<edges><edge id="east" from="a" to="b" numLanes="1" speed="13.9" sidewalkWidth="2"/>
<edge id="north" from="b" to="c" numLanes="1" speed="13.9" sidewalkWidth="2"/></edges>"""
ROUTES = """<routes>
<vType id="suv" length="4.8" width="1.95" height="1.7" sigma="0"/>
<vType id="tipper" vClass="truck" length="8" sigma="0"/>
<person id="walker" depart="0" departPos="20"><walk edges="east" arrivalPos="120"/></person>
<vehicle id="lead" type="suv" depart="0" departSpeed="max"><route edges="east north"/></vehicle>
<vehicle id="heavy" type="tipper" depart="6" departSpeed="10"><route edges="east north"/></vehicle>
</routes>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street to the east that turns north, driven for 25 s, in steps of 0.5 s."""
    folder = tmp_path_factory.mktemp("fcd")
    for name, text in (("a.nod.xml", NODES), ("a.edg.xml", EDGES), ("a.rou.xml", ROUTES)):
        (folder / name).write_text(text)
    net = folder / "a.net.xml"
    files = {"node-files": str(folder / "a.nod.xml"), "edge-files": str(folder / "a.edg.xml")}
    run_tool("netconvert", {**files, "output-file": str(net), "offset.disable-normalization": True}, net, "street")
    run(folder, "fcd.xml")
    return folder


def run(folder: Path, name: str, *more: str) -> Path:
    options = ["-n", "a.net.xml", "-r", "a.rou.xml", "--step-length", "0.5", "--end", "25", "--fcd-output", name, *more]
    subprocess.run([sumo_home() / "bin" / "sumo", *options], cwd=folder, check=True, capture_output=True)
    return folder / name


def by_name(path: Path) -> dict[str, Track]:
    (recording,) = read_tracks(path)
    return {one.name: one for one in recording.tracks}


def test_boxes_lie_behind_the_front_bumpers(folder: Path) -> None:
    tracks = by_name(folder / "fcd.xml")
    assert {name: one.class_name for name, one in tracks.items()} == {
        "lead": "car",
        "heavy": "truck",
        "walker": "pedestrian",
    }
    np.testing.assert_array_equal(tracks["lead"].size, [4.8, 1.95, 1.7])
    np.testing.assert_array_equal(tracks["heavy"].size, [8.0, 2.4, 2.4])
    streets: dict[str, int] = {"east_1": 0, "north_1": 0}
    for step in ET.parse(folder / "fcd.xml").getroot():
        for one in step:
            track = tracks[one.attrib["id"]]
            row = int(np.flatnonzero(track.time_s == float(step.attrib["time"]))[0])
            place = float(one.attrib["pos"])  # along the lane
            if one.attrib.get("lane") == "east_1" and place > track.size[0]:
                np.testing.assert_allclose(track.center[row, 0], place - 0.5 * track.size[0], atol=0.01)
                assert abs(track.yaw[row]) < 1e-6
                streets["east_1"] += 1
            if one.attrib.get("lane") == "north_1" and place > track.size[0]:
                assert abs(track.yaw[row] - 0.5 * math.pi) < 1e-6
                assert track.center[row, 1] == pytest.approx(float(one.attrib["y"]) - 0.5 * track.size[0], abs=1e-6)
                streets["north_1"] += 1
            if one.tag == "person":
                assert track.center[row, 0] == pytest.approx(place, abs=0.01)
    assert min(streets.values()) > 5


def test_a_packed_file_is_the_same(folder: Path) -> None:
    packed = folder / "packed.xml.gz"
    packed.write_bytes(gzip.compress((folder / "fcd.xml").read_bytes()))
    plain = by_name(folder / "fcd.xml")
    assert plain.keys() == by_name(packed).keys()
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(DataError, match="a whole"):
        read_tracks(packed)


def test_types_are_known_by_their_names_and_others_named(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    alone = tmp_path / "alone.xml"
    text = (folder / "fcd.xml").read_text().replace('type="tipper"', 'type="my_truck_7"')
    alone.write_text(text)
    with caplog.at_level(logging.WARNING):
        tracks = by_name(alone)
    assert [tracks[name].class_name for name in ("lead", "heavy")] == ["car", "truck"]
    np.testing.assert_array_equal(tracks["lead"].size, [5.0, 1.8, 1.5])
    (line,) = [record.getMessage() for record in caplog.records]
    assert "types suv: taken as cars" in line


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((r'angle="[^"]*"', 'angle="n"'), "angle: expected a number, found n"),
        ((r'angle="[^"]*"', 'angle="720"'), "angle: expected degrees within 360, found 720"),
        ((r' x="[^"]*"', ""), "x: expected a number, found nothing"),
        ((r'time="0.50"', ""), "timestep: time: expected a number"),
        ((r"</fcd-export>", ""), "FCD output of SUMO"),
        ((r"<fcd-export", '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/hostname">]><fcd-export'), "expected no entities"),
        ((r' (x|y)="\d*(\.\d)', r' \1="13\2'), "expected metres"),
    ],
)
def test_a_wrong_file_is_one_line(folder: Path, tmp_path: Path, change: tuple[str, str], says: str) -> None:
    path = tmp_path / "wrong.xml"
    path.write_text(re.sub(*change, (folder / "fcd.xml").read_text()))
    with pytest.raises(DataError) as wrong:
        read_tracks(path)
    assert says in str(wrong.value)
    assert "\n" not in str(wrong.value)


def test_places_on_the_globe_are_refused(folder: Path) -> None:
    net = folder / "a.net.xml"
    kept = net.read_text()
    utm = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
    net.write_text(re.sub(r'netOffset="[^"]*"', 'netOffset="-600000,-5790000"', kept).replace('"!"', f'"{utm}"'))
    try:
        path = run(folder, "geo.xml", "--fcd-output.geo")
    finally:
        net.write_text(kept)
    with pytest.raises(DataError, match=r"x, y: expected metres.*write it without --fcd-output\.geo"):
        read_tracks(path)


def test_trailers_are_no_rails_and_copies_have_their_type(tmp_path: Path) -> None:
    types = {
        "a": "truck_trailer",
        "b": "semitrailer",
        "c": "rail_urban",
        "d": "suv@7",
        "e": "shipping_van",
        "f": "tram",
        "g": "DEFAULT_RAILTYPE",
        "h": "DEFAULT_CONTAINERTYPE",
        "i": "cargoship",
    }
    rows = "".join(
        f'<vehicle id="{name}" x="{10 * place}" y="0" angle="90" speed="0" type="{kind}"/>'
        for place, (name, kind) in enumerate(types.items())
    )
    steps = "".join(f'<timestep time="{time}">{rows}</timestep>' for time in (0.0, 0.5))
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    (tmp_path / "a.rou.xml").write_text('<routes><vType id="suv" length="4.8" width="1.95" height="1.7"/></routes>')
    found = by_name(tmp_path / "fcd.xml")
    assert {name: one.class_name for name, one in found.items()} == {"a": "truck", "b": "truck", "d": "car", "e": "van"}
    assert found["d"].size.tolist() == [4.8, 1.95, 1.7]
