"""Texts that name a detector, as `--checkpoint` takes them."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

Kind = Literal["file", "onnx", "class", "pipe", "tcp"]

SHIPPED_DETECTOR = Path(__file__).parents[1] / "checkpoints" / "small-dsrc.pt"
NO_COMMAND = "no command: files start no programs; start it before, and name its tcp://localhost:PORT"

_CLASS = re.compile(r"[\w.]+:[^\W\d]\w*")
_PROCESS = re.compile(r"(pipe|tcp):")
_NAMED_PROCESS = re.compile(r"[^=/\\]+=(pipe|tcp):")


def kind_of(text: str) -> Kind:
    """Return what a text names.

    | text | kind |
    |---|---|
    | `pipe:COMMAND ...` | a program that answers on its standard output |
    | `tcp://localhost:PORT` | a program that listens on this machine |
    | `FILE.onnx` | ONNX |
    | `module:Class` | a class of one's own, made without arguments |
    | anything else | a detector file |
    """
    if process := _PROCESS.match(text):
        return "pipe" if process[1] == "pipe" else "tcp"
    if text.endswith(".onnx"):
        return "onnx"
    return "class" if _CLASS.fullmatch(text) else "file"


def split_name(text: str) -> tuple[str, str]:
    """Name and detector of `name=detector`; "" and the detector without a name. Folders and commands may have a `=`."""
    name, equals, what = text.partition("=")
    if _PROCESS.match(text) or not (equals and what):
        return "", text
    named = _NAMED_PROCESS.match(text) or not {"/", "\\"} & set(name)
    return (name, what) if named else ("", text)


def stem_of(text: str) -> str:
    """Return the short name of a detector: of a file, class, script or port."""
    kind = kind_of(text)
    if kind == "class":
        return text.rpartition(":")[2]
    if kind == "tcp":
        return text.removeprefix("tcp:").strip("/")
    if kind == "pipe":
        words = command_of(text) or [text]
        script = next((word for word in words if word.endswith(".py")), words[0])
        return Path(script).stem
    return Path(text).stem


def command_of(text: str) -> list[str]:
    """Return the words of a `pipe:` text; none where its quotes do not close."""
    try:
        return shlex.split(text.removeprefix("pipe:"))
    except ValueError:
        return []


def is_there(text: str) -> bool:
    """Whether a detector can be opened as far as the disk knows: a file that exists, or no file at all."""
    return kind_of(text) not in ("file", "onnx") or Path(text).is_file()


def named(texts: Sequence[str]) -> list[tuple[str, str]]:
    """Names and detectors or folders: the name of `name=text`, else its stem, after its folder where stems repeat."""
    split = [split_name(text) for text in texts]
    stems = [stem_of(text) for name, text in split if not name]

    def name_of(text: str) -> str:
        stem = stem_of(text)
        in_folder = stems.count(stem) > 1 and kind_of(text) in ("file", "onnx")
        return f"{Path(text).absolute().parent.name}/{stem}" if in_folder else stem

    return [(name or name_of(text), text) for name, text in split]
