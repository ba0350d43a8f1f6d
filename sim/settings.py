"""Settings, from a TOML file or a command line, as validated structs; the error of a wrong value is one line."""

import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from sim.errors import UserError, complaint, did_you_mean, one_line, warn_deprecated
from sim.reading import parsing, read_text

LARGEST_BYTES = 1 << 24
"""Most bytes of a file of settings."""

T = TypeVar("T")
Settings = TypeVar("Settings", bound=msgspec.Struct)
_PLACE = re.compile(r"^(?P<what>.*?)(?: - at `\$(?P<field>.*)`)?$", re.DOTALL)
_FIELD_FIRST = re.compile(r"[\w.\[\]]+: ")
_ABSENT = re.compile(r"Object missing required field `(?P<name>.*)`")
_SAID = {"float | array": "a number, or [low, high]"}
"""What a user reads in place of msgspec's words."""


def read_toml(
    path: Path, kind: type[Settings], error: type[UserError], former: Mapping[str, str] | None = None
) -> Settings:
    """Read a TOML file into a struct.

    Args:
        kind: struct class; its tables are structs, tuples or dicts of structs.
        error: class of error to raise.
        former: fields of the top level by their former names, which warn.

    Raises:
        UserError: of the class `error`: the file is unreadable, a key unknown, or a value missing or wrong.
    """
    raw = renamed(read_tables(path, error), former or {}, kind.__struct_fields__, path, error)
    for keys, struct in _unknown_keys(raw, kind, ()):
        *where, key = keys
        hint = did_you_mean(str(key), struct.__struct_fields__)
        raise error(complaint(path, dotted(where) or "top level", "known keys only", f"key '{key}'", hint))
    with parsing(path, "TOML file", error):
        return convert(raw, kind, path, error)


def read_tables(path: Path, error: type[UserError]) -> dict[str, Any]:
    """Read a TOML file as plain values.

    Raises:
        UserError: of the class `error`: the file is unreadable, too large or nested too deeply.
    """
    text = read_text(path, "TOML file", error, LARGEST_BYTES)
    with parsing(path, "TOML file", error):
        return tomllib.loads(text)


def renamed(
    values: Mapping[str, T],
    former: Mapping[str, str],
    fields: Collection[str],
    where: Path | str,
    error: type[UserError],
) -> dict[str, T]:
    """Return values by name with today's names in place of former ones; each of those warns.

    Args:
        former: names of today by former ones.
        fields: names of today that are meant; the others stay as they are.
        where: file or command that the values are of, for warning and message; "" for arguments.

    Raises:
        UserError: of the class `error`: a value is there by both names.
    """
    found, place = dict(values), f"{where}: " if where else ""
    for old, new in former.items():
        if old not in found or old in fields or new not in fields:
            continue
        if new in found:
            raise error(f"{place}{old} and {new} are the same; leave out {old}")
        warn_deprecated(f"{place}{old}", new, level=4)
        found[new] = found.pop(old)
    return found


def dotted(keys: Iterable[str | int]) -> str:
    """Return the dotted form of keys: `network.signals[0].phases`."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in keys).lstrip(".")


def convert(
    raw: object, kind: type[T], where: Path | str, error: type[UserError], *, field: str = "", strict: bool = True
) -> T:
    """Convert plain values to a type that msgspec knows: a struct, or a list or dict of structs.

    Args:
        raw: values of the types that TOML and JSON have.
        where: file or command that they are of, for the message.
        error: class of error to raise.
        field: that the values are of, where they are not all of `where`.
        strict: no text is taken for a number.

    Raises:
        UserError: of the class `error`: a value is missing or wrong.
    """
    try:
        return msgspec.convert(raw, kind, strict=strict)
    except msgspec.ValidationError as wrong:
        raise error(_explain(wrong, raw, kind, where, field)) from None
    except UserError as wrong:  # of a struct that checks itself and knows no file
        raise wrong if str(wrong).startswith(f"{where}: ") else error(f"{where}: {wrong}") from None


def _alternatives(kind: Any) -> Iterator[Any]:
    """Yield a type without its annotations, or those of a union of types."""
    if get_origin(kind) is Annotated:
        yield from _alternatives(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for one in get_args(kind):
            yield from _alternatives(one)
    else:
        yield kind


def _below(kind: Any, key: str | int) -> Iterator[Any]:
    """Yield the types that a value of a type may have below a key or an index."""
    for one in _alternatives(kind):
        origin, inner = get_origin(one), get_args(one)
        if origin is dict:
            yield from _alternatives(inner[1])
        elif origin is tuple and str(key).isdigit():
            yield from _alternatives(inner[0] if inner[1:] == (...,) else inner[min(int(key), len(inner) - 1)])
        elif _is_struct(one) and key in (hints := get_type_hints(one)):
            yield from _alternatives(hints[str(key)])


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _unknown_keys(raw: object, kind: Any, where: tuple[str | int, ...]) -> Iterator[tuple[tuple, Any]]:
    """Yield ((path of keys), struct) for every key unknown to the struct of its table."""
    known = next((one for one in _alternatives(kind) if _is_struct(one)), None)
    items = raw.items() if isinstance(raw, dict) else enumerate(raw) if isinstance(raw, list) else ()
    for key, value in items:
        if isinstance(raw, dict) and known is not None and key not in known.__struct_fields__:
            yield (*where, key), known
        for below in _below(kind, key):
            yield from _unknown_keys(value, below, (*where, key))


def _explain(wrong: msgspec.ValidationError, raw: object, kind: object, where: Path | str, outer: str) -> str:
    """Return the one-line form of a msgspec message such as `Expected X, got Y - at `$.a.b[0]``."""
    place = _PLACE.match(_named(str(wrong), raw, kind))
    assert place is not None  # it matches every text
    what, below = place["what"], (place["field"] or "").replace("[...]", "")
    keys = _keys(below)
    field = f"{outer}{below}".lstrip(".")
    if absent := _ABSENT.match(what):
        return complaint(where, f"{field}.{absent['name']}".lstrip("."), "a value", "nothing")
    shown = field or "top level"
    if what.startswith("Invalid enum value"):
        return complaint(where, shown, f"one of {', '.join(map(str, _choices(kind, keys)))}", _found(raw, keys))
    if what.startswith("Expected "):
        expected = what.removeprefix("Expected ").split(", got")[0].replace("`", "").removesuffix(" | null")
        return complaint(where, shown, _SAID.get(expected, expected), _found(raw, keys))
    # A struct's own check begins with the name of its field.
    between = "." if _FIELD_FIRST.match(what) else ": "
    return f"{where}: {one_line(f'{field}{between}{what}' if field else what, 400)}"


def _keys(place: str) -> list[str]:
    return [key for key in place.replace("[", ".").replace("]", "").split(".") if key]


def _found(raw: object, keys: Iterable[str]) -> object:
    for key in keys:
        if isinstance(raw, list | tuple) and key.isdigit():
            raw = raw[int(key)]
        elif isinstance(raw, dict):
            raw = raw.get(key, raw)
    return raw


def _types_at(kind: object, keys: Iterable[str]) -> list[Any]:
    """Return the types that the value at a place may have."""
    found = list(_alternatives(kind))
    for key in keys:
        found = [below for one in found for below in _below(one, key)]
    return found


def _named(message: str, raw: object, kind: object) -> str:
    """Return msgspec's message with the key of the wrong item of a table in place of `[...]`."""
    head, cut, _ = message.partition("[...]")
    if not cut:
        return message
    place = head.partition(" - at `$")[2]
    table = _found(raw, _keys(place))
    for one in _types_at(kind, _keys(place)):
        for key, item in table.items() if isinstance(table, dict) and get_origin(one) is dict else ():
            try:
                msgspec.convert(item, get_args(one)[1], strict=True)
            except msgspec.ValidationError as wrong:
                text, _, pointer = _named(str(wrong), item, get_args(one)[1]).partition(" - at `$")
                return f"{text} - at `${place}.{key}{pointer.removesuffix('`')}`"
    return message


def _choices(kind: object, keys: Iterable[str]) -> tuple:
    """Return the values of a `Literal` at a place."""
    literals = [one for one in _types_at(kind, keys) if get_origin(one) is Literal]
    return get_args(literals[0]) if literals else ()
