"""Error classes: one per failure that a user can cause.

The command line prints such an error as one line and exits with code 2; everything else is a bug and keeps its
stack trace. A message names the file, the field, what was expected, what was found and the nearest right name.
"""

import difflib
from collections.abc import Iterable
from pathlib import Path


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
    """Return the one-line message of a bad value: file, field, expected, found and an optional hint."""
    shown = found if isinstance(found, str) else repr(found)
    if len(shown) > 80:
        shown = shown[:77] + "..."
    return f"{file}: {field}: expected {expected}, found {shown}{hint}"


def unreadable(file: Path | str, what: str, error: Exception) -> str:
    """Return the one-line message of a file that a parser refuses."""
    return f"{file}: not a readable {what}: {' '.join(str(error).split())}"
