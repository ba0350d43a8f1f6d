"""LidarSpec: what a LiDAR is, and the named presets."""

import msgspec
import numpy as np
from numpy.typing import NDArray


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A spinning LiDAR.

    Attributes:
        name: preset name.
        elevation_deg: beam elevations, highest first: ring 0 is the top beam.
        columns: firings per rotation.
        rate_hz: rotations per second.
        azimuth_start_deg, azimuth_end_deg: field of view, counter-clockwise from straight ahead.
        range_min_m, range_max_m: nearest and farthest range.
        range_noise_m: standard deviation of the range.
        dropoff_rate: share of beams lost at random before anything is measured (CARLA's general drop-off).
        dropoff_intensity_limit: returns of at least this intensity are never lost.
        dropoff_zero_intensity: chance that a return of zero intensity is lost; linear up to the limit.
        divergence_rad: full beam divergence.
        pulse_s: pulse length at half power.
        mount_xyz_m: sensor above the footprint's centre at road level for vehicles, in the body frame.
        source: the document that the numbers come from.
    """

    name: str
    elevation_deg: tuple[float, ...]
    columns: int
    rate_hz: float = 10.0
    azimuth_start_deg: float = -180.0
    azimuth_end_deg: float = 180.0
    range_min_m: float = 0.5
    range_max_m: float = 120.0
    range_noise_m: float = 0.02
    dropoff_rate: float = 0.0
    dropoff_intensity_limit: float = 0.8
    dropoff_zero_intensity: float = 0.4
    divergence_rad: float = 0.003
    pulse_s: float = 1e-8
    mount_xyz_m: tuple[float, float, float] = (0.0, 0.0, 1.9)
    source: str = ""

    @property
    def rings(self) -> int:
        """Number of beams."""
        return len(self.elevation_deg)

    @property
    def elevation(self) -> NDArray[np.float64]:
        """(R,) beam elevations in radians, ring 0 first."""
        return np.radians(np.array(self.elevation_deg, np.float64))
