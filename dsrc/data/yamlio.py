"""YAML of plain values: a small deterministic writer and a reader that never executes anything.

Floats are written with a dot, also in exponent form (`1.0e-05`), because YAML 1.1 reads `1e-05` as text.
"""

import json
import math
import re
from pathlib import Path

import yaml

from sim.errors import DataError

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
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if type(value) is int:
        return str(value)
    if type(value) is float:
        return _float(value)
    if isinstance(value, str):
        plain = _WORD.fullmatch(value) and value.lower() not in _RESERVED
        return value if plain else json.dumps(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    raise ValueError(f"cannot write {type(value).__name__} {value!r} as YAML")


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
        DataError: the file is missing, is not YAML, holds a Python tag or is no mapping.
    """
    return parse_yaml(path, read_text(path))


def read_text(path: Path) -> str:
    """Read UTF-8 text; DataError when the file is missing or holds other bytes."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"{path}: file not found") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: expected UTF-8 text, found other bytes") from None
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from None


def parse_yaml(path: Path, text: str) -> dict:
    """Parse the text of a file as `read_yaml` does."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        value = yaml.load(text, loader)  # noqa: S506 - a safe loader, in C where there is one
    except yaml.constructor.ConstructorError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise DataError(f"{path}: line {line}: expected plain values, found a tag ({error.problem})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise DataError(f"{path}: {where}not YAML: {' '.join(str(problem).split())}") from None
    except (ValueError, AttributeError, RecursionError) as error:
        # The library's own converters: a date of month 99, `0x` without digits.
        raise DataError(f"{path}: expected plain values, found one that cannot be read ({error})") from None
    if not isinstance(value, dict):
        raise DataError(f"{path}: expected a mapping, found {type(value).__name__}")
    return value
