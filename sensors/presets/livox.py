"""Livox: one or six beams through rotating wedges, a rosette that fills the field of view bit by bit."""

from sensors.presets.tables import full_divergence
from sensors.spec import LidarSpec, Prism

AVIA = LidarSpec(
    name="livox-avia",
    elevation_deg=(3.52, 2.109, 0.699, -0.699, -2.109, -3.52),
    columns=4000,
    prisms=(
        Prism(rate_hz=-131.5463, wedge_deg=30.8856, refraction=1.51),
        Prism(rate_hz=40.8032, wedge_deg=29.7735, refraction=1.51),
        Prism(rate_hz=213.1611, wedge_deg=3.1351, refraction=1.51),
    ),
    azimuth_start_deg=-35.2,
    azimuth_end_deg=35.2,
    range_min_m=1.0,
    range_max_m=320.0,
    range_10_m=190.0,
    range_noise_m=0.02,
    angle_noise_deg=0.05,
    divergence_rad=full_divergence(0.03),
    divergence_vertical_rad=full_divergence(0.28),
    source="livoxtech.com/avia/specs: 70.4 x 77.2 deg, 0.24 M points/s, 190 m at reflectivity 0.1, 320 m at 0.8, 2 cm"
    " and 0.05 deg (1 sigma), 0.28 x 0.03 deg, taken as full width at half maximum, blind below 1 m; lines and wedges"
    " as fitted to a unit by HELIOS++ (scanners_livox_avia.xml)",
    assumed=("divergence_rad", "divergence_vertical_rad", "pulse_s", "mount_xyz_m"),
)

MID_70 = LidarSpec(
    name="livox-mid-70",
    elevation_deg=(0.0,),
    columns=10_000,
    prisms=(
        Prism(rate_hz=-77.7333, wedge_deg=29.7, refraction=1.51, slanted_exit=True),
        Prism(rate_hz=121.5667, wedge_deg=29.7, refraction=1.51),
    ),
    azimuth_start_deg=-35.2,
    azimuth_end_deg=35.2,
    range_min_m=0.05,
    range_max_m=260.0,
    range_10_m=90.0,
    range_noise_m=0.02,
    angle_noise_deg=0.1,
    divergence_rad=full_divergence(0.03),
    divergence_vertical_rad=full_divergence(0.28),
    source="Livox Mid-70 user manual and datasheet: 70.4 deg round, 0.1 M points/s, 90 m at reflectivity 0.1, 2 cm,"
    " from 5 cm on; wedges and divergence of HELIOS++ (scanners_tls.xml), taken as full width at half maximum, the"
    " wedges' slanted faces inside, which gives the field of view of the datasheet",
    assumed=(
        *("range_max_m", "angle_noise_deg", "divergence_rad", "divergence_vertical_rad", "pulse_s", "mount_xyz_m"),
    ),
)

SPECS = (AVIA, MID_70)
