"""Reader of untrusted files, under test."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Target:
    """Reader under test.

    Attributes:
        name: in messages.
        path: file that is mutated; all others stay.
        read: reads it by its path, as a command would.
        kind: of its mutations, see `mutated`.
        is_file: it is a file to the reader too, not words of a command.
    """

    name: str
    path: Path
    read: Callable[[Path], object]
    kind: str = "bytes"
    is_file: bool = True
