"""Encounter data types: actors with their paths, structures, roads, roadside units, parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.bodies.vehicle_types import TYPES, VehicleType
from sim.encounters.lane_paths import LanePath
from sim.encounters.networks import PlainNetwork
from sim.encounters.paths import ReferencePath, SpeedProfile
from sim.scenario import Area, RoadsideUnit

Role = Literal["ego", "conflict", "occluder", "helper", "jam", "other"]
"""Roles of actors; a `jam` queues behind the conflict actor and disappears with it."""

HIT_S = 6.0
"""Time at which ego and conflict actor reach the crossing of their paths, s after the start."""


@dataclass(frozen=True, slots=True, eq=False)
class Overtaking:
    """Overtaking on an actor's path, which it gives up when it is driven otherwise.

    Attributes:
        lane: path of the lane that it leaves.
        start_m: distance along its own path at which it pulls out, m.
        of: name of the vehicle that it overtakes.
    """

    lane: ReferencePath
    start_m: float
    of: str


@dataclass(frozen=True, slots=True)
class Start:
    """Start of an actor that stands until then.

    Attributes:
        script_s: time of the script at which it sets off, s.
        ego_at_m: distance of the ego along its path at which it sets off, m; None for a time.
    """

    script_s: float
    ego_at_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ScriptedActor:
    """Scripted road user.

    Attributes:
        name: unique name; `ego` and `conflict` are reserved.
        roles: its roles.
        type_name: one of `sim.bodies.vehicle_types.TYPES`.
        path: path of the centre of its footprint.
        start_m: distance along its path at time 0, m; negative before it appears.
        pace: its speed over time.
        size: length, width, height in place of the type's, m.
        lights: (bits of signals, from, to), times in s.
        parked: engine off, without brake lights.
        overtaking: overtaking on its path; None without one.
        start: what it waits for, standing; None: for nothing.
    """

    name: str
    roles: frozenset[Role]
    type_name: str
    path: ReferencePath
    start_m: float
    pace: SpeedProfile
    size: tuple[float, float, float] | None = None
    lights: tuple[tuple[int, float, float], ...] = ()
    parked: bool = False
    overtaking: Overtaking | None = None
    start: Start | None = None

    @property
    def kind(self) -> VehicleType:
        """Vehicle type, with its own size."""
        kind = TYPES[self.type_name]
        return kind if self.size is None else replace(kind, size=self.size)

    def place(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scripted distance along its path at a time, m."""
        return self.start_m + self.pace.distance(time_s)


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Solid structure beside the road.

    Attributes:
        kind: appearance.
        outline: footprint in the world, m.
        height_m: height of its top above the road, m.
        occluder: occludes the conflict actor, and is absent in the control `no_occluder`.
    """

    kind: Literal["building", "hedge", "wall"]
    outline: shapely.Polygon
    height_m: float
    occluder: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Ghost:
    """False report: a road user that a helper reports although it does not exist.

    Attributes:
        actor: reported road user, named `ghost`.
        claimed_by: name of the helper, or `roadside` for the first roadside unit.
    """

    actor: ScriptedActor
    claimed_by: str


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Layout of an encounter, before a control condition is applied.

    Attributes:
        roads: road network; None when the scenario names one.
        actors: the ego first.
        structures: solid structures.
        units: roadside units.
        focus: (2,) point of the crash, m.
        reach_m: half the side of the relevant area around the focus, m.
        clear: ground without generated houses, trees or lamps, which would add occlusion.
    """

    roads: PlainNetwork | None
    actors: tuple[ScriptedActor, ...]
    structures: tuple[Structure, ...] = ()
    units: tuple[RoadsideUnit, ...] = ()
    focus: tuple[float, float] = (0.0, 0.0)
    reach_m: float = 80.0
    clear: shapely.Geometry = field(default_factory=shapely.Polygon)


@dataclass(frozen=True, slots=True, eq=False)
class Encounter:
    """Drawn encounter, with its control condition applied.

    Attributes:
        kind: id of the encounter type.
        parameters: drawn values.
        layout: roads, actors and structures.
        ghosts: false reports.
    """

    kind: str
    parameters: dict[str, float]
    layout: Layout
    ghosts: tuple[Ghost, ...] = ()

    @property
    def area(self) -> Area:
        """(x_min, y_min, x_max, y_max) of the relevant area, m."""
        (x, y), reach = self.layout.focus, self.layout.reach_m
        return (x - reach, y - reach, x + reach, y + reach)

    def names(self, role: Role) -> tuple[str, ...]:
        """Return the names of the actors of a role, in order."""
        return tuple(actor.name for actor in self.layout.actors if role in actor.roles)


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of an encounter type.

    Attributes:
        name: key in the scenario file, with its unit.
        low: smallest accepted value.
        high: largest accepted value.
        draw: default range to draw from.
        what: description.
        whole: whole numbers only.
    """

    name: str
    low: float
    high: float
    draw: tuple[float, float]
    what: str
    whole: bool = False


@dataclass(frozen=True, slots=True)
class EncounterType:
    """Encounter type: its parameters and its layout function.

    Attributes:
        summary: what happens, in one line.
        parameters: parameters to draw.
        lay_out: (drawn values, generator of appearance) -> layout on made roads; None: on a map only.
        roles: roles whose lanes a scenario names to place the encounter on a map; empty: made roads only.
        on_streets: layout function along those lanes.
        waits: the conflict actor crosses the ego's path or comes towards it: the script's clock waits for a driven ego.
            Not where the ego follows it in a lane, or it stands. Nor does it for an actor with a `Start`.
    """

    summary: str
    parameters: tuple[Parameter, ...]
    lay_out: Callable[[Mapping[str, float], np.random.Generator], Layout] | None
    roles: tuple[str, ...] = ()
    on_streets: Callable[[Mapping[str, float], np.random.Generator, Mapping[str, LanePath]], Layout] | None = None
    waits: bool = True


def actor(
    name: str,
    roles: str,
    type_name: str,
    path: ReferencePath,
    pace: SpeedProfile | float,
    *,
    at_m: float,
    at_s: float = 0.0,
    size: tuple[float, float, float] | None = None,
    lights: tuple[tuple[int, float, float], ...] = (),
    overtaking: Overtaking | None = None,
) -> ScriptedActor:
    """Return an actor that is `at_m` along its path at time `at_s`.

    Args:
        roles: separated by spaces.
        pace: speed profile, or a constant speed, m/s.
        at_m: distance along the path, m.
        at_s: time there, s.
    """
    steady = pace if isinstance(pace, SpeedProfile) else SpeedProfile.steady(pace)
    start_m = at_m - float(steady.distance(at_s))
    known: frozenset[Role] = frozenset(roles.split())  # type: ignore[arg-type]
    return ScriptedActor(name, known, type_name, path, start_m, steady, size, lights, overtaking=overtaking)


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
) -> ScriptedActor:
    """Return a standing actor with the centre of its footprint at (x, y)."""
    c, s = np.cos(heading), np.sin(heading)
    path = ReferencePath.through(np.array([[x - c, y - s], [x + c, y + s]]), 0.0)
    on = ((lights, -np.inf, np.inf),) if lights else ()
    still = SpeedProfile.steady(0.0)
    return ScriptedActor(name, frozenset(roles.split()), type_name, path, 1.0, still, size, on, parked)  # type: ignore[arg-type]


def without(layout: Layout, role: Role) -> Layout:
    """Return a layout without the actors of a role; for `occluder` also without occluding structures."""
    structures = layout.structures
    if role == "occluder":
        structures = tuple(structure for structure in structures if not structure.occluder)
    gone = {role, "jam"} if role == "conflict" else {role}
    actors = tuple(someone for someone in layout.actors if not gone & someone.roles)
    return replace(layout, actors=actors, structures=structures)
