"""YAML of plain values: a deterministic writer and a reader that runs no code.

Some datasets, such as V2V4Real, were dumped with numpy's numbers and arrays, as tags that call functions of numpy on
reading. The reader decodes these tags as numbers and lists, without calling anything.

Floats are written with a dot, also in exponent form (`1.0e-05`), because YAML 1.1 reads `1e-05` as text.
"""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sim.errors import DataError, complaint
from sim.reading import parsing, read_text

Plain = dict | list | tuple | str | int | float | bool | None


def emit(value: Plain, indent: int = 0) -> str:
    """Return a mapping as YAML text, block style for mappings and flow style for lists; keys keep their order.

    Raises:
        ValueError: a number is not finite or a value is no plain Python value.
    """
    if not isinstance(value, dict):
        return _flow(value)
    lines = []
    for key, item in value.items():
        name = " " * indent + _flow(key) + ":"
        if isinstance(item, dict) and item:
            lines.append(name + "\n" + emit(item, indent + 2))
        else:
            lines.append(f"{name} {_flow(item)}\n")
    return "".join(lines)


def _flow(value: Plain) -> str:
    if type(value) is float:
        return _float(value)
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if type(value) is int:
        return str(value)
    if isinstance(value, str):
        plain = _WORD.fullmatch(value) and value.lower() not in _RESERVED
        return value if plain else _quoted(value)
    if isinstance(value, list | tuple):
        if _NUMBERS.fullmatch(text := repr(value)):  # Python's text is YAML's
            return text
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    raise ValueError(f"cannot write {type(value).__name__} {value!r} as YAML")


def _quoted(text: str) -> str:
    """Return a text in double quotes with YAML's escapes, not JSON's, beyond 16 bits and for the sign of deletion."""
    if text.isascii() and "\x7f" not in text:
        return json.dumps(text)
    whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    return '"' + "".join(json.dumps(c)[1:-1] if "\x7f" != c < "\U00010000" else f"\\U{ord(c):08x}" for c in whole) + '"'


_NUMBERS = re.compile(r"[-0-9., \[\]]*")
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = {"y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf"}


def _float(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(f"cannot write {value} as YAML")
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def read_yaml(path: Path) -> dict:
    """Read a YAML mapping of plain values.

    Raises:
        DataError: the file is missing, is not YAML, has an unknown tag or is not a mapping.
    """
    return parse_yaml(path, read_text(path, "YAML file"))


def parse_yaml(path: Path, text: str) -> dict:
    """Parse the text of a file as `read_yaml` does."""
    with parsing(path, "YAML file"):
        value = _blocks(text)
        return _loaded(path, text) if value is None else value


def _loaded(path: Path, text: str) -> dict:
    """Parse any YAML with PyYAML."""
    try:
        _check_bounds(path, text)
        value = yaml.load(text, _Loader)  # noqa: S506 - a safe loader, in C where there is one
    except yaml.constructor.ConstructorError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise DataError(f"{path}: line {line}: expected plain values, found a tag ({error.problem})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise DataError(f"{path}: {where}not YAML: {' '.join(str(problem).split())}") from None
    if not isinstance(value, dict):
        raise DataError(f"{path}: expected a mapping, found {type(value).__name__}")
    return value


def _check_bounds(path: Path, text: str) -> None:
    """Refuse nesting that would overflow the stack of the C loader, and aliases that stand for more than they say."""
    sizes: dict[str, int] = {}
    open_nodes: list[list[Any]] = [["", 0]]
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise DataError(complaint(path, "aliases", "of values that are complete", f"*{event.anchor}"))
            open_nodes[-1][1] += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append([event.anchor, 1])
            if len(open_nodes) > DEEPEST:
                raise DataError(complaint(path, "nesting", f"at most {DEEPEST} levels", "more"))
        elif isinstance(event, yaml.CollectionEndEvent | yaml.ScalarEvent):
            anchor, size = (event.anchor, 1) if isinstance(event, yaml.ScalarEvent) else open_nodes.pop()
            open_nodes[-1][1] += size
            if anchor:
                sizes[anchor] = size
        if open_nodes[-1][1] > MOST_VALUES:
            raise DataError(complaint(path, "values", f"at most {MOST_VALUES} with aliases written out", "more"))


DEEPEST = 64
"""Most levels of a file; OPV2V's have six."""
MOST_VALUES = 2_000_000
"""Most values of a file with its aliases written out; the largest known has 100,000."""

_NUMBER = r"-?(?:\d+\.\d+(?:e[-+]\d+)?|0|[1-9]\d{0,17})"
_OTHER = rf"(?!(?i:{'|'.join(sorted(_RESERVED))})[:\n])[A-Za-z]"
_ENTRY = re.compile(
    rf"( *)({_OTHER}\w*|-?(?:0|[1-9]\d{{0,17}})):"
    rf"(?: ({_NUMBER}|{_OTHER}[\w.]*|\d+(?:,\d+)+|\[\]|true|false|null))?\n"
    rf"((?:\1- {_NUMBER}\n)*)((?:\1- - {_NUMBER}\n(?:\1  - {_NUMBER}\n)*)*)",
    re.ASCII,
)
"""A line of a mapping (indentation, key, scalar) and the list, flat or of lists, in the lines below it."""


def _blocks(text: str) -> dict | None:
    """Return a mapping of mappings, numbers, words and lists of numbers in PyYAML's layout, in an eighth of its time.

    Returns:
        None for any other text.
    """
    found: dict = {}
    levels, place = [(0, found)], 0
    below: dict | None = None
    while place < len(text):
        entry = _ENTRY.match(text, place)
        if entry is None:
            return None
        place = entry.end()
        indent, name, scalar, flat, nested = entry.groups()
        if below is not None:
            if len(indent) <= levels[-1][0]:
                return None
            levels.append((len(indent), below))
        while len(indent) < levels[-1][0]:
            levels.pop()
        if len(indent) != levels[-1][0] or (scalar is not None) + bool(flat) + bool(nested) > 1:
            return None
        value: Plain = None
        below = None
        if flat:
            value = [_value(word) for word in flat.split()[1::2]]
        elif scalar is not None:
            value = _value(scalar)
        elif nested:
            value = _rows(nested)
        else:
            value = below = {}
        levels[-1][1][name if name[0].isalpha() else int(name)] = value
    return found if found and below is None else None


_CONSTANTS = {"true": True, "false": False, "null": None}


def _value(word: str) -> Plain:
    """Return the value of a word of `_ENTRY`."""
    if word[0].isalpha():
        return _CONSTANTS.get(word, word)
    if word == "[]" or "," in word:
        return word if "," in word else []
    return float(word) if "." in word else int(word)


def _rows(lines: str) -> list[list[Plain]]:
    """Return a list of lists; each begins with two dashes."""
    rows: list[list[Plain]] = []
    for line in lines.splitlines():
        *dashes, word = line.split()
        if len(dashes) == 2:
            rows.append([])
        rows[-1].append(_value(word))
    return rows


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Safe loader that reads numpy's numbers and arrays as plain ones."""


_NUMBER_TYPE = re.compile(r"[fiu][1248]|b1")
_PYTHON = "tag:yaml.org,2002:python/"


def _entries(loader: Any, node: Any, *names: str) -> list[Any]:
    """Return the arguments of a tag: a list, or the entries of these names of a mapping."""
    if isinstance(node, yaml.MappingNode):
        table = loader.construct_mapping(node, deep=True)
        return [table.get(name) for name in names]
    return [loader.construct_sequence(node, deep=True), None]


def _number_type(loader: object, node: object) -> np.dtype:
    """Return numpy.dtype(code, ...), its byte order in the state."""
    args, state = _entries(loader, node, "args", "state")
    code = args[0] if isinstance(args, list) and args else None
    order = state[1] if isinstance(state, list) and len(state) > 1 else "<"
    if not isinstance(code, str) or not _NUMBER_TYPE.fullmatch(code) or order not in ("<", ">", "|", "="):
        raise _refused(node, f"numbers of numpy, not of type {code!r}")
    return np.dtype(code if order in ("|", "=") else order + code)


def _scalar(loader: Any, node: Any) -> Plain:
    """Return numpy's scalar(dtype, bytes) as a number."""
    parts = loader.construct_sequence(node, deep=True)
    if len(parts) != 2:
        raise _refused(node, "a number of numpy")
    return _unpacked(node, parts[0], parts[1], ())


def _array(loader: object, node: object) -> Plain:
    """Return numpy's _reconstruct(...) as lists; its state is (version, shape, dtype, Fortran order, bytes)."""
    _, state = _entries(loader, node, "args", "state")
    if not isinstance(state, list) or len(state) != 5:
        raise _refused(node, "an array of numpy")
    _, shape, dtype, fortran, data = state
    if (
        not isinstance(shape, list)
        or not all(type(n) is int and 0 <= n <= MOST_VALUES for n in shape)
        or len(shape) > 8
    ):
        raise _refused(node, "an array of numpy")
    value = _unpacked(node, dtype, data, tuple(shape[::-1] if fortran else shape))
    return np.array(value).T.tolist() if fortran else value


def _unpacked(node: object, dtype: object, data: object, shape: tuple[int, ...]) -> Plain:
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
        raise _refused(node, "numbers of numpy")
    if math.prod(max(n, 1) for n in shape) > MOST_VALUES or len(data) != dtype.itemsize * math.prod(shape):
        raise _refused(node, f"{math.prod(shape)} numbers of numpy in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape).tolist()


def _refused(node: Any, wanted: str) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, f"expected {wanted}", node.start_mark)


for _core in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _Loader.add_constructor(f"{_PYTHON}object/apply:{_core}.scalar", _scalar)
    _Loader.add_constructor(f"{_PYTHON}object/apply:{_core}._reconstruct", _array)
_Loader.add_constructor(f"{_PYTHON}object/apply:numpy.dtype", _number_type)
_Loader.add_constructor(f"{_PYTHON}tuple", lambda loader, node: loader.construct_sequence(node, deep=True))
_Loader.add_constructor(f"{_PYTHON}name:numpy.ndarray", lambda loader, node: None)
