"""Hesai: three spinning heads and one that looks ahead."""

from sensors.presets.tables import beam_table
from sensors.spec import LidarSpec

PANDAR_40P = LidarSpec(
    name="pandar40p",
    **beam_table("pandar40p"),
    columns=1800,  # 0.2 deg
    clockwise=True,
    range_min_m=0.3,
    range_max_m=230.0,
    range_10_m=200.0,
    range_noise_m=0.02,
    source="Hesai Pandar40P user manual 402-en-211010: design angles, 0.2 deg at 10 Hz, 0.72 M points/s, 0.3 to 200 m"
    " at reflectivity 0.1, 2 cm, taken as 1 sigma; ranges per channel of the Pandar40 and Pandar20A manuals; firetime"
    " correction file of HesaiLidar_SDK_2.0",
    assumed=("beam_range_m", "range_noise_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

PANDAR_64 = LidarSpec(
    name="pandar64",
    **beam_table("pandar64"),
    columns=1800,
    clockwise=True,
    range_min_m=0.3,
    range_max_m=230.0,
    range_10_m=200.0,
    range_noise_m=0.02,
    source="Hesai Pandar64 user manual: 0.2 deg at 10 Hz, 1.15 M points/s, 0.3 to 200 m at reflectivity 0.1, 2 cm,"
    " taken as 1 sigma; one unit's calibration, 64.csv of tier4/nebula; firetime correction file of HesaiLidar_SDK_2.0",
    assumed=("range_max_m", "range_noise_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

PANDAR_128 = LidarSpec(
    name="pandar128",
    **beam_table("pandar128"),
    columns=1800,  # the standard mode; in the high resolution mode 64 of the beams fire twice as often
    clockwise=True,
    range_min_m=0.3,
    range_max_m=230.0,
    range_10_m=200.0,
    range_noise_m=0.02,
    source="Hesai Pandar128 (E3X) user manual: firing times and 0.2 deg at 10 Hz of the standard mode, 2.3 M points/s"
    " (3.46 M in high resolution), 0.3 to 200 m at reflectivity 0.1, 2 cm, taken as 1 sigma; angle correction file of"
    " Pandar128E3X; 230 m as in tier4/nebula",
    assumed=("range_noise_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

AT_128 = LidarSpec(
    name="at128",
    **beam_table("at128"),
    columns=1200,  # 0.1 deg; the mirror crosses them in 50 ms and turns back, here the whole 100 ms are used
    clockwise=True,
    azimuth_start_deg=-60.0,
    azimuth_end_deg=60.0,
    range_min_m=0.5,
    range_max_m=200.0,
    range_10_m=200.0,
    range_noise_m=0.05,
    source="Hesai AT128E2X user manual A01-en-230510 (as AWSIM quotes it): angles and ranges per channel, 120 x 25.4"
    " deg, 0.1 deg at 10 Hz, 1.53 M points/s, 200 m at reflectivity 0.1; firetime correction file of"
    " HesaiLidar_Swift_SDK",
    assumed=("clockwise", "range_noise_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

SPECS = (PANDAR_40P, PANDAR_64, PANDAR_128, AT_128)
