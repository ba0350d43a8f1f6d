"""Sensors of datasets and simulators, and one for tests.

What a maker's sensor reports in a data set, fitted to its sweeps, is `python -m studies.sensor_fit`.
"""

from typing import Any

import msgspec
import numpy as np

from sensors.presets.velodyne import HDL_64E_S2, VLP_32C
from sensors.spec import LidarSpec


def _spread(top_deg: float, bottom_deg: float, beams: int) -> tuple[float, ...]:
    return tuple(float(angle) for angle in np.linspace(top_deg, bottom_deg, beams).round(6))


OPV2V_64 = LidarSpec(
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
    " at 20 Hz; frames stored at 10 Hz, here with the rolling shutter of a 10 Hz sensor; intensity is reflectivity, so"
    " that detectors may learn from it: CARLA's own, which only tells the range, is in carla-64",
    assumed=("rolling_shutter", "intensity_law", "range_min_m", "divergence_rad", "pulse_s"),
)

CARLA_64 = LidarSpec(
    name="carla-64",
    elevation_deg=_spread(10.0, -30.0, 64),
    columns=1800,
    clockwise=True,
    rolling_shutter=False,
    range_min_m=0.0,
    range_max_m=100.0,
    range_10_m=1e4,  # CARLA has no detection threshold
    range_noise_m=0.0,
    dropoff_rate=0.45,
    dropoff_intensity_limit=0.8,
    dropoff_zero_intensity=0.4,
    divergence_rad=0.0,
    intensity_law="distance",
    attenuation=0.004,
    source="CARLA sensors reference, sensor.lidar.ray_cast: its defaults (+10..-30 deg, drop-off 0.45, 0.8 and 0.4,"
    " atmosphere_attenuation_rate 0.004, noise_stddev 0, 10 Hz), but 64 channels at 0.2 deg to 100 m, not 32 to 10 m",
    assumed=("columns", "range_max_m", "mount_xyz_m"),
)

DAIR_ROADSIDE = LidarSpec(
    name="dair-roadside",
    elevation_deg=_spread(20.0, -20.0, 300),
    columns=1000,
    azimuth_start_deg=-50.0,
    azimuth_end_deg=50.0,
    range_max_m=280.0,
    range_10_m=280.0,
    range_noise_m=0.03,
    divergence_rad=0.001,
    mount_xyz_m=(0.0, 0.0, 6.0),
    source="DAIR-V2X infrastructure LiDAR: 300 lines, 100 x 40 deg, 10 Hz, 280 m, <= 3 cm; the field of view is"
    " symmetric about the axis, so a roadside unit tilts it down",
    assumed=("columns", "clockwise", "range_min_m", "range_10_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

DEBUG_16 = LidarSpec(
    name="debug-16",
    elevation_deg=_spread(2.0, -25.0, 16),
    columns=360,
    range_10_m=300.0,
    source="a light sensor for tests: the field of view of opv2v-64",
)

HDL_64E_KITTI = msgspec.structs.replace(
    HDL_64E_S2,
    name="hdl-64e-kitti",
    range_10_m=120.0,
    beam_range_m=((0.9, 80.0),) * 64,  # where the data set cuts its sweeps off
    dropoff_rate=0.012,
    blocked_deg=(
        *((-180.0, -160.0, -18.6), (165.0, 180.0, -18.6)),  # roof behind the rig
        *((-164.5, -155.0, -13.6), (156.0, 164.0, -13.6), (-79.0, -64.0, -16.6)),  # what stands on it
        *((-13.0, 13.0, -21.1), (13.0, 19.0, -22.6), (-40.0, -32.0, -22.6), (24.0, 32.0, -22.6)),  # roof before it
        *((-136.0, -129.0, -20.6), (129.0, 136.0, -20.6), (-160.0, -148.0, -22.6), (150.0, 165.0, -22.6)),
    ),
    intensity_curve=(
        *((0.0, 0.0), (0.025, 0.0), (0.045, 0.25), (0.1, 0.29), (0.3, 0.31)),
        *((0.5, 0.36), (1.0, 0.6), (8.0, 0.99)),
    ),
    intensity_fade_m=(20.0, 65.0),
    lacquer=0.03,
    source="hdl-64e-s2 as in KITTI (Geiger et al., CVPR 2012): range, limit, losses and intensities fitted to sweeps of"
    " its object benchmark",
    assumed=("range_min_m", "divergence_rad"),
)


def _with_its_mirror(shift_deg: float) -> dict[str, Any]:
    """Return tables of beams of two VLP-32C, one above the other and upside down, as it is measured in the frame."""
    upright = [(VLP_32C.elevation_deg[k], VLP_32C.azimuth_offset_deg[k], VLP_32C.firing_s[k]) for k in range(32)]
    turned = [(round(shift_deg - elevation, 3), azimuth, firing) for elevation, azimuth, firing in upright]
    columns = zip(*sorted(upright + turned, key=lambda beam: -beam[0]), strict=True)
    return dict(zip(("elevation_deg", "azimuth_offset_deg", "firing_s"), columns, strict=True))


VLP_32C_AV2 = msgspec.structs.replace(
    VLP_32C,
    name="vlp-32c-av2",
    **_with_its_mirror(shift_deg=-0.35),
    range_max_m=150.0,
    range_10_m=50.0,
    dropoff_rate=0.06,
    intensity_curve=((0.0, 0.0), (0.12, 0.028), (0.4, 0.06), (1.0, 0.2), (8.0, 1.0)),
    lacquer=0.4,
    source="two vlp-32c as in Argoverse 2 (Wilson et al., NeurIPS 2021), one upside down, in one frame; limit, losses"
    " and intensities fitted to a sweep of it; accuracy taken as 1 sigma",
    assumed=("range_min_m", "range_noise_m", "pulse_s", "mount_xyz_m"),
)

SPECS = (OPV2V_64, CARLA_64, DAIR_ROADSIDE, HDL_64E_KITTI, VLP_32C_AV2, DEBUG_16)
