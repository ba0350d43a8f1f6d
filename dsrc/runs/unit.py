"""What a function that computes results takes: all of the engine that is in the keys of its results."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

Progress = Callable[[int, int], None]
"""Progress callback: (steps done, steps in all)."""

J = TypeVar("J")


@dataclass(frozen=True, slots=True)
class Unit(Generic[J]):
    """Jobs that one worker does, one after the other.

    Attributes:
        folder: of the results.
        jobs: by key.
    """

    folder: Path
    jobs: dict[str, J]


def key_of(settings: object) -> str:
    """Key of a result: hash of all that decides it, 32 hexadecimal digits."""
    return hashlib.sha256(msgspec.json.encode(settings, order="deterministic")).hexdigest()[:32]
