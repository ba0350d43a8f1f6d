"""Fleet of a scenario: types, sizes and body models of its road users, as functions of their names and the seed.

In worlds of version 1 a type has one size and a class some models. In those of version 2 every road user has a size of
its own, and shape, panes, paint or clothes are drawn with it; actors of encounters keep the sizes of their script.
"""

from dataclasses import dataclass, replace

import numpy as np

from sim.bodies.choice import choose_model
from sim.bodies.varied.looks import draw, draw_look
from sim.bodies.varied.types import REACH, VARIED, VariedType
from sim.bodies.vehicle_types import TYPES, VehicleType, types_of
from sim.scenario import Scenario
from sim.streams import Stream, random_generator

_OWN = "~"
"""Between the name of a type and that of the road user whose size it has."""

_ALIKE = 0.7
"""Share by which the three lengths of a road user deviate together: a long car is wide and tall."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Road users of a scenario and a seed.

    Attributes:
        varied: those of a world of version 2.
        seed: root seed.
    """

    varied: bool
    seed: int

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> "Fleet":
        """Return the fleet of a scenario's world."""
        return cls(scenario.uneven, seed)

    def types(self) -> list[VehicleType]:
        """Return all types; sizes are means in a varied fleet."""
        return [one.kind for one in VARIED.values()] if self.varied else list(TYPES.values())

    def types_of(self, label: str) -> list[VehicleType]:
        """Return the types of one label, in the order of the table."""
        return [kind for kind in self.types() if kind.label == label] if self.varied else types_of(label)

    def largest(self, kind: VehicleType) -> tuple[float, float, float]:
        """Return the largest length, width and height of a type, m."""
        return VARIED[kind.name].largest if self.varied else kind.size

    def own(self, kind: VehicleType, name: str) -> VehicleType:
        """Return the type of the road user `name`: its own in a varied fleet, of its own size and name."""
        if not self.varied:
            return kind
        one = VARIED[kind.name]
        return replace(kind, name=f"{kind.name}{_OWN}{name}", size=_size(one, name, self.seed))

    def by_id(self, type_id: str) -> VehicleType:
        """Return the type of an id that `own` gave; KeyError for another one."""
        if not self.varied:
            return TYPES[type_id]
        kind, _, name = type_id.partition(_OWN)
        return self.own(VARIED[kind].kind, name)

    def model(self, kind: VehicleType, name: str) -> str:
        """Return the body model of the road user `name`; of a type without a shape, one that its size fits."""
        if not self.varied:
            return choose_model(kind.label, name, self.seed)
        rng = random_generator(self.seed, Stream.ROAD_USER, name, 1)
        one = VARIED[kind.name.partition(_OWN)[0]] if _OWN in kind.name else _likely(kind.label, kind.size, rng)
        return f"{one.shape}/{draw(dict(one.variants), rng)}:{draw_look(one.looks, rng)}"


def _size(one: VariedType, name: str, seed: int) -> tuple[float, float, float]:
    rng = random_generator(seed, Stream.ROAD_USER, name, 0)
    together, apart = rng.normal(), rng.normal(size=3)
    deviation = np.clip(_ALIKE * together + np.sqrt(1.0 - _ALIKE**2) * apart, -REACH, REACH)
    length, width, height = (np.array(one.kind.size) + deviation * one.spread).round(2).tolist()
    return length, width, height


def _likely(label: str, size: tuple[float, float, float], rng: np.random.Generator) -> VariedType:
    """Return a type of a label, drawn by how likely a size is among its own; spreads count at least 5 % of the mean."""
    kinds = [one for one in VARIED.values() if one.kind.label == label]
    mean = np.array([one.kind.size for one in kinds])
    spread = np.maximum([one.spread for one in kinds], 0.05 * mean)
    surprise = 0.5 * (((np.array(size) - mean) / spread) ** 2).sum(axis=1) + np.log(spread).sum(axis=1)
    weight = np.array([one.kind.weight for one in kinds]) * np.exp(surprise.min() - surprise)
    return kinds[int(rng.choice(len(kinds), p=weight / weight.sum()))]
