"""What one encounter consists of: roads, things that stand beside them, actors with their ways, roadside units."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.encounters.lane_paths import Street
from sim.encounters.networks import Roads
from sim.encounters.paths import Pace, Way
from sim.scenario import Area, RoadsideUnit
from sim.vehicle_types import TYPES, VehicleType

Role = Literal["ego", "conflict", "occluder", "helper", "jam", "other"]
"""What actors are there for; a `jam` stands because of the conflict actor, and goes when that goes."""

HIT_S = 6.0
"""When ego and conflict actor reach the place where their ways cross, s after the start."""


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """One scripted road user.

    Attributes:
        name: unique; `ego` and `conflict` are those.
        roles: what it is there for.
        type_name: one of `sim.vehicle_types.TYPES`.
        way: of the middle of its footprint.
        start_m: where on its way it is at time 0, m; may be negative, before it appears.
        pace: its speed.
        size: length, width, height instead of the type's, m.
        lights: (bits of signals, from, to): indicators and the like, s.
        parked: stands with its engine off: no brake lights.
    """

    name: str
    roles: frozenset[Role]
    type_name: str
    way: Way
    start_m: float
    pace: Pace
    size: tuple[float, float, float] | None = None
    lights: tuple[tuple[int, float, float], ...] = ()
    parked: bool = False

    @property
    def kind(self) -> VehicleType:
        """Its type, of its own size."""
        kind = TYPES[self.type_name]
        return kind if self.size is None else replace(kind, size=self.size)

    def place(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where on its way it is when nothing disturbs it, m."""
        return self.start_m + self.pace.distance(time_s)


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Something solid beside the road.

    Attributes:
        kind: what it looks like.
        outline: footprint in the world, m.
        height_m: of its top above the road.
        occluder: hides the conflict, and goes away in the control without an occluder.
    """

    kind: Literal["building", "hedge", "wall"]
    outline: shapely.Polygon
    height_m: float
    occluder: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Ghost:
    """A road user that a helper claims and that is not there.

    Attributes:
        actor: what is claimed; its name is `ghost`.
        claimed_by: name of the helper, or `roadside` for the first roadside unit.
    """

    actor: Actor
    claimed_by: str


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """An encounter as its scenario draws it, complete and without a control.

    Attributes:
        roads: the road network; None when the scenario names one.
        actors: the ego first.
        structures: solid things.
        units: roadside units.
        focus: (2,) where it happens, m.
        reach_m: the part of the world that matters extends so far from the focus.
        clear: no houses, trees or lamps are made up here, which would hide what the scenario means to show.
    """

    roads: Roads | None
    actors: tuple[Actor, ...]
    structures: tuple[Structure, ...] = ()
    units: tuple[RoadsideUnit, ...] = ()
    focus: tuple[float, float] = (0.0, 0.0)
    reach_m: float = 80.0
    clear: shapely.Geometry = field(default_factory=shapely.Polygon)


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """One drawn encounter, its control applied.

    Attributes:
        kind: id of the scenario.
        parameters: the drawn values.
        layout: roads, actors and structures that are there.
        ghosts: what is claimed and is not there.
    """

    kind: str
    parameters: dict[str, float]
    layout: Layout
    ghosts: tuple[Ghost, ...] = ()

    @property
    def area(self) -> Area:
        """(x_min, y_min, x_max, y_max) of the part of the world that matters, m."""
        (x, y), reach = self.layout.focus, self.layout.reach_m
        return (x - reach, y - reach, x + reach, y + reach)

    def names(self, role: Role) -> tuple[str, ...]:
        """Return the names of the actors of a role, in their order."""
        return tuple(actor.name for actor in self.layout.actors if role in actor.roles)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that varies between the instances of a scenario.

    Attributes:
        name: key in the scenario file, with its unit.
        low: least that is accepted.
        high: most.
        draw: range that it is drawn from when the file does not say.
        what: its meaning in a few words.
        whole: drawn and given as a whole number.
    """

    name: str
    low: float
    high: float
    draw: tuple[float, float]
    what: str
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Kind:
    """A scenario: its parameters and how it is laid out.

    Attributes:
        summary: what happens, in a line.
        parameters: what varies.
        lay_out: drawn values and random numbers for the looks -> the encounter.
        roles: whose ways a scenario names when it is to happen on a map; none when it cannot.
        on_streets: the same along those ways.
    """

    summary: str
    parameters: tuple[Parameter, ...]
    lay_out: Callable[[Mapping[str, float], np.random.Generator], Layout]
    roles: tuple[str, ...] = ()
    on_streets: Callable[[Mapping[str, float], np.random.Generator, Mapping[str, Street]], Layout] | None = None


def actor(
    name: str,
    roles: str,
    type_name: str,
    way: Way,
    pace: Pace | float,
    *,
    at_m: float,
    at_s: float = 0.0,
    size: tuple[float, float, float] | None = None,
    lights: tuple[tuple[int, float, float], ...] = (),
) -> Actor:
    """Return an actor that is `at_m` along its way at time `at_s`.

    Args:
        name: see `Actor`.
        roles: separated by spaces.
        type_name: see `Actor`.
        way: see `Actor`.
        pace: or one speed, m/s.
        at_m: place on the way, m.
        at_s: when it is there, s.
        size: see `Actor`.
        lights: see `Actor`.
    """
    steady = pace if isinstance(pace, Pace) else Pace.steady(pace)
    start_m = at_m - float(steady.distance(at_s))
    return Actor(name, frozenset(roles.split()), type_name, way, start_m, steady, size, lights)  # type: ignore[arg-type]


def standing(
    name: str,
    roles: str,
    type_name: str,
    x: float,
    y: float,
    heading: float = 0.0,
    *,
    size: tuple[float, float, float] | None = None,
    lights: int = 0,
    parked: bool = False,
) -> Actor:
    """Return an actor that stands with the middle of its footprint at (x, y)."""
    c, s = np.cos(heading), np.sin(heading)
    way = Way.through(np.array([[x - c, y - s], [x + c, y + s]]), 0.0)
    on = ((lights, -np.inf, np.inf),) if lights else ()
    still = Pace.steady(0.0)
    return Actor(name, frozenset(roles.split()), type_name, way, 1.0, still, size, on, parked)  # type: ignore[arg-type]


def without(layout: Layout, role: Role) -> Layout:
    """Return the encounter without the actors of a role, and without the structures that hide when it is `occluder`."""
    structures = layout.structures
    if role == "occluder":
        structures = tuple(structure for structure in structures if not structure.occluder)
    gone = {role, "jam"} if role == "conflict" else {role}
    actors = tuple(someone for someone in layout.actors if not gone & someone.roles)
    return replace(layout, actors=actors, structures=structures)
