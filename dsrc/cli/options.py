"""Command line of a struct: its fields and docstring become options and help.

A field is an option, its line under `Attributes:` the help text, a field that is a struct itself (`Pool`) adds its
options. The lines under `Examples:` end the description. A line that ends with `; default: WORDS` says what None, "" or
() stand for.
"""

import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, make_dataclass
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
from tyro.conf import Positional, arg

from dsrc.options.fields import RENAMED
from sim.errors import SettingsError, option, warn_deprecated

_METAVARS = {bool: "", int: "INT", float: "FLOAT", str: "STR", Path: "PATH"}
_POSITIONAL = get_args(Positional[int])[1]
_ENTRY = re.compile(r"^ {4}(\w+): ", re.MULTILINE)
_DEFAULT = re.compile(r"[;.] default: (.*)\.$", re.DOTALL)


def parse(command: type[msgspec.Struct], prog: str, args: Sequence[str]) -> Any:
    """Return the options in `args`; prints help or a complaint and exits where there are none to return."""
    import tyro

    flat = _flat(command)
    words = _today(flat, args)
    _check_values(command, words)
    return _struct(command, vars(tyro.cli(flat, prog=prog, description=describe(command), args=words)))


def _check_values(command: type[msgspec.Struct], words: Sequence[str]) -> None:
    """Refuse a list without values: the unset variable of a script must not pass as the default."""
    lists = {f"--{name.replace('_', '-')}" for name, kind, _, _ in fields_of(command) if metavar(kind).endswith("...]")}
    for word, following in zip(words, [*words, "--"][1:], strict=True):
        if word in lists and following.startswith("--"):
            raise SettingsError(f"{word}: expected at least one value, found none")


def _today(flat: type, args: Sequence[str]) -> list[str]:
    """Return words of the command line with the options' names of today in place of former ones."""
    known, words = {one.name for one in fields(flat)}, []
    for word in args:
        name, equals, value = word.partition("=")
        new = RENAMED.get(name.removeprefix("--").replace("-", "_"), "") if name.startswith("--") else ""
        if new in known:
            if any(other.partition("=")[0] == option(new) for other in args):
                raise SettingsError(f"{name} and {option(new)} are the same; leave out {name}")
            warn_deprecated(name, option(new))
            word = f"{option(new)}{equals}{value}"
        words.append(word)
    return words


def summary(command: type) -> str:
    """Return the first line of a command's help."""
    return describe(command).partition("\n")[0]


def describe(command: type) -> str:
    """Return a command's help above its options."""
    text, examples, _ = _parts(command)
    return "\n  ".join([f"{text}\n\nexamples:", *examples]) if examples else text


def option_words(name: str, kind: object) -> list[str]:
    """Return an option as it is typed, with its opposite where it is a switch; empty for a positional argument."""
    if _POSITIONAL in get_args(kind):
        return []
    word = name.replace("_", "-")
    return [f"--{word}", f"--no-{word}"] if kind is bool else [f"--{word}"]


def _parts(struct: type) -> tuple[str, list[str], dict[str, str]]:
    """Return the text of a docstring, its examples and the line of each attribute."""
    text, _, listed = cleandoc(struct.__doc__ or "").partition("Attributes:\n")
    text, _, examples = text.partition("Examples:\n")
    pieces = _ENTRY.split(listed)
    lines = {name: " ".join(body.split()) for name, body in zip(pieces[1::2], pieces[2::2], strict=True)}
    shown = [line.strip() for line in examples.strip().splitlines()]
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text.strip()), shown, lines


def fields_of(
    struct: type[msgspec.Struct], defaults: msgspec.Struct | None = None
) -> Iterator[tuple[str, Any, Any, str]]:
    """Yield name, type, default and help of every option of a struct, those of structs in it too."""
    texts: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        texts |= _parts(base)[2]
    hints = get_type_hints(struct, include_extras=True)
    for one in msgspec.structs.fields(struct):
        default = _default(one) if defaults is None else getattr(defaults, one.name)
        if _is_struct(one.type):
            yield from fields_of(one.type, default)
        else:
            yield one.name, hints[one.name], default, texts.get(one.name, "")


def _is_struct(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _default(one: Any) -> Any:
    if one.default_factory is not msgspec.NODEFAULT:
        return one.default_factory()
    return one.default


def _flat(struct: type[msgspec.Struct]) -> type:
    """Return a dataclass of all options for tyro."""
    specs = []
    for name, kind, default, text in fields_of(struct):
        said = _DEFAULT.search(text)
        text = text[: said.start()] + "." if said else text
        settings: dict[str, Any] = {"help": text, "metavar": metavar(kind) or None}
        if said and default in (None, "", ()):
            settings["help_behavior_hint"] = f"(default: {said[1]})"
        settings = {key: value for key, value in settings.items() if value is not None}
        annotated = Annotated[kind, arg(**settings)]  # type: ignore[valid-type]
        specs.append((name, annotated) if default is msgspec.NODEFAULT else (name, annotated, field(default=default)))
    return make_dataclass(struct.__name__, specs, kw_only=True, frozen=True)


def metavar(kind: Any) -> str:
    """Return the word that stands for a value of a type, empty for a switch."""
    parts = get_args(kind)
    if get_origin(kind) in (Union, types.UnionType):
        return "|".join(metavar(part) for part in parts if part is not type(None))
    if get_origin(kind) is Annotated:
        own = [one for one in (getattr(part, "metavar", None) for part in parts[1:]) if one]
        return own[0] if own else metavar(parts[0])
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, parts))}}}"
    if get_origin(kind) is tuple:
        words = [metavar(part) for part in parts if part is not Ellipsis]
        return f"{words[0]} [{words[0]} ...]" if Ellipsis in parts else " ".join(words)
    return _METAVARS[kind]


def _struct(struct: type[msgspec.Struct], values: Mapping[str, object]) -> Any:
    return struct(
        **{
            one.name: _struct(one.type, values) if _is_struct(one.type) else values[one.name]
            for one in msgspec.structs.fields(struct)
        }
    )
