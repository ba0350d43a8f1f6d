"""XML of track files, gzipped or not, from bytes in memory; no entities, so nothing that a file names is opened."""

import io
import math
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Iterator
from pathlib import Path

from sim.errors import DataError, complaint
from sim.reading import LARGEST_BYTES, read_bytes


def read_xml_bytes(path: Path, what: str) -> bytes:
    """Return the XML of a file, unpacked where it is gzipped.

    Raises:
        DataError: it is missing, damaged, too large, or declares a document type, which may hold entities.
    """
    content = read_bytes(path, what)
    if content[:2] == b"\x1f\x8b":
        unpacking = zlib.decompressobj(wbits=31)
        try:
            content = unpacking.decompress(content, LARGEST_BYTES)
        except zlib.error as error:
            raise DataError(complaint(path, what, "a whole .gz", str(error))) from None
        if not unpacking.eof:
            raise DataError(complaint(path, what, f"a whole .gz of at most {LARGEST_BYTES} bytes", "another"))
    if b"<!ENTITY" in content:
        raise DataError(complaint(path, what, "no entities", "<!ENTITY"))
    return content


def root_tag(content: bytes) -> str:
    """Return the name of the root of an XML, without its namespace; empty where it is none."""
    try:
        for _, element in ET.iterparse(io.BytesIO(content), ("start",)):
            return element.tag.rpartition("}")[2]
    except (ET.ParseError, ValueError, LookupError):
        pass
    return ""


def children(content: bytes, tag: str) -> Iterator[ET.Element]:
    """Yield the elements of a name below the root one after the other, each only until the next: in bounded memory."""
    parser = ET.iterparse(io.BytesIO(content), ("start", "end"))
    _, root = next(parser)
    for event, element in parser:
        if event == "end" and element.tag == tag:
            yield element
            root.clear()


def number_of(path: Path, field: str, text: str | None) -> float:
    """Return the finite number of an attribute or a text.

    Raises:
        DataError: it is missing or none.
    """
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(complaint(path, field, "a number", text or "nothing"))
    return value
