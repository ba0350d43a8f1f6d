"""OpenStreetMap binary files (.osm.pbf), converted to OSM XML for netconvert and polyconvert.

Format: https://wiki.openstreetmap.org/wiki/PBF_Format
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from sim.errors import ScenarioError
from sim.reading import parsing, read_bytes

_MEMBER = ("node", "way", "relation")
_NANODEGREE = 1e-9
_LONGEST_VARINT = 70
_LARGEST_BLOB = 1 << 25
MOST_BYTES = 1 << 30
"""Most bytes of a map when unpacked."""

Fields = dict[int, list]
"""Fields of a message: field number -> values in order, int or bytes."""


def pbf_to_xml(source: Path, target: Path) -> None:
    """Write the nodes, ways and relations of a .osm.pbf file as OSM XML.

    Raises:
        ScenarioError: the file is missing, truncated or of another format.
    """
    data = read_bytes(source, ".osm.pbf file", ScenarioError)
    with parsing(source, ".osm.pbf file", ScenarioError):
        blocks = [block for kind, block in _blobs(data) if kind == b"OSMData"]
        lines = [line for element in _ELEMENTS for block in blocks for line in _block(block, element)]
        if not lines:
            raise ValueError("it holds no nodes")
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n'
    target.write_text(head + "".join(lines) + "</osm>\n", encoding="utf-8")


def _blobs(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield (type, content) of the blobs of a file."""
    at = unpacked = 0
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        header = _fields(data[at + 4 : at + 4 + length])
        at += 4 + length
        size = header[3][0]
        if at + size > len(data):
            raise ValueError("it is cut short")
        blob = _fields(data[at : at + size])
        at += size
        if 1 not in blob and 3 not in blob:
            raise ValueError("its blobs are neither plain nor packed by zlib")
        content = blob[1][0] if 1 in blob else _inflated(blob[3][0])
        unpacked += len(content)
        if unpacked > MOST_BYTES:
            raise ValueError(f"more than {MOST_BYTES} bytes when unpacked")
        yield header[1][0], content


def _inflated(packed: bytes) -> bytes:
    """Return the content of a blob, which the format bounds."""
    inflater = zlib.decompressobj()
    content = inflater.decompress(packed, _LARGEST_BLOB)
    if not inflater.eof:
        raise ValueError(f"a blob is cut short, or larger than {_LARGEST_BLOB} bytes when unpacked")
    return content


def _fields(data: bytes) -> Fields:
    """Return the fields of a protocol buffers message."""
    found: Fields = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        value: int | bytes
        if kind == 0:
            value, at = _varint(data, at)
        elif kind == 2:
            length, at = _varint(data, at)
            value, at = data[at : at + length], at + length
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
            value, at = data[at : at + length], at + length
        else:
            raise ValueError(f"field of unknown kind {kind}")
        found.setdefault(key >> 3, []).append(value)
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if shift > _LONGEST_VARINT:
            raise ValueError("a number of more than 64 bits")
        if byte < 0x80:
            return value, at


def _packed(fields: Fields, number: int) -> NDArray[np.int64]:
    """Return the (N,) unsigned integers of a packed field."""
    raw = np.frombuffer(b"".join(fields.get(number, [])), np.uint8)
    last = raw < 0x80
    first = np.concatenate([[True], last[:-1]])[: len(raw)]
    start = np.flatnonzero(first)
    place = np.arange(len(raw)) - np.repeat(start, np.diff(np.append(start, len(raw))))
    parts = (raw & 0x7F).astype(np.int64) << (7 * place)
    return np.add.reduceat(parts, start) if len(start) else np.zeros(0, np.int64)


def _zigzag(values: NDArray[np.int64]) -> NDArray[np.int64]:
    return (values >> 1) ^ -(values & 1)


def _deltas(fields: Fields, number: int) -> list[int]:
    return np.cumsum(_zigzag(_packed(fields, number))).tolist()


def _block(data: bytes, element: int) -> Iterator[str]:
    """Yield the XML of one element type of a block."""
    block = _fields(data)
    strings = [quoteattr(text.decode("utf-8", "replace")) for text in _fields(block[1][0]).get(1, [])]
    granularity = block.get(17, [100])[0] * _NANODEGREE
    lat0, lon0 = (_signed(block.get(number, [0])[0]) * _NANODEGREE for number in (19, 20))
    place = (granularity, lat0, lon0)
    for group in map(_fields, block.get(2, [])):
        for message in map(_fields, group.get(element, [])):
            yield from _ELEMENTS[element](message, strings, place)


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value


def _node(node: Fields, strings: list[str], place: tuple[float, float, float]) -> Iterator[str]:
    lat, lon = (int(_zigzag(np.array([node[number][0]]))[0]) for number in (8, 9))
    number = int(_zigzag(np.array([node[1][0]]))[0])
    yield _node_xml(number, lat, lon, place, _tags(node, strings))


def _dense(dense: Fields, strings: list[str], place: tuple[float, float, float]) -> Iterator[str]:
    words = iter(_packed(dense, 10).tolist())
    for number, lat, lon in zip(_deltas(dense, 1), _deltas(dense, 8), _deltas(dense, 9), strict=True):
        tags = ""
        while key := next(words, 0):
            tags += f"<tag k={strings[key]} v={strings[next(words)]}/>"
        yield _node_xml(number, lat, lon, place, tags)


def _node_xml(number: int, lat: int, lon: int, place: tuple[float, float, float], tags: str) -> str:
    unit, lat0, lon0 = place
    return f'<node id="{number}" lat="{lat0 + unit * lat:.7f}" lon="{lon0 + unit * lon:.7f}">{tags}</node>\n'


def _way(way: Fields, strings: list[str], _place: tuple[float, float, float]) -> Iterator[str]:
    refs = "".join(f'<nd ref="{ref}"/>' for ref in _deltas(way, 8))
    yield f'<way id="{way[1][0]}">{refs}{_tags(way, strings)}</way>\n'


def _relation(relation: Fields, strings: list[str], _place: tuple[float, float, float]) -> Iterator[str]:
    rows = zip(_packed(relation, 10), _deltas(relation, 9), _packed(relation, 8), strict=True)
    members = "".join(f'<member type="{_MEMBER[kind]}" ref="{ref}" role={strings[role]}/>' for kind, ref, role in rows)
    yield f'<relation id="{relation[1][0]}">{members}{_tags(relation, strings)}</relation>\n'


def _tags(message: Fields, strings: list[str]) -> str:
    pairs = zip(_packed(message, 2), _packed(message, 3), strict=True)
    return "".join(f"<tag k={strings[key]} v={strings[value]}/>" for key, value in pairs)


_ELEMENTS = {1: _node, 2: _dense, 3: _way, 4: _relation}
"""Element readers by field number of the group, in the order that XML requires."""
