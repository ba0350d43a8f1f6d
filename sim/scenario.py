"""Scenario: what a drive is made of, as frozen validated values.

(The loader lives below the structs.)
"""

import msgspec


class NetworkSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A road network: exactly one of `shipped`, `generate` or `file`.

    Attributes:
        shipped: path of a .net.xml(.gz) below `tools/` of the eclipse-sumo package.
        generate: netgenerate arguments as a table of option -> value.
        file: path of a .net.xml beside the scenario file.
        city_mesh: path of a 3DS city mesh below `tools/` with its placement, or "".
        area_m: (x_min, y_min, x_max, y_max) part of the network that is meshed and may carry agents; empty = all.
    """

    shipped: str = ""
    generate: dict[str, str | int | float | bool] = {}
    file: str = ""
    city_mesh: str = ""
    area_m: tuple[float, float, float, float] | None = None


class DemandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Seeded random trips. Rates are insertions per hour over the whole network."""

    vehicles_per_hour: float = 1200.0
    bicycles_per_hour: float = 0.0
    persons_per_hour: float = 0.0
    through_area: bool = True
    type_mix: dict[str, float] = msgspec.field(
        default_factory=lambda: {"car": 0.72, "van": 0.12, "truck": 0.08, "bus": 0.03, "motorcycle": 0.05}
    )


class RoadsideUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A roadside LiDAR: world position (z above local ground), heading and sensor."""

    xyz_m: tuple[float, float, float]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    lidar: str = "dair-roadside"


class AgentRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which actors carry a LiDAR.

    Attributes:
        vehicles: how many vehicles are connected.
        lidar: sensor preset of the vehicles.
        within_m: collaborators are chosen within this distance of the ego when the drive starts, m.
        roadside: roadside units.
    """

    vehicles: int = 3
    lidar: str = "opv2v-64"
    within_m: float = 60.0
    roadside: tuple[RoadsideUnit, ...] = ()


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One scenario file."""

    name: str
    description: str
    network: NetworkSpec
    demand: DemandSpec
    agents: AgentRule
    warmup_s: float = 60.0
    duration_s: float = 60.0
    step_s: float = 0.1
    seed: int = 0
