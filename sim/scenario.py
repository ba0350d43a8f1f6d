"""Scenario: roads, demand, agents and encounter of a drive, as frozen validated values; `sim.catalog` loads them."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from sim.boxes import CLASSES

NonNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]
Area = tuple[float, float, float, float]

MOTOR_CLASSES = tuple(name for name in CLASSES if name not in ("bicycle", "pedestrian"))

SIGNAL_LETTERS = "rugGyYosO"
"""States of one signal in SUMO: red, red and yellow, green that yields, green, yellow (2), blinking, arrow, off."""


class SignalProgram(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A fixed-time program that replaces the one in the network.

    Attributes:
        junction: id of the traffic light in the network.
        phases: (duration in s, one letter of `SIGNAL_LETTERS` per signal index) in their order.
        offset_s: shift of the cycle, s.
    """

    junction: str
    phases: tuple[tuple[Positive, str], ...]
    offset_s: float = 0.0


class NetworkSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A road network: exactly one of `shipped`, `generate`, `file`, `wheel` or `highway_env`.

    Attributes:
        shipped: path of a .net.xml(.gz) below `tools/` of the eclipse-sumo package.
        generate: netgenerate arguments as a table of option -> value.
        file: path of a .net.xml; relative ones are looked up beside the scenario file.
        wheel: path of a .net.xml, or of a map with what stands beside its roads, inside one of
            `sim.roads.wheels.WHEELS`.
        highway_env: id of an environment of highway-env whose roads these are, one of
            `sim.traffic.highway.roads.ENVIRONMENTS`; nothing of SUMO is needed then.
        city_mesh: path of a 3DS city mesh below `tools/` with its placement, or "".
        polygons: path of a .poly.xml with outlines of buildings, as SUMO's polyconvert writes it, beside the scenario
            file or below `tools/`, or "". Without a city mesh, polygons and a map, houses are made up.
        area_m: (x_min, y_min, x_max, y_max) part of the network that is meshed and may carry agents; left out: all.
        signals: programs that replace those of the network.
        round: build the junctions of a shipped network or a file anew and round the bends of its streets, so that
            nobody turns at once or races through a junction; false takes the network as it is.
        front_gardens: share of the street fronts of a town where a hedge or a fence is made up, 0 to 1.
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


class DemandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Seeded random trips. Rates are insertions per hour over the whole network.

    Attributes:
        vehicles_per_hour: motor vehicles, split into classes by `type_mix`.
        bicycles_per_hour: bicycles, on the lanes that allow them.
        persons_per_hour: pedestrians, on sidewalks and footways.
        through_area: trips touch `network.area_m` and begin and end close around it.
        focus_m: trips prefer to pass near this point, m; left out: the centre of the area.
        max_vehicles: no insertion while this many vehicles are on the road.
        type_mix: class name -> weight.
        trips: path of a .rou.xml(.gz) with recorded vehicles or trips, beside the scenario file, below `tools/` of
            eclipse-sumo or inside a wheel: they drive instead of `vehicles_per_hour`, in bodies of `type_mix`.
        trips_s: from when to when the trips are, s; each seed begins at another time of it.
        parked_per_km: cars and vans that stand parked, per km of kerb where there is room for them.
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
    """A roadside LiDAR: world position (z above local ground), heading and sensor."""

    xyz_m: tuple[float, float, float]
    yaw_deg: Angle = 0.0
    pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    lidar: str = "dair-roadside"


class AgentRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which actors carry a LiDAR.

    Attributes:
        vehicles: how many vehicles are connected.
        lidar: sensor preset of the vehicles.
        mount_xyz_m: where their sensors sit in the body frame, m, from the middle of the footprint on the road; left
            out: the preset's place, lifted clear of tall roofs.
        mount_pitch_deg: tilt of their sensors, positive looks down.
        within_m: those are chosen that spend the most of the drive within this distance of the ego, m.
        named: names of the connected vehicles in the traffic, ego first; left out: `vehicles` of them are drawn.
        roadside: roadside units.
    """

    vehicles: Annotated[int, Meta(ge=0)] = 3
    lidar: str = "opv2v-64"
    mount_xyz_m: tuple[float, float, float] | None = None
    mount_pitch_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    within_m: Positive = 60.0
    named: tuple[str, ...] = ()
    roadside: tuple[RoadsideUnit, ...] = ()


CONTROLS = ("no_occluder", "no_conflict", "ghost")
"""Changes of a conflict that show what it was good for, see `ConflictSpec`."""


class ConflictSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A scripted encounter in which the ego cannot see in time what it would collide with; see `sim.encounters`.

    Attributes:
        kind: which encounter, one of `sim.encounters.KINDS`.
        parameters: name -> a value, or [low, high] of what is drawn; the others are drawn from ranges of their own.
        streets: on a network that the scenario names: role -> the lanes of its way before and after the junction.
        control: what is changed to see what it was good for: nothing, or the occluder is away (`no_occluder`), the
            conflict actor is away (`no_conflict`), or it is away and a helper claims it all the same (`ghost`).
        draw: number of the draw of the parameters; the proof by rays advances it, see `sensors.recording.encounter_check`.
        draws: most draws that are tried.
    """

    kind: str
    parameters: dict[str, float | tuple[float, float]] = {}
    streets: dict[str, tuple[str, ...]] = {}
    control: Literal["", "no_occluder", "no_conflict", "ghost"] = ""
    draw: Annotated[int, Meta(ge=0)] = 0
    draws: Annotated[int, Meta(ge=1)] = 40


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One scenario file; times in s. A conflict brings its own roads and actors, others have a network and a demand.

    `attribution` says whose data the place is made of, where their terms ask for it.
    """

    name: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")]
    description: str
    network: NetworkSpec = msgspec.field(default_factory=NetworkSpec)
    demand: DemandSpec = msgspec.field(default_factory=DemandSpec)
    agents: AgentRule
    conflict: ConflictSpec | None = None
    warmup_s: NonNegative = 60.0
    duration_s: Positive = 60.0
    step_s: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    attribution: str = ""
