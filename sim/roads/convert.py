"""Map conversion by netconvert and polyconvert: a SUMO network and its polygons."""

import bz2
import gzip
import hashlib
import logging
import re
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from sim.errors import ScenarioError, complaint
from sim.reading import check_regular, parsing
from sim.roads import kerbside, opendrive, opendrive_map, rounding
from sim.roads import osm as openstreetmap
from sim.roads.opendrive_map import OpenDriveMap
from sim.roads.osm import MOST_BYTES, in_order, json_to_xml, keeps_left, pbf_to_xml
from sim.roads.tools import Option, drop_header, run_tool, sumo_home

log = logging.getLogger(__name__)

TrafficSide = Literal["auto", "left", "right"]

MAP_SUFFIXES = (
    ".net.xml",
    ".net.xml.gz",
    ".osm",
    ".osm.xml",
    ".osm.gz",
    ".osm.bz2",
    ".osm.pbf",
    ".pbf",
    ".json",
    ".xodr",
)
"""File name suffixes of convertible maps."""

ROUND: dict[str, Option] = {
    "junctions.internal-link-detail": 20,
    "junctions.limit-turn-speed": 3.5,
    "junctions.limit-turn-speed.min-angle": 5,
    "offset.disable-normalization": True,
    "no-warnings": True,
}
"""Junction options of netconvert: smooth lanes, with at most 3.5 m/s2 of lateral acceleration."""

_FROM_OSM: dict[str, Option] = ROUND | {
    "offset.disable-normalization": False,
    "geometry.remove": True,
    "geometry.min-radius.fix": True,
    "ramps.guess": True,
    "roundabouts.guess": True,
    "junctions.join": True,
    "junctions.corner-detail": 5,
    "tls.discard-simple": True,
    "tls.guess-signals": True,
    "tls.join": True,
    "keep-edges.by-vclass": "passenger",
    "remove-edges.isolated": True,
    # Quiet streets keep the space beside them for parked cars.
    "sidewalks.guess": True,
    "sidewalks.guess.min-speed": 8.5,
    "crossings.guess": True,
    "output.street-names": True,
}
_FROM_OPENDRIVE: dict[str, Option] = ROUND | {"opendrive.import-all-lanes": True}
_OSM_TYPES = ("osmNetconvert", "osmNetconvertUrbanDe", "osmNetconvertPedestrians", "osmNetconvertBicycle")
_OPENDRIVE_TYPES = ("opendriveNetconvert", "opendriveNetconvertPedestrians", "opendriveNetconvertBicycle")

_THINGS = ("building", "barrier", "natural.tree", "natural.tree_row", "highway.street_lamp", "man_made.utility_pole")
"""Roadside objects taken from a map, by tag key or by key and value."""

_MOST_FAULTS = 20
_NO_ROADS = ("No edges loaded", "No nodes loaded")
"""What netconvert says where nothing is left to drive on."""
_OFFSET = re.compile(r'<location netOffset="([^",]+),([^",]+)"')

_CODE = (
    __file__, rounding.__file__, kerbside.__file__, openstreetmap.__file__, opendrive.__file__, opendrive_map.__file__
)  # fmt: skip
CONVERSION = hashlib.sha256(b"".join(Path(file).read_bytes() for file in _CODE)).hexdigest()
"""Version of the conversion, part of the cache key: bump it with the code."""


@dataclass(frozen=True, slots=True)
class ConvertedMap:
    """Files of a converted map.

    Attributes:
        net: the .net.xml.
        polygons: the .poly.xml with buildings and other objects; None when the map has none.
    """

    net: Path
    polygons: Path | None

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Return the files that `convert_map` wrote into a folder."""
        polygons = folder / "map.poly.xml"
        return cls(folder / "map.net.xml", polygons if polygons.is_file() else None)


def map_kind(path: Path) -> str:
    """Return the one of `MAP_SUFFIXES` that a file name ends in.

    Raises:
        ScenarioError: the suffix is unknown.
    """
    found = [kind for kind in MAP_SUFFIXES if path.name.lower().endswith(kind)]
    if not found:
        raise ScenarioError(complaint(path, "map", f"a name that ends in {', '.join(MAP_SUFFIXES)}", path.name))
    return max(found, key=len)


def is_network(path: Path) -> bool:
    """Return whether the name of a file is that of a SUMO network."""
    return map_kind(path).startswith(".net.xml")


def convert_map(source: Path, folder: Path, traffic_side: TrafficSide = "auto") -> ConvertedMap:
    """Convert a map to `map.net.xml` and, if it has roadside objects, `map.poly.xml`.

    Args:
        source: a SUMO network, an OpenStreetMap extract or an OpenDRIVE file.
        traffic_side: side on which traffic keeps; `auto` by the rules of OpenDRIVE's roads, the country of an extract
            or the network's own.

    Raises:
        ScenarioError: the file is missing, of an unknown format, or refused by netconvert.
    """
    kind = map_kind(source)
    check_regular(source, "map", ScenarioError)
    if is_network(source) and traffic_side != "auto":
        raise ScenarioError(
            complaint(source, "traffic_side", "auto for a SUMO network, which has its side", traffic_side)
        )
    net = folder / "map.net.xml"
    with tempfile.TemporaryDirectory(dir=folder) as work:
        if is_network(source):
            run_tool("netconvert", ROUND | {"sumo-net-file": str(source), "output-file": str(net)}, net, str(source))
        elif kind == ".xodr":
            _from_opendrive(source, folder, Path(work), traffic_side)
        else:
            _from_osm(source, kind, folder, Path(work), traffic_side)
    with parsing(source, f"{kind} file", ScenarioError):
        drop_header(net)
        made = ConvertedMap.of(folder)
        text = rounding.rounded_network(net.read_text(encoding="utf-8"))
        text = kerbside.with_room_to_park(text, kerbside.houses_of(made.polygons))
        net.write_text(text, encoding="utf-8")
    return made


def _from_osm(source: Path, kind: str, folder: Path, work: Path, side: TrafficSide) -> None:
    net, osm = folder / "map.net.xml", in_order(_plain_osm(source, kind, work), source, work)
    options = _FROM_OSM | {
        "osm-files": str(osm),
        "type-files": _type_maps(*_OSM_TYPES),
        "osm.elevation": _has_heights(osm),
        "output-file": str(net),
    }
    if side == "left" or (side == "auto" and keeps_left(osm)):
        options["lefthand"] = True
    try:
        run_tool("netconvert", options, net, str(source))
    except ScenarioError as refusal:
        if not any(said in str(refusal) for said in _NO_ROADS):
            raise
        found = ", ".join(openstreetmap.highways_of(osm)) or "none"
        raise ScenarioError(
            complaint(source, "highways", "roads open to passenger cars, by SUMO's types, with nodes", found)
        ) from None
    if "<edge " not in net.read_text(encoding="utf-8"):
        # A street alone counts as isolated too.
        run_tool("netconvert", options | {"remove-edges.isolated": False}, net, str(source))
    _polygons(source, osm, folder, work)


def _from_opendrive(source: Path, folder: Path, work: Path, side: TrafficSide) -> None:
    """Convert OpenDRIVE, without the objects and signals that netconvert refuses the map for."""
    net, plain = folder / "map.net.xml", work / "map.xodr"
    options = _FROM_OPENDRIVE | {"type-files": _type_maps(*_OPENDRIVE_TYPES), "output-file": str(net)}
    try:
        drive = OpenDriveMap(source)
    except ET.ParseError:
        run_tool("netconvert", options | {"opendrive-files": str(source)}, net, str(source))
        return
    options |= {"opendrive-files": str(plain)}
    left = side == "left" or (side == "auto" and drive.left_hand)
    if left:
        options["lefthand"] = True
    for _ in range(_MOST_FAULTS):
        drive.write(plain, left_hand=left)
        try:
            run_tool("netconvert", options, net, str(source))
            break
        except ScenarioError as refusal:
            dropped = drive.drop_fault(refusal)
            if not dropped:
                raise
            log.warning("%s: left out %s", source.name, dropped)
    offset = _OFFSET.search(net.read_text(encoding="utf-8"))
    rows = drive.objects_xml((float(offset[1]), float(offset[2])) if offset else (0.0, 0.0))
    if rows:
        (folder / "map.poly.xml").write_text(f"<additional>\n{rows}</additional>\n", encoding="utf-8")


def _type_maps(*names: str) -> str:
    return ",".join(str(sumo_home() / "data" / "typemap" / f"{name}.typ.xml") for name in names)


def _plain_osm(source: Path, kind: str, work: Path) -> Path:
    """Return an extract as plain XML, the only format that SUMO's programs read."""
    if kind in (".osm", ".osm.xml"):
        return source
    target = work / "map.osm"
    if kind == ".json":
        json_to_xml(source, target)
        return target
    if kind.endswith(".pbf"):
        pbf_to_xml(source, target)
        return target
    opened = gzip if kind.endswith(".gz") else bz2
    with parsing(source, f"{kind} file", ScenarioError), opened.open(source) as packed, target.open("wb") as plain:
        while content := packed.read(1 << 20):
            plain.write(content)
            if plain.tell() > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES} bytes when unpacked")
    return target


def _has_heights(osm: Path) -> bool:
    """Return whether most nodes have a height: with few, roads would jump up to them and down again."""
    text = osm.read_bytes()
    return text.count(b'k="ele"') > 0.5 * text.count(b"<node ") > 0


def _polygons(source: Path, osm: Path, folder: Path, work: Path) -> None:
    types, target = work / "things.typ.xml", folder / "map.poly.xml"
    rows = "".join(f'<polygonType id="{name}" name="{name}" color="gray" layer="0"/>' for name in _THINGS)
    types.write_text(f"<polygonTypes>{rows}</polygonTypes>", encoding="utf-8")
    options: dict[str, Option] = {
        "net-file": str(folder / "map.net.xml"),
        "osm-files": str(osm),
        "type-file": str(types),
        "discard": True,
        "osm.keep-full-type": True,
        "all-attributes": True,
        "output-file": str(target),
        "no-warnings": True,
    }
    run_tool("polyconvert", options, target, str(source))
    drop_header(target)
    text = target.read_text(encoding="utf-8")
    if "<poly " not in text and "<poi " not in text:
        target.unlink()
