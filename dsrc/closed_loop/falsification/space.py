"""Space of a search: texts of faults with ranges where numbers stand, parameters of encounters, scenarios and seeds.

`control_delay:0..1 from 1..6 s for 0.5..4 s` is a fault of three dimensions. A point of the space is a choice of
scenario, seed and text, and a number from 0 to 1 for each of their dimensions.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple, Self

import msgspec

from dsrc.faults.fault import Faults, faults_text, parse_faults
from dsrc.faults.kinds import CORRUPTION, KINDS
from sim.encounters import ENCOUNTERS
from sim.errors import SettingsError, complaint, did_you_mean
from sim.scenario import Scenario

_NUMBER = r"-?\d+(?:\.\d+)?"
_RANGE = re.compile(rf"(?P<low>{_NUMBER})\.\.(?P<high>{_NUMBER})")
_TIME = re.compile(r"\s(from|to|for)\s+$")
_PLUS = re.compile(r"\s\+\s")
_STEP_S = 0.1
_DIGITS = 3


def tidy(value: float) -> float:
    """Return a number with three digits, as a text of it has them."""
    return float(f"{value:.{_DIGITS}g}")


@dataclass(frozen=True, slots=True)
class Dimension:
    """Range of a number.

    Attributes:
        name: what it is of, for files.
        low, high: its ends.
        weak: end at which a fault does least; None where the number does not say how much, such as a place.
        whole: whole numbers alone.
        step: of which it is a multiple; 0 for any number of three digits.
        part: place of the fault among those of its text; -1 for a parameter of the scenario.
    """

    name: str
    low: float
    high: float
    weak: float | None = None
    whole: bool = False
    step: float = 0.0
    part: int = -1

    def at(self, unit: float) -> float:
        """Return the number at a share of the range."""
        value = self.low + unit * (self.high - self.low)
        if self.whole:
            return float(round(value))
        rounded = round(round(value / self.step) * self.step, 6) if self.step else tidy(value)
        return min(max(rounded, self.low), self.high)

    def strength(self, unit: float) -> float | None:
        """Return how much of a fault it is, 0 at the weak end, 1 at the other one; None where it does not say."""
        if self.weak is None:
            return None
        reach = max(abs(self.low - self.weak), abs(self.high - self.weak))
        return abs(self.at(unit) - self.weak) / reach if reach else 1.0


@dataclass(frozen=True)
class Template:
    """Text of faults with ranges.

    Attributes:
        text: as given.
        dimensions: its ranges, in the order of the text.
    """

    text: str
    dimensions: tuple[Dimension, ...]

    @classmethod
    def parse(cls, text: str, where: str) -> Self:
        """Return the template of a text; one without faults of the text "".

        Raises:
            SettingsError: a range that falls, or no fault at an end of the ranges.
        """
        if not text:
            return cls("", ())
        dimensions: list[Dimension] = []
        for row, part in enumerate(_PLUS.split(text)):
            found = list(_RANGE.finditer(part))
            timed = {match[1]: one for one in found if (match := _TIME.search(part[: one.start()]))}
            for one in found:
                low, high = float(one["low"]), float(one["high"])
                if not low < high:
                    expected = "a range LOW..HIGH that rises"
                    raise SettingsError(complaint(where, f"fault '{text}'", expected, one[0]))
                word = next((name for name, match in timed.items() if match is one), "")
                if word:
                    # A later begin is a shorter fault where the end stays.
                    weak = {"from": None if " for " in part else high, "to": low, "for": low}[word]
                    dimensions.append(Dimension(f"{word} {row}", low, high, weak, False, _STEP_S, row))
                else:
                    dimensions.append(_of_number(part, one, row))
        made = cls(text, tuple(dimensions))
        for units in made.corners():
            made.faults(units)
        return made

    def corners(self) -> Iterator[tuple[float, ...]]:
        """Yield shares of the ranges at which a text may be wrong: all ends of times with all others at one end."""
        times = [one.step > 0.0 for one in self.dimensions]
        for ends in product((0.0, 1.0), repeat=sum(times)):
            for other in (0.0, 1.0):
                left = iter(ends)
                yield tuple(next(left) if timed else other for timed in times)

    def faults(self, units: Sequence[float]) -> Faults:
        """Return the faults at shares of the ranges."""
        if not self.text:
            return ()
        values = iter(f"{one.at(unit):.12g}" for one, unit in zip(self.dimensions, units, strict=True))
        return parse_faults(_RANGE.sub(lambda _: next(values), self.text), "search")

    def size(self, units: Sequence[float]) -> float:
        """Return the size of the faults, 0 to 1: the mean over its parts of how much of each range they take.

        A fault whose ranges say nothing of how much counts as 1.
        """
        if not self.text:
            return 0.0
        parts: list[list[float]] = [[] for _ in _PLUS.split(self.text)]
        for one, unit in zip(self.dimensions, units, strict=True):
            if (strength := one.strength(unit)) is not None:
                parts[one.part].append(strength)
        return sum(sum(own) / len(own) if own else 1.0 for own in parts) / len(parts)


def _of_number(part: str, found: re.Match[str], row: int) -> Dimension:
    """Return the dimension of a number of a fault's own."""
    kind, _, before = part[: found.start()].partition(":")
    settings = KINDS.get(kind, CORRUPTION).settings
    named = re.search(r"(\w+)\s*=\s*$", before)
    name = named[1] if named else next(iter(settings.__struct_fields__), "")
    types = {one.name: one.type for one in msgspec.structs.fields(settings)}
    low, high, idle = float(found["low"]), float(found["high"]), settings.IDLE.get(name, 0.0)
    weak = None if idle is None else min(max(idle, low), high)
    return Dimension(f"{kind}.{name} {row}", low, high, weak, types.get(name) is int, part=row)


class Candidate(msgspec.Struct, frozen=True):
    """Episode that a search asks for.

    Attributes:
        scenario: name or path.
        seed: of the episode.
        fault: text of the faults, "" without any.
        parameters: of the encounter, by name.
    """

    scenario: str
    seed: int
    fault: str = ""
    parameters: tuple[tuple[str, float], ...] = ()

    @property
    def faults(self) -> Faults:
        """Its faults."""
        return parse_faults(self.fault, "search") if self.fault else ()


class Point(NamedTuple):
    """Point of a space.

    Attributes:
        choice: rows of scenario, seed and template.
        units: a share of the range of each dimension, 0 to 1, see `Space.dimensions`.
    """

    choice: tuple[int, int, int]
    units: tuple[float, ...]


@dataclass(frozen=True)
class Space:
    """Space of a search.

    Attributes:
        scenarios: names or paths.
        seeds: of the episodes.
        templates: of the faults, at least one.
        parameters: of the encounters.
    """

    scenarios: tuple[str, ...]
    seeds: tuple[int, ...]
    templates: tuple[Template, ...]
    parameters: tuple[Dimension, ...] = ()

    @cached_property
    def choices(self) -> tuple[tuple[int, int, int], ...]:
        """All choices of scenario, seed and template."""
        counts = len(self.scenarios), len(self.seeds), len(self.templates)
        return tuple(product(*map(range, counts)))  # type: ignore[arg-type]

    def dimensions(self, choice: tuple[int, int, int]) -> tuple[Dimension, ...]:
        """Return the dimensions under a choice: of its template, then the parameters."""
        return (*self.templates[choice[2]].dimensions, *self.parameters)

    def candidate(self, point: Point) -> Candidate:
        """Return the episode of a point."""
        template = self.templates[point.choice[2]]
        own = len(template.dimensions)
        numbers = zip(self.parameters, point.units[own:], strict=True)
        return Candidate(
            self.scenarios[point.choice[0]],
            self.seeds[point.choice[1]],
            faults_text(template.faults(point.units[:own])),
            tuple((one.name, one.at(unit)) for one, unit in numbers),
        )

    def size(self, point: Point) -> float:
        """Return the size of the faults of a point, see `Template.size`."""
        template = self.templates[point.choice[2]]
        return template.size(point.units[: len(template.dimensions)])


def parameters_of(texts: Sequence[str], scenarios: Mapping[str, Scenario]) -> tuple[Dimension, ...]:
    """Return the dimensions of parameters of encounters: `NAME` for the range it is drawn from, or `NAME=LOW..HIGH`.

    Raises:
        SettingsError: a scenario is no encounter or has no such parameter, or a range is none of it.
    """
    found: list[Dimension] = []
    for text in texts:
        name, _, given = text.partition("=")
        if name in (one.name for one in found):
            raise SettingsError(complaint("search", "parameter", "names that differ", name))
        for scenario, content in scenarios.items():
            own = () if content.conflict is None else ENCOUNTERS[content.conflict.kind].parameters
            known = {one.name: one for one in own}
            if name not in known:
                expected = (
                    f"a parameter of the encounter '{scenario}'" if own else f"none, '{scenario}' is no encounter"
                )
                raise SettingsError(complaint("search", "parameter", expected, name, did_you_mean(name, tuple(known))))
            one = known[name]
            own_draw = content.conflict.parameters.get(name) if content.conflict is not None else None
            low, high = own_draw if isinstance(own_draw, tuple) else one.draw
            if given:
                match = _RANGE.fullmatch(given)
                low, high = (float(match["low"]), float(match["high"])) if match else (math.nan, math.nan)
                if not one.low <= low < high <= one.high:
                    expected = f"a range LOW..HIGH within {one.low:g}..{one.high:g}"
                    raise SettingsError(complaint("search", f"parameter '{name}'", expected, given))
            made = Dimension(name, low, high, whole=one.whole)
            if found and found[-1].name == name and found[-1] != made:
                expected = "NAME=LOW..HIGH, since the scenarios have other ranges"
                raise SettingsError(complaint("search", f"parameter '{name}'", expected, text))
            if not found or found[-1].name != name:
                found.append(made)
    return tuple(found)
