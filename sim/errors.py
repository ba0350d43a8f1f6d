"""Error classes: one per failure that a user can cause.

The command line prints such an error as one line and exits with code 2; everything else is a bug and keeps its
stack trace. A message names the file, the field, what was expected, what was found and the nearest right name.
"""

import difflib
import logging
import reprlib
import warnings
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

_log = logging.getLogger(__name__)

GOES = "2027-06-01"
"""Date of the release without the names that are deprecated now."""


class UserError(Exception):
    """Failure caused by input: reported in one line, without a stack trace."""


class ScenarioError(UserError):
    """Scenario, or a file that it names, missing or invalid."""


class TrafficError(UserError):
    """Traffic simulation that cannot run as requested."""


class DataError(UserError):
    """Dataset, or one of its files, missing or invalid."""


class CheckpointError(UserError):
    """Checkpoint missing, damaged or of another model."""


class SettingsError(UserError):
    """Setting or command-line value out of its range."""


class OutputError(SettingsError):
    """Output where something is that must not be replaced."""


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return `; did you mean 'x'?` for the nearest of `choices`, else the list of choices."""
    choices = sorted(choices)
    near = difflib.get_close_matches(name, choices, n=1, cutoff=0.5)
    if near:
        return f"; did you mean '{near[0]}'?"
    return f"; one of: {', '.join(choices)}" if choices else ""


def complaint(file: Path | str, field: str, expected: str, found: object, hint: str = "") -> str:
    """Return the one-line message of a bad value: file, field, expected, found and an optional hint.

    What was found is cut to 80 characters before it is written out, however large it is.
    """
    shown = found if isinstance(found, str) else _SHORT.repr(found)
    where = f"{one_line(file, 1000)}: {one_line(field, 200)}"
    return f"{where}: expected {one_line(expected, 1000)}, found {one_line(shown, 80)}{hint}"


def unreadable(file: Path | str, what: str, error: Exception) -> str:
    """Return the one-line message of a file that a parser refuses."""
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return f"{one_line(file, 1000)}: not a readable {what}: {one_line(said, 200) or type(error).__name__}"


@lru_cache(maxsize=64)
def notice(text: str) -> None:
    """Warn of what goes on without something that it lacks or cannot keep.

    Each text is logged once per process: a drive has thousands of sweeps of one kind.
    """
    _log.warning("%s", text)


def option(name: str) -> str:
    """Return a name as it is typed on the command line: `delay_s` is `--delay-s`."""
    return f"--{name.replace('_', '-')}"


def one_line(value: object, most: int) -> str:
    """Return a text of at most so many characters, all in one line and printable."""
    text = str(value)
    cut = " ".join(text[: 4 * most].split())
    cut = "".join(char if char.isprintable() else "?" for char in cut)
    return cut if len(cut) <= most and len(text) <= 4 * most else cut[: most - 3] + "..."


def raised_text(error: BaseException) -> str:
    """Return the one line of what someone's code raised: with its class, but for what a user can cause."""
    said = one_line(error, 1000)
    return said if isinstance(error, UserError) else f"{type(error).__name__}: {said}"


class _Short(reprlib.Repr):
    """Representation of a value in bounded time: a bomb of aliases or a number of 5,000 digits is not written out."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = 200
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = 8

    def repr_int(self, x: int, level: int) -> str:
        """Return an integer, or its size in bits."""
        return repr(x) if x.bit_length() < 300 else f"a whole number of {x.bit_length()} bits"


_SHORT = _Short()


class DeprecatedName(FutureWarning):
    """A former name was used."""


def warn_deprecated(old: str, new: str, goes: str = GOES, level: int = 3) -> None:
    """Warn that a name is deprecated.

    Args:
        old: as the user wrote it: `dsrc.drive`, `--who`, `limit` in a TOML.
        goes: date of the release without it.
        level: frames of the stack up to the user's line.
    """
    warnings.warn(f"{old} is deprecated and goes on {goes}; use {new}", DeprecatedName, stacklevel=level)
