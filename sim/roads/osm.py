"""OpenStreetMap as netconvert reads it: binary files as XML, nodes first; and the side on which its country drives."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import shapely

from sim.errors import ScenarioError, complaint
from sim.reading import parsing, read_bytes

MOST_BYTES = 1 << 30
"""Most bytes of a map when unpacked."""
_CHECKED_EVERY = 10_000

_LEFT_CODES = frozenset(
    "AG AI AU BB BD BM BN BS BT BW CC CK CX CY DM FJ FK GB GD GG GS GY HK ID IE IM IN JE JM JP KE KI KN KY LC LK LS MO "
    "MS MT MU MV MW MY MZ NA NF NP NR NU NZ PG PK PN SB SC SG SH SR SZ TC TH TK TL TO TT TV TZ UG VC VG VI WS ZA ZM "
    "ZW".split()
)
"""ISO 3166-1 codes of countries that drive on the left."""

_LEFT_LAND = (
    ((-6.5, 49.7), (-3, 50), (-1, 50.4), (1, 50.7), (1.5, 51.05), (2, 51.5), (2, 53), (0, 61.2), (-9, 60.5), (-11, 51)),
    ((-2.7, 49.1), (-1.95, 49.1), (-1.95, 49.75), (-2.7, 49.75)),  # Channel Islands
    ((14.1, 35.7), (14.65, 35.7), (14.65, 36.15), (14.1, 36.15)),  # Malta
    ((32.2, 34.5), (34.7, 34.5), (34.7, 35.75), (32.2, 35.75)),  # Cyprus
    # Japan
    ((122.8, 24), (132, 24), (142.5, 24), (143, 30), (146.5, 43), (145.5, 45.6), (141, 45.7), (136.5, 38),
     (129.2, 34.8), (127, 30)),
    # Pakistan, India, Nepal, Bhutan, Bangladesh, Sri Lanka, Maldives
    ((61, 25), (61, 29.5), (66.5, 31.5), (70, 33), (71.7, 36.4), (74.6, 37), (77.5, 35.5), (79, 31.5), (81, 30.2),
     (88, 27.9),
     (97, 28.2), (95, 26), (93.5, 24), (92.4, 21.5), (92.33, 20.6), (88, 16), (82, 5), (73, -1), (66, 22)),
    ((92, 6.5), (94.3, 6.5), (93.5, 13.8), (92.2, 13.8)),  # Andaman and Nicobar Islands
    ((98.2, 10), (98.5, 15), (97.5, 18.5), (100, 20.2), (101.2, 19.4), (101.2, 17.7), (102.55, 17.9), (103.3, 18.35),
     (104, 18.25), (104.75, 17.4), (104.73, 16.56), (104.8, 16.3), (105.5, 15.3), (105.4, 14.5), (102.5, 13.7),
     (102.7, 11.8), (101, 7)),
    # Malaya, Singapore, Indonesia, Brunei, East Timor, Papua New Guinea, Australia, New Zealand
    ((95, 6), (98, 10), (100.5, 7.5), (104.5, 4), (109, 4), (115.5, 7.2), (116.9, 7.6), (119.4, 5.2), (126, 4.5),
     (131, 1), (160, -4), (170, -9), (164, -13), (160, -26), (170, -26), (174, -14), (180, -12), (180, -48), (110, -48),
     (94, 0)),
    ((-180, -22.5), (-173.5, -22.5), (-173.5, -15.3), (-180, -15.3)),  # Fiji's east, Tonga
    ((-173, -14.2), (-171.2, -14.2), (-171.2, -13.3), (-173, -13.3)),  # Samoa
    ((-170.2, -19.3), (-169.6, -19.3), (-169.6, -18.8), (-170.2, -18.8)),  # Niue
    ((-166, -22.2), (-157, -22.2), (-157, -8.8), (-166, -8.8)),  # Cook Islands
    ((166.8, -0.7), (167.1, -0.7), (167.1, -0.4), (166.8, -0.4)),  # Nauru
    ((172.5, -3), (177, -3), (177, 3.6), (172.5, 3.6)),  # Kiribati
    ((176, -9.6), (180, -9.6), (180, -5.5), (176, -5.5)),  # Tuvalu
    ((113.5, 22.1), (114.5, 22.1), (114.5, 22.53), (113.8, 22.5), (113.5, 22.22)),  # Hong Kong, Macau
    # Southern and eastern Africa without Angola, Congo, Rwanda, Burundi
    ((11.7, -17.3), (22, -17.8), (22, -13), (24, -11), (29.8, -12.2), (28.5, -8.4), (30.8, -8.3), (29.3, -6),
     (29.5, -4.45), (30.7, -3), (30.85, -2.3), (30.47, -1.06), (30.15, -1.33), (29.9, -1.45), (29.6, -1.38),
     (29.6, -0.5), (31, 3.7), (36, 4.5), (41, 4), (41.5, -1.7), (42, -27), (16, -36)),
    ((57, -20.6), (58, -20.6), (58, -19.9), (57, -19.9)),  # Mauritius
    ((46, -10.5), (56.5, -10.5), (56.5, -3.5), (51, -3.5)),  # Seychelles
    ((-14.6, -16.1), (-5.5, -16.1), (-5.5, -7.8), (-14.6, -7.8)),  # Saint Helena, Ascension
    ((-61.6, -52.6), (-57.5, -52.6), (-57.5, -50.9), (-61.6, -50.9)),  # Falkland Islands
    ((-65, 32.2), (-64.6, 32.2), (-64.6, 32.45), (-65, 32.45)),  # Bermuda
    ((-81.5, 19.2), (-79.6, 19.2), (-79.6, 19.8), (-81.5, 19.8)),  # Cayman Islands
    ((-78.5, 17.6), (-76.1, 17.6), (-76.1, 18.6), (-78.5, 18.6)),  # Jamaica
    # Bahamas
    ((-79.5, 25), (-77.8, 23.2), (-75.8, 22), (-73.7, 20.7), (-71, 21), (-74, 25), (-76.5, 27.3), (-79.5, 27.3)),
    ((-65.1, 17.6), (-64.2, 17.6), (-64.2, 18.8), (-65.1, 18.8)),  # Virgin Islands
    ((-63.5, 18.15), (-62.9, 18.15), (-62.9, 18.65), (-63.5, 18.65)),  # Anguilla
    ((-62.9, 17.05), (-62.4, 17.05), (-62.4, 17.45), (-62.9, 17.45)),  # Saint Kitts and Nevis
    ((-62.4, 16.6), (-62, 16.6), (-62, 16.95), (-61.5, 16.95), (-61.5, 17.8), (-62.4, 17.8)),  # Montserrat, Antigua
    ((-61.6, 15.15), (-61.2, 15.15), (-61.2, 15.7), (-61.6, 15.7)),  # Dominica
    ((-62, 10), (-60.4, 10), (-59.3, 13), (-60.8, 14.25), (-61.7, 13.5), (-61.9, 12)),  # Windward Islands, Trinidad
    ((-61.4, 6), (-59.8, 8.6), (-54, 6), (-54.5, 2.4), (-60, 1.2)),  # Guyana, Suriname
)  # fmt: skip
"""Rough outlines (longitude, latitude) of lands that drive on the left."""

_COUNTRY = re.compile(
    r"""k=["'](?:addr:country|is_in:country_code|ISO3166-1(?::alpha2)?)["']\s+v=["']([A-Za-z]{2})["']"""
)
_PLACED_REFERENCE = re.compile(rb"<nd\b[^>]*\blat=")
_ROOT = re.compile(rb"<([A-Za-z]\w*)")
_COMMENT = re.compile(rb"<!--.*?(?:-->|$)", re.DOTALL)
_HEAD = 1000
"""Bytes in which a file's first element is looked for."""
_SIDE = re.compile(r"""k=["']driving_side["']\s+v=["'](left|right)["']""")
_NODE = re.compile(r"""<node\b[^>]*?\b(lat|lon)=["'](-?[\d.]+)["'][^>]*?\b(?:lat|lon)=["'](-?[\d.]+)["']""")


def highways_of(osm: Path) -> list[str]:
    """Return the kinds of highways among the ways of a map, such as `residential`, sorted."""
    return sorted({tag.get("v", "") for tag in ET.parse(osm).iterfind("way/tag[@k='highway']")})


def keeps_left(osm: Path) -> bool:
    """Return whether traffic of a map keeps left: by `driving_side`, the country of its addresses, or its place."""
    text = osm.read_text(encoding="utf-8", errors="replace")
    for found, is_left in (
        (_SIDE.findall(text), lambda side: side == "left"),
        (_countries(text), _LEFT_CODES.__contains__),
    ):
        if found:
            return 2 * sum(map(is_left, found)) > len(found)
    node = _NODE.search(text)
    if node is None:
        return False
    lat, lon = (float(node[2]), float(node[3])) if node[1] == "lat" else (float(node[3]), float(node[2]))
    return any(shapely.Polygon(outline).contains(shapely.Point(lon, lat)) for outline in _LEFT_LAND)


def _countries(text: str) -> list[str]:
    return [code.upper() for code in _COUNTRY.findall(text)]


def in_order(osm: Path, source: Path, work: Path) -> Path:
    """Return an OSM XML file whose nodes come before its ways, sorted into a folder if need be.

    Raises:
        ScenarioError: it is another document, such as a page that tells of an error, or a Lanelet2 map, or cannot be
            read.
    """
    text = osm.read_bytes()
    root = _ROOT.search(_COMMENT.sub(b"", text[:_HEAD]))
    if root and root[1] != b"osm":
        raise ScenarioError(complaint(source, "root", "<osm> of an OpenStreetMap extract", f"<{root[1].decode()}>"))
    if b'v="lanelet"' in text and b'k="highway"' not in text:
        expected = "an OpenStreetMap extract, with ways of highways"
        raise ScenarioError(complaint(source, "map", expected, "a Lanelet2 map; import it as OpenDRIVE (.xodr)"))
    if _PLACED_REFERENCE.search(text):
        osm = _with_nodes(osm, source, work)
        text = osm.read_bytes()
    first_way = text.find(b"<way ")
    if first_way < 0 or text.rfind(b"<node ") < first_way:
        return osm
    import osmium  # only these files and binary ones need it

    target = work / "sorted.osm"
    with parsing(source, ".osm file", ScenarioError):
        with osmium.SimpleWriter(osmium.io.File(target, "osm,add_metadata=false"), overwrite=True) as writer:
            for kind in (osmium.osm.NODE, osmium.osm.WAY, osmium.osm.RELATION):
                for element in osmium.FileProcessor(osmium.io.File(str(osm), "osm"), kind):
                    writer.add(element)
    return target


def _with_nodes(osm: Path, source: Path, work: Path) -> Path:
    """Return a file with the nodes that its ways place themselves, as Overpass has them with `out geom`."""
    with parsing(source, ".osm file", ScenarioError):
        root = ET.parse(osm).getroot()
        known = {node.get("id") for node in root.iterfind("node")}
        for place in root.findall("way/nd[@lat]"):
            if (name := place.get("ref", "")) not in known:
                known.add(name)
                ET.SubElement(root, "node", id=name, lat=place.get("lat", ""), lon=place.get("lon", ""))
        target = work / "placed.osm"
        ET.ElementTree(root).write(target)
    return target


def json_to_xml(source: Path, target: Path) -> None:
    """Write Overpass JSON (`out json`, with nodes or with `geom`) as OSM XML.

    Raises:
        ScenarioError: the file is missing or other JSON, such as GeoJSON.
    """
    data = read_bytes(source, "Overpass JSON", ScenarioError)
    with parsing(source, "Overpass JSON", ScenarioError):
        content = json.loads(data)
        if not isinstance(content, dict) or "elements" not in content:
            found = content.get("type", "none") if isinstance(content, dict) else "none"
            raise ScenarioError(complaint(source, "elements", "OpenStreetMap as JSON of the Overpass API", found))
        root = ET.Element("osm", version="0.6")
        for one in content["elements"]:
            if one["type"] not in ("node", "way", "relation"):  # such as its counts
                continue
            names = {key: str(one[key]) for key in ("id", "lat", "lon") if key in one}
            element = ET.SubElement(root, one["type"], names)
            places = one.get("geometry") or [{}] * len(one.get("nodes", ()))
            for node, place in zip(one.get("nodes", ()), places, strict=True):
                at = {key: str(place[key]) for key in ("lat", "lon") if place and key in place}
                ET.SubElement(element, "nd", {"ref": str(node)} | at)
            for member in one.get("members", ()):
                ET.SubElement(element, "member", {key: str(member[key]) for key in ("type", "ref", "role")})
            for key, value in one.get("tags", {}).items():
                ET.SubElement(element, "tag", k=str(key), v=str(value))
        ET.ElementTree(root).write(target)


def pbf_to_xml(source: Path, target: Path) -> None:
    """Write the nodes, ways and relations of a .osm.pbf file as OSM XML.

    Raises:
        ScenarioError: the file is missing, truncated, of another format or larger than `MOST_BYTES` as XML.
    """
    import osmium  # only these files need it

    data = read_bytes(source, ".osm.pbf file", ScenarioError)
    with parsing(source, ".osm.pbf file", ScenarioError):
        count = 0
        with osmium.SimpleWriter(osmium.io.File(target, "osm,add_metadata=false"), overwrite=True) as writer:
            for count, element in enumerate(osmium.FileProcessor(osmium.io.FileBuffer(data, "pbf")), 1):
                writer.add(element)
                if count % _CHECKED_EVERY == 0 and target.stat().st_size > MOST_BYTES:
                    raise ValueError(f"more than {MOST_BYTES} bytes when unpacked")
        if not count:
            raise ValueError("it holds no nodes")
