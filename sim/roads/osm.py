"""OpenStreetMap as netconvert reads it: binary files as XML, nodes first; and the side on which its country drives."""

import re
from pathlib import Path

import shapely

from sim.errors import ScenarioError, complaint
from sim.reading import parsing, read_bytes

MOST_BYTES = 1 << 30
"""Most bytes of a map when unpacked."""
_CHECKED_EVERY = 10_000

_LEFT_CODES = frozenset(
    "AG AU BB BD BN BS BT BW CY DM FJ FK GB GD GG GY HK ID IE IM IN JE JM JP KE KN LC LK LS MO MT MU MV MW MY MZ NA NP "
    "NZ PG PK SB SC SG SR SZ TH TL TO TT TZ UG VC WS ZA ZM ZW".split()
)
"""ISO 3166-1 codes of countries that drive on the left."""

_LEFT_LAND = (
    ((-6.5, 49.7), (-3, 50), (-1, 50.4), (1, 50.7), (1.5, 51.05), (2, 51.5), (2, 53), (0, 61.2), (-9, 60.5), (-11, 51)),
    ((-2.7, 49.1), (-1.95, 49.1), (-1.95, 49.75), (-2.7, 49.75)),  # Channel Islands
    ((14.1, 35.7), (14.65, 35.7), (14.65, 36.15), (14.1, 36.15)),  # Malta
    ((32.2, 34.5), (34.7, 34.5), (34.7, 35.75), (32.2, 35.75)),  # Cyprus
    ((123, 24), (132, 24), (146.5, 43), (145.5, 45.6), (141, 45.7), (136.5, 38), (129.2, 34.8), (127, 30)),  # Japan
    # Pakistan, India, Nepal, Bhutan, Bangladesh, Sri Lanka, Maldives
    ((61, 25), (61, 29.5), (66.5, 31.5), (70, 33), (71.5, 36.5), (77.5, 35.5), (79, 31.5), (81, 30.2), (88, 27.9),
     (97, 28.2), (95, 26), (93.5, 24), (92.4, 21.5), (88, 16), (82, 5), (73, -1), (66, 22)),
    ((98.2, 10), (98.5, 15), (97.5, 18.5), (100, 20.2), (101, 17.7), (104.7, 17.3), (105.4, 14.5), (102.5, 13.5),
     (102.5, 11.8), (99.5, 9)),  # Thailand
    # Malaya, Singapore, Indonesia, Brunei, East Timor, Papua New Guinea, Australia, New Zealand
    ((95, 6), (98, 10), (100.5, 7.5), (104.5, 4), (109, 4), (115.5, 7.2), (119.3, 5), (126, 4.5), (131, 1), (160, -4),
     (180, -12), (180, -48), (110, -48), (94, 0)),
    ((113.5, 22.1), (114.5, 22.1), (114.5, 22.53), (113.8, 22.5), (113.5, 22.22)),  # Hong Kong, Macau
    # Southern and eastern Africa without Angola, Congo, Rwanda, Burundi
    ((11.7, -17.3), (22, -17.8), (22, -13), (24, -11), (29.8, -12.2), (28.5, -8.4), (30.8, -8.3), (29.5, -6),
     (30.9, -2.5), (29.6, -1.2), (31, 3.7), (36, 4.5), (41, 4), (41.5, -1.7), (42, -27), (16, -36)),
    ((57, -20.6), (58, -20.6), (58, -19.9), (57, -19.9)),  # Mauritius
    ((-78.5, 17.6), (-76.1, 17.6), (-76.1, 18.6), (-78.5, 18.6)),  # Jamaica
    ((-79, 22.5), (-73, 21), (-75, 25), (-78.5, 27.3)),  # Bahamas
    ((-62, 10), (-60.5, 10), (-59.3, 13), (-61.5, 18), (-62.9, 17.3), (-61.7, 12)),  # Windward Islands, Trinidad
    ((-61.4, 6), (-59.8, 8.6), (-54, 6), (-54.5, 2.4), (-60, 1.2)),  # Guyana, Suriname
)  # fmt: skip
"""Rough outlines (longitude, latitude) of lands that drive on the left."""

_COUNTRY = re.compile(
    r"""k=["'](?:addr:country|is_in:country_code|ISO3166-1(?::alpha2)?)["']\s+v=["']([A-Za-z]{2})["']"""
)
_SIDE = re.compile(r"""k=["']driving_side["']\s+v=["'](left|right)["']""")
_NODE = re.compile(r"""<node\b[^>]*?\b(lat|lon)=["'](-?[\d.]+)["'][^>]*?\b(?:lat|lon)=["'](-?[\d.]+)["']""")


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
        ScenarioError: it is a Lanelet2 map, or cannot be read.
    """
    text = osm.read_bytes()
    if b'v="lanelet"' in text and b'k="highway"' not in text:
        expected = "an OpenStreetMap extract, with ways of highways"
        raise ScenarioError(complaint(source, "map", expected, "a Lanelet2 map; import it as OpenDRIVE (.xodr)"))
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
