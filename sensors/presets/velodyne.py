"""Velodyne: spinning heads that fire their lasers one after another."""

from sensors.presets.tables import beam_table
from sensors.spec import LidarSpec

HDL_64E_S2 = LidarSpec(
    name="hdl-64e-s2",
    **beam_table("hdl-64e-s2"),
    columns=2083,  # all lasers within 48 us
    clockwise=True,
    range_min_m=0.9,
    range_max_m=120.0,
    range_10_m=50.0,
    range_noise_m=0.02,
    divergence_rad=0.002,
    pulse_s=4e-9,
    mount_xyz_m=(0.0, 0.0, 1.73),
    source="Velodyne HDL-64E S2 and S2.1 user manual: blocks of 1/3 and 1/2 deg, 1.33 M points/s, 50 m at reflectivity"
    " 0.1, 120 m at 0.8, 2 cm (1 sigma), 48 us per firing; pulse of 4 ns: velodyne.com/lidar/technology/concept;"
    " azimuths of one unit, 64e_s2.1-sztaki.yaml of ros-drivers/velodyne",
    assumed=("range_min_m", "divergence_rad", "mount_xyz_m"),
)

HDL_64E_S3 = LidarSpec(
    name="hdl-64e-s3",
    **beam_table("hdl-64e-s3"),
    columns=2083,
    clockwise=True,
    range_min_m=0.9,
    range_max_m=120.0,
    range_10_m=50.0,
    range_noise_m=0.02,
    divergence_rad=0.002,
    pulse_s=4e-9,
    source="one unit's calibration, 64e_s3-xiesc.yaml of ros-drivers/velodyne; firing times of VeloView, single"
    " return: 48 us, 1.33 M points/s; ranges and noise as HDL-64E S2",
    assumed=("range_min_m", "range_max_m", "range_10_m", "range_noise_m", "divergence_rad", "mount_xyz_m"),
)

HDL_32E = LidarSpec(
    name="hdl-32e",
    **beam_table("hdl-32e"),
    columns=2170,  # one sequence per 46.08 us
    clockwise=True,
    range_min_m=0.05,
    range_max_m=100.0,
    range_10_m=60.0,
    range_noise_m=0.02,
    divergence_rad=0.003,
    source="Velodyne HDL-32E user manual 63-9113: firing order, 1.152 us per laser, 46.08 us per sequence, valid data"
    " from 5 cm to 100 m, 0.7 M points/s, 2 cm",
    assumed=("range_10_m", "divergence_rad", "pulse_s", "mount_xyz_m"),
)

VLP_16 = LidarSpec(
    name="vlp-16",
    **beam_table("vlp-16"),
    columns=1808,  # one sequence per 55.296 us
    clockwise=True,
    range_max_m=100.0,
    range_10_m=60.0,
    range_noise_m=0.03,
    divergence_rad=0.003,
    divergence_vertical_rad=0.0015,
    source="Velodyne VLP-16 user manual 63-9243: 2.304 us per laser, 55.296 us per sequence, 0.3 M points/s, 100 m,"
    " 3 cm, taken as 1 sigma; divergence as RGL (AWSIM) takes it from the manual",
    assumed=("range_min_m", "range_10_m", "range_noise_m", "pulse_s", "mount_xyz_m"),
)

VLP_32C = LidarSpec(
    name="vlp-32c",
    **beam_table("vlp-32c"),
    columns=1808,
    clockwise=True,
    range_max_m=200.0,
    range_10_m=100.0,
    range_noise_m=0.03,
    divergence_rad=0.003,
    divergence_vertical_rad=0.0015,
    source="Velodyne VLP-32C user manual 63-9325: pairs of lasers every 2.304 us, 55.296 us per sequence, 0.6 M"
    " points/s, 200 m, 3 cm, taken as 1 sigma; angles of velodyne_decoder 3.1.0; divergence as RGL (AWSIM) takes it"
    " from the manual",
    assumed=("range_min_m", "range_10_m", "range_noise_m", "pulse_s", "mount_xyz_m"),
)

VLS_128 = LidarSpec(
    name="vls-128",
    **beam_table("vls-128"),
    columns=1876,  # one sequence per 53.3 us
    clockwise=True,
    range_max_m=300.0,
    range_10_m=220.0,
    range_noise_m=0.03,
    divergence_rad=0.003,
    divergence_vertical_rad=0.0015,
    source="Velodyne VLS-128 user manual 63-9483: groups of eight lasers every 2.665 us, 53.3 us per sequence, 2.4 M"
    " points/s, divergence in table F-1; Alpha Prime datasheet 63-9679: 300 m, 3 cm, taken as 1 sigma",
    assumed=("range_min_m", "range_10_m", "range_noise_m", "pulse_s", "mount_xyz_m"),
)

SPECS = (HDL_64E_S2, HDL_64E_S3, HDL_32E, VLP_16, VLP_32C, VLS_128)
