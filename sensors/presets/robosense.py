"""RoboSense: a spinning head of 128 lasers."""

from sensors.presets.tables import beam_table
from sensors.spec import LidarSpec

RS_RUBY_PLUS = LidarSpec(
    name="rs-ruby-plus",
    **beam_table("rs-ruby-plus"),
    columns=1800,  # 0.2 deg: one sequence per 55.56 us
    clockwise=True,
    range_min_m=1.0,
    range_max_m=250.0,
    range_10_m=240.0,
    range_noise_m=0.03,
    pulse_s=6.67e-9,
    source="RoboSense RS-Ruby Plus user manual: 55.56 us per sequence of 128 lasers, 2.3 M points/s, echoes 1 m apart"
    " are told apart, 3 cm; rs_driver (decoder_RSP128): firing times, 1 to 250 m; one unit's calibration,"
    " RobosenseRubyPlus.csv of tier4/nebula",
    assumed=("range_10_m", "divergence_rad", "mount_xyz_m"),
)

SPECS = (RS_RUBY_PLUS,)
