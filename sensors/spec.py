"""LidarSpec: what a LiDAR is, and the named presets."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.errors import ScenarioError, SettingsError, complaint, did_you_mean
from sim.scenario import Scenario


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A spinning LiDAR.

    Attributes:
        name: preset name.
        elevation_deg: beam elevations, highest first: ring 0 is the top beam.
        columns: firings per rotation.
        rate_hz: rotations per second.
        rolling_shutter: columns fire one after another; False freezes the world, as CARLA's sensor does in a tick.
        azimuth_start_deg, azimuth_end_deg: field of view, counter-clockwise from straight ahead.
        range_min_m, range_max_m: nearest and farthest range.
        range_10_m: range at which a target of reflectivity 0.1, hit squarely, is just detected in clear air.
        range_noise_m: standard deviation of the range.
        dropoff_rate: share of beams lost at random before anything is measured (CARLA's general drop-off).
        dropoff_intensity_limit: returns of at least this intensity are never lost.
        dropoff_zero_intensity: chance that a return of zero intensity is lost, at any range; linear up to the limit.
            That is CARLA's model: real sensors lose what is too weak by `range_10_m`.
        divergence_rad: full beam divergence.
        pulse_s: pulse length at half power.
        mount_xyz_m: sensor above the footprint's centre at road level for vehicles, in the body frame.
        source: the document that the numbers come from.
    """

    name: str
    elevation_deg: tuple[float, ...]
    columns: int
    rate_hz: float = 10.0
    rolling_shutter: bool = True
    azimuth_start_deg: float = -180.0
    azimuth_end_deg: float = 180.0
    range_min_m: float = 0.5
    range_max_m: float = 120.0
    range_10_m: float = 100.0
    range_noise_m: float = 0.02
    dropoff_rate: float = 0.0
    dropoff_intensity_limit: float = 0.8
    dropoff_zero_intensity: float = 0.4
    divergence_rad: float = 0.003
    pulse_s: float = 1e-8
    mount_xyz_m: tuple[float, float, float] = (0.0, 0.0, 1.9)
    source: str = ""

    def __post_init__(self) -> None:
        facts = {
            "elevation_deg: expected angles within +-90, highest first": len(self.elevation_deg) > 0
            and max(map(abs, self.elevation_deg)) <= 90.0
            and all(a > b for a, b in zip(self.elevation_deg, self.elevation_deg[1:], strict=False)),
            "columns: expected at least 1": self.columns >= 1,
            "rate_hz: expected a positive rate": self.rate_hz > 0.0,
            "azimuth: expected start < end, at most 360 degrees apart": 0.0
            < self.azimuth_end_deg - self.azimuth_start_deg
            <= 360.0,
            "range: expected 0 <= range_min_m < range_max_m": 0.0 <= self.range_min_m < self.range_max_m,
            "range_10_m: expected a positive range": self.range_10_m > 0.0,
            "range_noise_m: expected at least 0": self.range_noise_m >= 0.0,
            "dropoff: expected shares in [0, 1]": all(
                0.0 <= share <= 1.0
                for share in (self.dropoff_rate, self.dropoff_intensity_limit, self.dropoff_zero_intensity)
            ),
        }
        for fact, holds in facts.items():
            if not holds:
                raise SettingsError(f"LidarSpec '{self.name}': {fact}, found otherwise")

    @property
    def rings(self) -> int:
        """Number of beams."""
        return len(self.elevation_deg)

    @property
    def elevation(self) -> NDArray[np.float64]:
        """(R,) beam elevations in radians, ring 0 first."""
        return np.radians(np.array(self.elevation_deg, np.float64))

    @property
    def azimuth(self) -> NDArray[np.float64]:
        """(C,) azimuth of each column in radians, column 0 first, counter-clockwise from straight ahead."""
        step = (self.azimuth_end_deg - self.azimuth_start_deg) / self.columns
        return np.radians(self.azimuth_start_deg + step * np.arange(self.columns))

    @property
    def period_s(self) -> float:
        """Duration of one rotation, s."""
        return 1.0 / self.rate_hz

    @property
    def time_offset(self) -> NDArray[np.float64]:
        """(C,) firing time of each column minus the sweep's reference time, s: centred, within half a period."""
        fraction = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        return fraction * (self.period_s if self.rolling_shutter else 0.0)


def _spread(top_deg: float, bottom_deg: float, beams: int) -> tuple[float, ...]:
    return tuple(float(angle) for angle in np.linspace(top_deg, bottom_deg, beams).round(6))


def _opv2v_64() -> LidarSpec:
    return LidarSpec(
        name="opv2v-64",
        elevation_deg=_spread(2.0, -25.0, 64),
        columns=1016,  # 1.3 M points/s over 64 beams and 20 ticks/s
        range_max_m=120.0,
        range_10_m=300.0,  # CARLA has no detection threshold: let none bite within 120 m of road
        range_noise_m=0.02,
        dropoff_rate=0.1,
        dropoff_intensity_limit=0.7,
        dropoff_zero_intensity=0.15,
        source="OPV2V data protocol of 2021-08-18 (OpenCDA): CARLA ray_cast, 64 channels, +2..-25 deg, 1.3 M points/s"
        " at 20 Hz; frames stored at 10 Hz",
    )


def _hdl_64e() -> LidarSpec:
    return LidarSpec(
        name="hdl-64e",
        elevation_deg=_spread(2.0, -8.333333, 32) + _spread(-8.833333, -24.333333, 32),
        columns=2083,
        range_min_m=0.9,
        range_max_m=120.0,
        range_10_m=50.0,
        range_noise_m=0.02,
        dropoff_rate=0.02,
        dropoff_zero_intensity=0.0,
        divergence_rad=0.002,
        source="Velodyne HDL-64E S2 manual: upper block step 1/3 deg, lower block step 1/2 deg, 1.33 M points/s;"
        " 50 m at reflectivity 0.1, 120 m at 0.8",
    )


def _vlp_16() -> LidarSpec:
    return LidarSpec(
        name="vlp-16",
        elevation_deg=_spread(15.0, -15.0, 16),
        columns=1808,  # one firing sequence per 55.296 us
        range_max_m=100.0,
        range_10_m=60.0,
        range_noise_m=0.03,
        dropoff_rate=0.02,
        dropoff_zero_intensity=0.0,
        source="Velodyne VLP-16 manual: 16 beams, +-15 deg step 2, 0.2 deg at 10 Hz, 100 m, 3 cm",
    )


_VLP_32C_DEG = (
    *(15.0, 10.333, 7.0, 4.667, 3.333, 2.333, 1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667, -1.0, -1.333),
    *(-1.667, -2.0, -2.333, -2.667, -3.0, -3.333, -3.667, -4.0, -4.667, -5.333, -6.148, -7.254, -8.843, -11.31),
    *(-15.639, -25.0),
)


def _vlp_32c() -> LidarSpec:
    return LidarSpec(
        name="vlp-32c",
        elevation_deg=_VLP_32C_DEG,
        columns=1808,
        range_max_m=200.0,
        range_10_m=100.0,
        range_noise_m=0.03,
        dropoff_rate=0.02,
        dropoff_zero_intensity=0.0,
        source="Velodyne VLP-32C: ROS driver's table of vertical angles, 0.2 deg at 10 Hz, 200 m, 3 cm",
    )


def _dair_roadside() -> LidarSpec:
    return LidarSpec(
        name="dair-roadside",
        elevation_deg=_spread(20.0, -20.0, 300),
        columns=1000,
        azimuth_start_deg=-50.0,
        azimuth_end_deg=50.0,
        range_max_m=280.0,
        range_10_m=280.0,
        range_noise_m=0.03,
        dropoff_rate=0.02,
        divergence_rad=0.001,
        mount_xyz_m=(0.0, 0.0, 6.0),
        source="DAIR-V2X infrastructure LiDAR: 300 lines, 100 x 40 deg, 10 Hz, 280 m, <= 3 cm; the field of view is"
        " symmetric about the axis, so a roadside unit tilts it down; horizontal step 0.1 deg assumed",
    )


def _debug_16() -> LidarSpec:
    return LidarSpec(
        name="debug-16",
        elevation_deg=_spread(2.0, -25.0, 16),
        columns=360,
        range_10_m=300.0,
        source="a light sensor for tests: the field of view of opv2v-64",
    )


LIDARS: dict[str, LidarSpec] = {
    spec.name: spec for spec in (_opv2v_64(), _hdl_64e(), _vlp_16(), _vlp_32c(), _dair_roadside(), _debug_16())
}
"""The shipped presets by name."""


def get_lidar(name: str) -> LidarSpec:
    """Return the preset of this name; SettingsError when there is none."""
    if name not in LIDARS:
        raise SettingsError(f"unknown lidar '{name}'{did_you_mean(name, LIDARS)}")
    return LIDARS[name]


def scenario_lidars(scenario: Scenario) -> tuple[LidarSpec, tuple[LidarSpec, ...]]:
    """Return the sensor of the vehicles and those of the roadside units of a scenario.

    Raises:
        ScenarioError: a name is that of no preset.
    """
    rule = scenario.agents
    names = {"agents.lidar": rule.lidar}
    names |= {f"agents.roadside[{index}].lidar": unit.lidar for index, unit in enumerate(rule.roadside)}
    for field, name in names.items():
        if name not in LIDARS:
            raise ScenarioError(complaint(scenario.name, field, "a LiDAR preset", name, did_you_mean(name, LIDARS)))
    first, *others = (LIDARS[name] for name in names.values())
    return first, tuple(others)
