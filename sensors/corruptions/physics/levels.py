"""Severities: five levels; 3 is the DSRC paper's setting, or of its strength where the paper gives no number."""

from collections.abc import Sequence
from typing import TypeVar

from sim.errors import SettingsError

T = TypeVar("T")

SEVERITIES = range(1, 6)
"""Levels of every corruption."""

DEFAULT_SEVERITY = 3
"""Level with the paper's parameters."""


def at_level(levels: Sequence[T], severity: int) -> T:
    """Return the entry of one severity, of five; SettingsError for another severity."""
    require_severity(severity)
    return levels[severity - 1]


def require_severity(severity: int) -> None:
    """Raise SettingsError unless the severity is one of the five."""
    if severity not in SEVERITIES:
        raise SettingsError(f"corruption severity: expected 1 to 5, found {severity}")


def check_range(owner: str, field: str, value: float, low: float, high: float) -> None:
    """Raise SettingsError unless low <= value <= high."""
    if not low <= value <= high:
        raise SettingsError(f"{owner}: {field}: expected {low:g} to {high:g}, found {value:g}")


def proportional_rings(rings: int, of_64: int) -> int:
    """Return the number of `rings` rings in proportion to `of_64` rings of a 64-beam sensor."""
    return min(rings, round(rings * of_64 / 64))
