"""JSON of known structure: read into typed structs; an error names file and field of a wrong value."""

import codecs
import re
from pathlib import Path
from typing import TypeVar

import msgspec

from sim.errors import DataError, complaint, one_line
from sim.reading import parsing, read_bytes

_PLACE = re.compile(r"^(?P<what>.*?)(?: - at `\$(?P<field>.*)`)?$", re.DOTALL)
_WRONG = re.compile(r"Expected `(?P<expected>.*)`, got `(?P<found>.*)`")
_ABSENT = re.compile(r"Object missing required field `(?P<name>.*)`")

T = TypeVar("T")


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON file; numbers may be written as text, as DAIR-V2X has some.

    Raises:
        DataError: the file is missing, is not JSON, or a value is missing or of another type.
    """
    return decode_json(path, read_bytes(path, "JSON file"), kind)


def decode_json(path: Path, content: bytes, kind: type[T]) -> T:
    """Return JSON that a file holds; raises as `read_json`."""
    with parsing(path, "JSON file"):
        try:
            return msgspec.json.decode(content.removeprefix(codecs.BOM_UTF8), type=kind, strict=False)
        except msgspec.ValidationError as error:
            raise DataError(_explained(path, str(error))) from None


def _explained(path: Path, message: str) -> str:
    """Return the message of a validation error: file, field, expected, found."""
    place = _PLACE.match(message)
    what, field = (place["what"], (place["field"] or "").lstrip(".")) if place else (message, "")
    absent, wrong = _ABSENT.match(what), _WRONG.match(what)
    if absent:
        return complaint(path, f"{field}.{absent['name']}".lstrip("."), "a value", "nothing")
    if wrong:
        return complaint(path, field or "content", wrong["expected"], wrong["found"])
    return f"{path}: {one_line(field, 200) or 'content'}: {one_line(what, 200)}"


def encode_json(value: object) -> bytes:
    """Return compact JSON with a line end; ValueError for a number that is not finite."""
    text = msgspec.json.encode(value)
    if b"null" in text and _has_nan(msgspec.to_builtins(value)):
        raise ValueError("cannot write a number that is not finite as JSON")
    return text + b"\n"


def _has_nan(value: object) -> bool:
    if isinstance(value, dict):
        return any(_has_nan(item) for item in value.values())
    if isinstance(value, list | tuple):
        return any(_has_nan(item) for item in value)
    return isinstance(value, float) and value - value != 0.0
