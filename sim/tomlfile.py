"""TOML settings: read into validated structs, with one-line errors."""

import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from sim.errors import UserError, complaint, did_you_mean
from sim.reading import parsing, read_text

LARGEST_BYTES = 1 << 24
"""Most bytes of a file of settings."""

Settings = TypeVar("Settings", bound=msgspec.Struct)


def read_toml(path: Path, kind: type[Settings], error: type[UserError]) -> Settings:
    """Read a TOML file into a struct.

    Args:
        path: of the file.
        kind: struct class; its tables are structs, tuples or dicts of structs.
        error: class of error to raise.

    Raises:
        UserError: of the class `error`: the file is unreadable, a key unknown, or a value missing or wrong.
    """
    raw = read_tables(path, error)
    for keys, struct in _unknown_keys(raw, kind, ()):
        *where, key = keys
        hint = did_you_mean(str(key), struct.__struct_fields__)
        raise error(complaint(path, dotted(where) or "top level", "known keys only", f"key '{key}'", hint))
    with parsing(path, "TOML file", error):
        try:
            return msgspec.convert(raw, kind, strict=True)
        except msgspec.ValidationError as wrong:
            raise error(_explain(path, raw, kind, _named(raw, kind) or str(wrong))) from None


def read_tables(path: Path, error: type[UserError]) -> dict[str, Any]:
    """Read a TOML file as plain values.

    Raises:
        UserError: of the class `error`: the file is unreadable, too large or nested too deeply.
    """
    text = read_text(path, "TOML file", error, LARGEST_BYTES)
    with parsing(path, "TOML file", error):
        return tomllib.loads(text)


def dotted(keys: Iterable[str | int]) -> str:
    """Return the dotted form of keys: `network.signals[0].phases`."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in keys).lstrip(".")


def _unknown_keys(raw: object, kind: Any, where: tuple[str | int, ...]) -> Iterator[tuple[tuple, Any]]:
    """Yield ((path of keys), struct) for every key unknown to the struct of its table."""
    if isinstance(raw, list) and get_origin(kind) is tuple:
        for index, item in enumerate(raw):
            yield from _unknown_keys(item, get_args(kind)[0], (*where, index))
    if isinstance(raw, dict) and get_origin(kind) is dict:
        for key, item in raw.items():
            yield from _unknown_keys(item, get_args(kind)[1], (*where, key))
    if not isinstance(raw, dict) or not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
        return
    hints = get_type_hints(kind)
    for key, value in raw.items():
        if key not in hints:
            yield (*where, key), kind
        else:
            yield from _unknown_keys(value, hints[key], (*where, key))


def _named(raw: dict, kind: type[msgspec.Struct]) -> str:
    """Return msgspec's message of an error below a table of tables, with its key in place of `[...]`; "" elsewhere."""
    for name, hint in get_type_hints(kind).items():
        below = raw.get(name)
        if get_origin(hint) is dict and isinstance(below, dict):
            for key, item in below.items():
                try:
                    msgspec.convert(item, get_args(hint)[1], strict=True)
                except msgspec.ValidationError as wrong:
                    text, _, pointer = str(wrong).partition(" - at ")
                    return f"{text} - at `$.{name}.{key}{pointer.strip('`').removeprefix('$')}`"
    return ""


def _explain(path: Path, raw: dict, kind: type[msgspec.Struct], message: str) -> str:
    """Return the one-line form of a msgspec message `Expected X, got Y - at `$.a.b[0]``."""
    text, _, pointer = message.partition(" - at ")
    field = pointer.strip("`").removeprefix("$").lstrip(".").replace("[...]", "")
    if "missing required field" in text:
        missing = text.split("`")[1]
        return complaint(path, f"{field}.{missing}".lstrip("."), "a value", "nothing")
    keys = field.replace("[", ".").replace("]", "").split(".")
    found: object = raw
    for key in keys:
        if isinstance(found, list) and key.isdigit():
            found = found[int(key)]
        elif isinstance(found, dict):
            found = found.get(key, found)
    if text.startswith("Invalid enum value"):
        expected = f"one of {', '.join(map(str, _choices(kind, keys)))}"
    else:
        expected = text.removeprefix("Expected ").split(", got")[0].replace("`", "")
    return complaint(path, field or "top level", expected, found)


def _choices(kind: Any, keys: Iterable[str]) -> tuple:
    """Return the values of a `Literal` below a type, those of the items of a tuple or dict included."""
    for key in keys:
        while get_origin(kind) in (Annotated, tuple, dict):
            kind = get_args(kind)[get_origin(kind) is dict]
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            kind = get_type_hints(kind).get(key, kind)
    while get_origin(kind) in (Annotated, tuple, dict):
        kind = get_args(kind)[get_origin(kind) is dict]
    literals = [one for one in (kind, *get_args(kind)) if get_origin(one) is Literal]
    return get_args(literals[0]) if literals else ()
