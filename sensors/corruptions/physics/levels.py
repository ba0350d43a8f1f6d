"""Severities: five levels; 3 is the DSRC paper's setting, or of its strength where the paper gives no number."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import msgspec

from sim.errors import SettingsError

T = TypeVar("T")

SEVERITIES = range(1, 6)
"""Levels of every corruption."""

DEFAULT_SEVERITY = 3
"""Level with the paper's parameters."""


class SeveritySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a kind of corruption: base of the classes of built-in kinds.

    Attributes:
        LEVELS: values of fields at severities 1 to 5; the others have their defaults at each.
        RANGES: least and largest value of fields; None is always allowed.
    """

    LEVELS: ClassVar[Mapping[str, Sequence[Any]]] = {}
    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def __post_init__(self) -> None:
        for field, (low, high) in self.RANGES.items():
            if (value := getattr(self, field)) is not None:
                check_range(type(self).__name__, field, value, low, high)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(**{field: at_level(values, level) for field, values in cls.LEVELS.items()})


class WeatherSettings(SeveritySettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a kind of weather, whose strength drifts.

    Attributes:
        STRENGTH: fields that are proportional to the strength.
    """

    STRENGTH: ClassVar[tuple[str, ...]] = ()

    def scaled(self, factor: float) -> Self:
        """Return the settings at `factor` times the strength, at most the largest of `RANGES`."""
        stronger = {field: min(factor * getattr(self, field), self.RANGES[field][1]) for field in self.STRENGTH}
        return msgspec.structs.replace(self, **stronger)


def at_level(levels: Sequence[T], severity: int) -> T:
    """Return the entry of one severity, of five; SettingsError for another severity."""
    require_severity(severity)
    return levels[severity - 1]


def require_severity(severity: int) -> None:
    """Raise SettingsError unless the severity is one of the five."""
    if severity not in SEVERITIES:
        raise SettingsError(f"severity: expected 1 to 5, found {severity!r}")


def check_range(owner: str, field: str, value: float, low: float, high: float) -> None:
    """Raise SettingsError unless low <= value <= high."""
    if not low <= value <= high:
        raise SettingsError(f"{owner}: {field}: expected {low:g} to {high:g}, found {value:g}")


def proportional_rings(rings: int, of_64: int) -> int:
    """Return the number of `rings` rings in proportion to `of_64` rings of a 64-beam sensor."""
    return min(rings, round(rings * of_64 / 64))
