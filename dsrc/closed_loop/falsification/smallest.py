"""Smallest fault that still crashes, and the neighbourhood of a fault.

Faults are left out one by one (delta debugging: Zeller and Hildebrandt 2002), shortened and weakened by bisections
between what crashes and what does nothing. Outcomes need not be monotone: what comes out crashes, and what was tried
between it and nothing did not.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from msgspec.structs import fields, replace

from dsrc.closed_loop.falsification.space import tidy
from dsrc.faults.fault import Fault, Faults

Crashes = Callable[[Faults], bool]
"""Whether the episode with some faults crashes."""

NEAR = 0.1
"""Relative change of a number in the neighbourhood."""
_TIME_S = 0.2
"""Width at which the bisection of a time ends, s."""
_SHARE = 0.05
"""Width at which the bisection of a number ends, as a share of its distance from what does nothing."""


def smallest(faults: Faults, crashes: Crashes, end_s: float) -> Faults:
    """Return faults that crash, none of which can be left out, shortened or weakened much by itself.

    Args:
        faults: that crash.
        crashes: asked for each try.
        end_s: end of the episode; what comes after it does not matter.
    """
    if crashes(()):
        return ()
    for fault in faults:
        fewer = tuple(one for one in faults if one is not fault)
        if fewer and crashes(fewer):
            faults = fewer
    for row in range(len(faults)):
        faults = _with(faults, row, _shorter(faults, row, crashes, end_s))
        for name in _amounts(faults[row]):
            faults = _with(faults, row, _weaker(faults, row, name, crashes))
    return faults


def neighbours(faults: Faults) -> Iterator[Faults]:
    """Yield faults with one number changed by a tenth to either side, of whole numbers by one at least."""
    for row, fault in enumerate(faults):
        for name, whole in _numbers(fault):
            value, (low, high) = getattr(fault.settings, name), fault.settings.RANGES.get(name, (-math.inf, math.inf))
            for sign in (-1.0, 1.0):
                by = max(1, round(NEAR * value)) if whole else NEAR * value
                near = min(max(value + sign * by, low), high)
                near = int(near) if whole else tidy(near)
                if near != value:
                    yield _with(faults, row, _set(fault, name, near))
        for name in ("from_s", "to_s"):
            value = getattr(fault, name)
            for factor in (1.0 - NEAR, 1.0 + NEAR) if 0.0 < value < math.inf else ():
                near = replace(fault, **{name: round(factor * value, 1)})
                if near != fault and near.from_s < near.to_s:
                    yield _with(faults, row, near)


def _with(faults: Faults, row: int, fault: Fault) -> Faults:
    return (*faults[:row], fault, *faults[row + 1 :])


def _set(fault: Fault, name: str, value: float) -> Fault:
    return replace(fault, settings=replace(fault.settings, **{name: value}))


def _numbers(fault: Fault) -> list[tuple[str, bool]]:
    """Return names of a fault's numbers and whether each is whole, but for a 0 that does nothing or has no scale."""
    own = fault.settings
    kinds = {one.name: one.type for one in fields(own)}
    return [
        (name, kind is int)
        for name, kind in kinds.items()
        if kind in (int, float) and (getattr(own, name) or own.IDLE.get(name, 0.0) not in (0.0, math.inf, None))
    ]


@dataclass(frozen=True, slots=True)
class _Scale:
    """Scale of a number on which 0 does nothing: its distance from there, or its inverse where that is at infinity."""

    idle: float

    def to(self, value: float) -> float:
        return 1.0 / value if self.idle == math.inf else value - self.idle

    def back(self, amount: float) -> float:
        return 1.0 / amount if self.idle == math.inf else self.idle + amount


def _amounts(fault: Fault) -> list[str]:
    """Return the names of the numbers that say how much."""
    idle = fault.settings.IDLE
    return [name for name, _ in _numbers(fault) if idle.get(name, 0.0) is not None]


def _weaker(faults: Faults, row: int, name: str, crashes: Crashes) -> Fault:
    """Return a fault with a number as close to what does nothing as still crashes."""
    fault = faults[row]
    idle = fault.settings.IDLE.get(name, 0.0)
    assert idle is not None
    scale, value = _Scale(idle), getattr(fault.settings, name)
    whole, (low, high) = isinstance(value, int), fault.settings.RANGES.get(name, (-math.inf, math.inf))
    strong, weak = scale.to(value), 0.0
    width = 1.0 if whole else _SHARE * abs(strong)
    while abs(strong - weak) > width:
        middle = 0.5 * (strong + weak)
        tried = math.floor(scale.back(middle)) if whole else tidy(scale.back(middle))
        if not low <= tried <= high:
            weak = middle
            continue
        near = _set(fault, name, tried)
        if crashes(_with(faults, row, near)):
            fault, strong = near, scale.to(tried) if whole else middle
        else:
            weak = scale.to(tried) if whole else middle
    return fault


def _shorter(faults: Faults, row: int, crashes: Crashes, end_s: float) -> Fault:
    """Return a fault that begins as late and ends as early as still crashes."""
    fault = faults[row]
    for name, weak, strong in (
        ("to_s", fault.from_s, min(fault.to_s, end_s)),
        ("from_s", min(fault.to_s, end_s), fault.from_s),
    ):
        weak = fault.to_s if name == "from_s" and fault.to_s < math.inf else weak
        while abs(strong - weak) > _TIME_S:
            middle = round(0.5 * (strong + weak), 1)
            if middle in (strong, weak):
                break
            near = replace(fault, **{name: middle})
            if near.from_s < near.to_s and crashes(_with(faults, row, near)):
                fault, strong = near, middle
            else:
                weak = middle
    return fault
