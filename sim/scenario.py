"""Scenario: roads, demand, agents and encounter of a drive, as frozen validated values; `sim.catalog` loads them."""

from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from sim.boxes import CLASSES

NonNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]
Area = tuple[float, float, float, float]

MOTOR_CLASSES = tuple(name for name in CLASSES if name not in ("bicycle", "pedestrian"))

SIGNAL_LETTERS = "rugGyYosO"
"""Signal states of SUMO: red, red and yellow, green that yields, green, yellow (2), blinking, arrow, off."""


class SignalProgram(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Fixed-time signal program that replaces the one of the network.

    Attributes:
        junction: id of the traffic light in the network.
        phases: (duration in s, one letter of `SIGNAL_LETTERS` per signal index), in order.
        offset_s: shift of the cycle, s.
    """

    junction: str
    phases: tuple[tuple[Positive, str], ...]
    offset_s: float = 0.0


class NetworkSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Road network: exactly one of `shipped`, `generate`, `file`, `wheel` or `highway_env`.

    Attributes:
        shipped: path of a .net.xml(.gz) below `tools/` of the eclipse-sumo package.
        generate: netgenerate arguments that shape the network, as a table of option -> value.
        file: path of a .net.xml; relative ones are looked up beside the scenario file.
        wheel: path of a .net.xml or a map inside one of `sim.roads.wheels.WHEELS`.
        highway_env: id of an environment of highway-env, one of `sim.traffic.highway.roads.ENVIRONMENTS`; works
            without SUMO.
        city_mesh: path of a 3DS city mesh below `tools/` with its placement, or "".
        polygons: path of a .poly.xml with outlines of buildings, as SUMO's polyconvert writes it, beside the scenario
            file or below `tools/`, or "". Without a city mesh, polygons and a map, houses are generated.
        area_m: (x_min, y_min, x_max, y_max) part of the network that is meshed and may carry agents; default: all.
        signals: programs that replace those of the network.
        round: rebuild the junctions of a shipped network or a file and round the bends of its streets, so that no
            vehicle turns on the spot or races through a junction; false keeps the network as it is.
        front_gardens: share of town street fronts with a generated hedge or fence, 0 to 1; of a world of version 1.
        beside: of a world of version 2, times the usual density of plants, fences, posts and other things beside the
            roads (`sim.world.beside.kinds`), 0 to 2; 0 leaves masts, traffic lights, lamps and what a map tells. Unset
            it is 1 and does not appear among the settings of a drive.
    """

    shipped: str = ""
    generate: dict[str, str | int | float | bool] = {}
    file: str = ""
    wheel: str = ""
    highway_env: str = ""
    city_mesh: str = ""
    polygons: str = ""
    area_m: Area | None = None
    signals: tuple[SignalProgram, ...] = ()
    round: bool = True
    front_gardens: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    beside: Annotated[float, Meta(ge=0.0, le=2.0)] | msgspec.UnsetType = msgspec.UNSET


class DemandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Traffic demand: seeded random trips, at rates of insertions per hour over the whole network.

    Attributes:
        vehicles_per_hour: motor vehicles, split into classes by `type_mix`.
        bicycles_per_hour: bicycles, on the lanes that allow them.
        persons_per_hour: pedestrians, on sidewalks and footways.
        through_area: trips touch `network.area_m` and begin and end close around it.
        focus_m: point that trips prefer to pass, m; default: the centre of the area.
        max_vehicles: no insertion while this many vehicles are on the road.
        type_mix: class name -> weight.
        trips: path of a .rou.xml(.gz) with recorded vehicles or trips, beside the scenario file, below `tools/` of
            eclipse-sumo or inside a wheel: they replace `vehicles_per_hour`, in bodies of `type_mix`; with an empty
            one, in bodies of the classes of their vTypes. Flows, routes by id and persons that walk are read too.
        trips_s: first and last time of the trips, s; each seed begins at another time in between.
        parked_per_km: parked cars and vans per km of kerb with room for them.
    """

    vehicles_per_hour: NonNegative = 1200.0
    bicycles_per_hour: NonNegative = 0.0
    persons_per_hour: NonNegative = 0.0
    through_area: bool = True
    focus_m: tuple[float, float] | None = None
    max_vehicles: Annotated[int, Meta(ge=1)] = 150
    type_mix: dict[str, NonNegative] = msgspec.field(
        default_factory=lambda: {"car": 0.72, "van": 0.12, "truck": 0.08, "bus": 0.03, "motorcycle": 0.05}
    )
    trips: str = ""
    trips_s: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    parked_per_km: NonNegative = 0.0


class RoadsideUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Roadside LiDAR: world position (z above local ground), heading and sensor."""

    xyz_m: tuple[float, float, float]
    yaw_deg: Angle = 0.0
    pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    lidar: str = "dair-roadside"


class AgentRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Connected agents: the vehicles and roadside units that carry a LiDAR.

    Attributes:
        vehicles: number of connected vehicles.
        lidar: sensor preset of the vehicles.
        mount_xyz_m: sensor position in the body frame, m, from the middle of the footprint on the road; default: the
            preset's, lifted clear of tall roofs.
        mount_pitch_deg: tilt of their sensors, positive looks down.
        within_m: vehicles are preferred that spend most of the drive within this distance of the ego, m.
        named: names of the connected vehicles in the traffic; default: `vehicles` of them are drawn.
        roadside: roadside units.
    """

    vehicles: Annotated[int, Meta(ge=0)] = 3
    lidar: str = "opv2v-64"
    mount_xyz_m: tuple[float, float, float] | None = None
    mount_pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    within_m: Positive = 60.0
    named: tuple[str, ...] = ()
    roadside: tuple[RoadsideUnit, ...] = ()


TrafficLevel = Literal["none", "light", "dense"]
"""Density of the background traffic of an encounter."""
TRAFFIC_LEVELS = tuple(level for level in get_args(TrafficLevel) if level != "none")

CONTROLS = ("no_occluder", "no_conflict", "ghost")
"""Control conditions of an encounter, see `EncounterSpec`."""


Drawn = float | tuple[float, float]
"""Value, or [low, high] to draw from."""


class Trigger(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Moment at which a road user that stands sets off; one of both.

    Attributes:
        ego_before_m: the ego is this far before the conflict point, m along its path.
        at_s: time since the start of the encounter, s.
    """

    ego_before_m: Drawn | None = None
    at_s: Drawn | None = None


STRUCTURES = ("building", "hedge", "wall")


class PlacedSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Road user or structure of an encounter of one's own.

    Attributes:
        kind: class of road users, or one of `STRUCTURES`.
        street: role in `conflict.streets` on whose path, or beside it, it is.
        at_m: distance of its front from the conflict point along that path, m; negative before the point. Of a road
            user that moves without a trigger, at the time of the crash.
        left_m: of its middle to the left of the path, m; negative to the right.
        speed_mps: 0 stands.
        starts: stands until then; default: it moves from the start.
        count: so many, one behind the other.
        gap_m: between them, m.
        roles: `occluder` is left out in the control `no_occluder`, `helper` carries a LiDAR, the first of several.
        size_m: length, width and height of a structure, m; vehicles have those of their type.
    """

    kind: Literal["car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "building", "hedge", "wall"]
    street: str = "ego"
    at_m: Drawn
    left_m: Drawn = 0.0
    speed_mps: Drawn = 0.0
    starts: Trigger | None = None
    count: Annotated[int, Meta(ge=1, le=20)] = 1
    gap_m: Drawn = 1.5
    roles: tuple[Literal["occluder", "helper"], ...] = ("occluder",)
    size_m: tuple[Positive, Positive, Positive] = (10.0, 1.0, 2.0)


class EncounterSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Scripted encounter with a road user that is occluded from the ego, see `sim.encounters`.

    Attributes:
        kind: one of `sim.encounters.ENCOUNTERS`, or `own`, one of one's own (`sim.encounters.own`).
        parameters: name -> value, or [low, high] to draw from; others are drawn from their default ranges.
        streets: role -> the lanes, or edges, of its path before and after the junction, on a network that the scenario
            names; of an own encounter also a single one.
        road_user: of an own encounter, class of the conflict actor; default: a car, or a pedestrian who has no street.
            This and the next two do not appear among the settings of a drive where they are unset.
        starts: of an own encounter, what the conflict actor waits for; default: it arrives with the ego.
        placed: of an own encounter, all others and structures.
        control: control condition: without the occluder (`no_occluder`), without the conflict actor (`no_conflict`), or
            with a helper that reports the absent conflict actor (`ghost`).
        draw: number of the draw of the parameters, advanced by `sensors.recording.encounter_check`.
        draws: largest number of draws tried.
        traffic: background traffic, vehicles that keep off the conflict; default: none. Unset it does not appear among
            the settings of a drive.
    """

    kind: str
    parameters: dict[str, Drawn] = {}
    streets: dict[str, tuple[str, ...]] = {}
    road_user: Literal["car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian"] | msgspec.UnsetType = (
        msgspec.UNSET
    )
    starts: Trigger | msgspec.UnsetType = msgspec.UNSET
    placed: tuple[PlacedSpec, ...] | msgspec.UnsetType = msgspec.UNSET
    control: Literal["", "no_occluder", "no_conflict", "ghost"] = ""
    draw: Annotated[int, Meta(ge=0)] = 0
    draws: Annotated[int, Meta(ge=1)] = 40
    traffic: TrafficLevel | msgspec.UnsetType = msgspec.UNSET


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Scenario of a drive; times in s. An encounter (`conflict`) has its own roads and actors, others roads and demand.

    `attribution` names the owners of map data; `sim.catalog.attribution` adds those of the sources of the network.
    `world` is the version of the static world and of what stands on it: 1 level and bare, 2 uneven and furnished. Unset
    it is 1 and does not appear among the settings of a drive.
    """

    name: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")]
    description: str
    network: NetworkSpec = msgspec.field(default_factory=NetworkSpec)
    demand: DemandSpec = msgspec.field(default_factory=DemandSpec)
    agents: AgentRule
    conflict: EncounterSpec | None = None
    warmup_s: NonNegative = 60.0
    duration_s: Positive = 60.0
    step_s: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    attribution: str = ""
    world: Literal[1, 2] | msgspec.UnsetType = msgspec.UNSET

    @property
    def uneven(self) -> bool:
        """Whether the world is of version 2."""
        return self.world == 2
