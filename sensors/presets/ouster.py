"""Ouster: spinning heads whose beams all fire at once."""

from sensors.presets.tables import beam_table, full_divergence
from sensors.spec import LidarSpec

OS1_64 = LidarSpec(
    name="os1-64",
    **beam_table("os1-64"),
    columns=2048,
    clockwise=True,
    range_min_m=0.8,
    range_max_m=120.0,
    range_10_m=40.0,
    range_noise_m=0.03,
    divergence_rad=full_divergence(0.13),
    source="Ouster OS1 datasheet, first generation: 33.2 deg, 2048 columns at 10 Hz, 1.31 M points/s, 0.8 to 40 m at"
    " reflectivity 0.1, to 120 m at 0.8, 3 cm at a signal-to-noise ratio of 100, 0.13 deg full width at half maximum;"
    " design angles of ouster-sdk",
    assumed=("pulse_s", "mount_xyz_m"),
)

OS1_128 = LidarSpec(
    name="os1-128",
    **beam_table("os1-128"),
    columns=2048,
    clockwise=True,
    range_min_m=0.8,
    range_max_m=120.0,
    range_10_m=40.0,
    range_noise_m=0.03,
    divergence_rad=full_divergence(0.18),
    source="Ouster OS1 datasheet, first generation: 45 deg, 2048 columns at 10 Hz, 2.62 M points/s, ranges and noise as"
    " OS1-64, 0.18 deg full width at half maximum; one unit's metadata, OS-1-128_v2.3.0_1024x10.json of ouster-sdk",
    assumed=("pulse_s", "mount_xyz_m"),
)

SPECS = (OS1_64, OS1_128)
