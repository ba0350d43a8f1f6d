"""Parameters of corruptions: the fields of their settings as numbers within bounds, switches and choices."""

import math
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import msgspec

from sensors.corruptions import CORRUPTIONS, Changes, Family
from sensors.corruptions.physics.levels import SEVERITIES
from sim.errors import SettingsError, complaint, did_you_mean

Value = bool | int | float | str


@dataclass(frozen=True, slots=True)
class CorruptionParameter:
    """Field of the settings of a corruption.

    Attributes:
        name: of the field.
        value: at the severity.
        low: least value of a number.
        high: largest value of a number.
        step: of its slider.
        choices: values of what is no number.
    """

    name: str
    value: Value
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0
    choices: tuple[Value, ...] = ()


@lru_cache(maxsize=256)
def parameters_of(kind: str, severity: int, family: Family = "physical") -> tuple[CorruptionParameter, ...]:
    """Parameters of a corruption at a severity, first those that tell the severities apart; none without one.

    A number reaches from its least value to twice that of the strongest severity, within the bounds of the settings.
    What the settings leave to the sensor (None) is left to it.

    Args:
        family: of the settings; one without a model of the kind gives no parameters.
    """
    if kind not in CORRUPTIONS or (family == "paper" and CORRUPTIONS[kind].paper_settings is None):
        return ()
    table = CORRUPTIONS[kind].settings_of(family)
    levels = [table.severity(level) for level in SEVERITIES]
    settings = table.severity(severity)
    if not isinstance(settings, msgspec.Struct):
        return ()
    limits = getattr(type(settings), "RANGES", {})
    varying: list[CorruptionParameter] = []
    steady: list[CorruptionParameter] = []
    for field in msgspec.structs.fields(settings):
        values = [getattr(level, field.name) for level in levels]
        made = _parameter(field.name, field.type, getattr(settings, field.name), values, limits.get(field.name))
        if made is not None:
            (varying if len(set(values)) > 1 else steady).append(made)
    return (*varying, *steady)


def _parameter(
    name: str, kind: Any, value: Any, levels: Sequence[Any], limits: tuple[float, float] | None
) -> CorruptionParameter | None:
    """Parameter of a field; None for what is left to the sensor and for free text."""
    if isinstance(value, bool):
        return CorruptionParameter(name, value, choices=(False, True))
    if isinstance(value, int | float):
        low, high = _bounds([level for level in levels if level is not None], limits or (-math.inf, math.inf))
        whole = isinstance(value, int)
        step = max(1.0, _round_step(high - low)) if whole else _round_step(high - low)
        return CorruptionParameter(name, value, low, high, step)
    choices = _choices(kind)
    return CorruptionParameter(name, value, choices=choices) if value in choices else None


def _choices(kind: object) -> tuple[Value, ...]:
    """Values of a literal type, also of an optional one; none for other types."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return tuple(value for part in typing.get_args(kind) for value in _choices(part))
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


def _bounds(values: Sequence[float], limits: tuple[float, float]) -> tuple[float, float]:
    """Bounds of a slider: twice the values of the severities, all that is allowed where these are 0."""
    least, most = min(values), max(values)
    low, high = 2.0 * min(least, 0.0), 2.0 * max(most, 0.0)
    if least == most == 0.0:
        low, high = (end if math.isfinite(end) else default for end, default in zip(limits, (0.0, 1.0), strict=True))
    return max(low, limits[0]), min(high, limits[1])


def _round_step(span: float) -> float:
    """Step of 1, 2 or 5 times a power of ten that makes 100 to 250 of a span."""
    if span <= 0.0:
        return 1.0
    fine = span / 250.0
    power = 10.0 ** math.floor(math.log10(fine))
    return power * next(factor for factor in (1, 2, 5, 10) if factor * power >= fine * (1.0 - 1e-9))


def changed(changes: Changes, name: str, value: Value, known: Sequence[CorruptionParameter]) -> Changes:
    """Changes with one more, in the order of the parameters; one with the severity's own value is dropped."""
    values = {**dict(changes), name: value}
    return tuple((one.name, values[one.name]) for one in known if values.get(one.name, one.value) != one.value)


def parse_change(text: str, known: Sequence[CorruptionParameter], where: str) -> tuple[str, Value]:
    """Parameter and value of `name:value`.

    Args:
        where: begins the message of an error.

    Raises:
        SettingsError: the parameter is unknown, or the value none of its type.
    """
    name, _, value = text.partition(":")
    parameter = next((one for one in known if one.name == name), None)
    if parameter is None:
        names = [one.name for one in known]
        raise SettingsError(
            complaint(where, "parameters", ", ".join(names) or "none", name or "none", did_you_mean(name, names))
        )
    if parameter.choices:
        found = next((choice for choice in parameter.choices if str(choice) == value), None)
        if found is None:
            raise SettingsError(complaint(where, name, ", ".join(map(str, parameter.choices)), value))
        return name, found
    try:
        return name, type(parameter.value)(value)
    except ValueError:
        expected = "a whole number" if isinstance(parameter.value, int) else "a number"
        raise SettingsError(complaint(where, name, expected, value)) from None
