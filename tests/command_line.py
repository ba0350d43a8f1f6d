"""All of `--help` as text that no terminal, Python or tyro changes; `python -m tests.command_line` writes it anew.

It is made of the structs that the help is made of, one line an option.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from dsrc.cli import options
from dsrc.cli.main import commands

FROZEN = Path(__file__).parent / "fixtures" / "command_line.txt"
RENEW = "python -m tests.command_line"


def command_line() -> str:
    """Return name, description and options of every command."""
    return "\n\n".join("\n".join(_lines(words, command)) for words, command in commands()) + "\n"


def _lines(words: tuple[str, ...], command: type[msgspec.Struct]) -> Iterator[str]:
    yield f"dsrc {' '.join(words)}"
    yield from options.describe(command).splitlines()
    for name, kind, default, text in options.fields_of(command):
        yield f"  {_option(name, kind)} ({_said(default)}): {text}"


def _option(name: str, kind: Any) -> str:
    return f"{', '.join(options.option_words(name, kind))} {options.metavar(kind)}".strip()


def _said(default: Any) -> str:
    if default is msgspec.NODEFAULT:
        return "required"
    if isinstance(default, tuple):
        return " ".join(map(str, default)) or "none"
    return "none" if default in (None, "") else str(default)


if __name__ == "__main__":
    FROZEN.write_text(command_line())
