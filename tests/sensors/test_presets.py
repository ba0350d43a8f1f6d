import msgspec
import numpy as np
import pytest

from sensors.optics.beams import beams_of
from sensors.presets import LIDARS, get_lidar
from sensors.presets.__main__ import document
from sensors.presets.tables import FOLDER, full_divergence
from sensors.spec import LidarSpec
from sim.catalog.load import list_scenarios, load_scenario
from sim.errors import SettingsError
from tests.paths import ROOT

REAL = sorted(path.stem for path in FOLDER.glob("*.csv"))
FIRED_IN_TURN = sorted(name for name in REAL if get_lidar(name).firing_s)
ROSETTES = sorted(name for name, spec in LIDARS.items() if spec.prisms)

DATASHEET = {
    # points per second, highest and lowest elevation in degrees, as the makers print them
    "hdl-64e-s2": (1.333e6, 2.0, -24.8),
    "hdl-64e-s3": (1.333e6, 2.0, -24.8),
    "hdl-32e": (0.70e6, 10.67, -30.67),
    "vlp-16": (0.30e6, 15.0, -15.0),
    "vlp-32c": (0.60e6, 15.0, -25.0),
    "vls-128": (2.4e6, 15.0, -25.0),
    "pandar40p": (0.72e6, 15.0, -25.0),
    "pandar64": (1.152e6, 15.0, -25.0),
    "pandar128": (2.304e6, 15.0, -25.0),
    "at128": (1.536e6, 12.93, -12.47),
    "os1-64": (1_310_720, 16.6, -16.6),
    "os1-128": (2_621_440, 22.5, -22.5),
    "rs-ruby-plus": (2.304e6, 15.0, -25.0),
    "livox-avia": (0.24e6, None, None),
    "livox-mid-70": (0.1e6, None, None),
    "dair-roadside": (3.0e6, 20.0, -20.0),
}


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_a_preset_lists_beams_from_the_top_and_names_its_source(name: str) -> None:
    spec = get_lidar(name)
    assert spec.name == name
    assert (np.diff(spec.elevation_deg) < 0).all()
    assert len(spec.source) > 20
    assert set(spec.assumed) < set(LidarSpec.__struct_fields__)


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_every_ray_of_a_preset_is_a_unit_vector(name: str) -> None:
    spec = msgspec.structs.replace(get_lidar(name), subrays=4)
    beams = beams_of(spec, 0.05)
    assert beams.columns == spec.columns <= beams.axis.shape[2]
    np.testing.assert_allclose(np.linalg.norm(beams.axis, axis=0), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(beams.subray, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_a_preset_survives_json(name: str) -> None:
    spec = get_lidar(name)
    assert msgspec.json.decode(msgspec.json.encode(spec), type=LidarSpec) == spec


@pytest.mark.parametrize("name", sorted(DATASHEET))
def test_points_per_second_and_field_of_view_are_those_of_the_datasheet(name: str) -> None:
    spec = get_lidar(name)
    rate, top, bottom = DATASHEET[name]
    assert spec.rings * spec.columns * spec.rate_hz == pytest.approx(rate, rel=0.04)
    if not spec.prisms:
        assert spec.elevation_deg[0] == pytest.approx(top, abs=1.6)
        assert spec.elevation_deg[-1] == pytest.approx(bottom, abs=0.7)


def test_each_real_sensor_has_a_datasheet_here() -> None:
    assert set(REAL) | set(ROSETTES) <= set(DATASHEET)
    assert set(REAL) <= set(LIDARS)


@pytest.mark.parametrize("name", REAL)
def test_a_table_numbers_every_laser_once(name: str) -> None:
    lines = [line for line in (FOLDER / f"{name}.csv").read_text().splitlines() if not line.startswith("#")]
    lasers = sorted(int(line.split(",")[0]) for line in lines[1:])
    assert lasers in ([*range(len(lasers))], [*range(1, len(lasers) + 1)])


@pytest.mark.parametrize("name", sorted(set(REAL) - {"at128"}))
def test_a_spinning_head_turns_clockwise_through_a_whole_turn(name: str) -> None:
    spec = get_lidar(name)
    assert (np.diff(spec.azimuth) < 0.0).all()
    assert np.ptp(spec.azimuth) == pytest.approx(2 * np.pi * (1 - 1 / spec.columns))


@pytest.mark.parametrize("name", FIRED_IN_TURN)
def test_lasers_of_a_column_fire_one_after_another(name: str) -> None:
    spec = get_lidar(name)
    times = spec.time_offset
    assert len(np.unique(np.round(times[:, 0], 10))) >= spec.rings / 16
    assert times[:, 0].max() < times[:, 1].min() + 1e-9
    assert np.abs(times).max() <= 0.5 * spec.period_s + 1e-9


def test_vlp_16_interleaves_its_lower_and_upper_lasers_every_2_304_microseconds() -> None:
    spec = get_lidar("vlp-16")
    order = np.argsort(spec.firing_s)
    assert np.array(spec.elevation_deg)[order][:6].tolist() == [-15, 1, -13, 3, -11, 5]
    np.testing.assert_allclose(np.diff(np.sort(spec.firing_s)), 2.304e-6, rtol=1e-9)
    assert spec.column_s == pytest.approx(55.296e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "at_once", "sequence_s"),
    [
        ("hdl-32e", 1, 46.08e-6),
        ("vlp-32c", 2, 55.296e-6),
        ("vls-128", 8, 53.3e-6),
        ("rs-ruby-plus", 4, 55.56e-6),
        ("hdl-64e-s2", 2, 48e-6),
    ],
)
def test_lasers_fire_in_groups(name: str, at_once: int, sequence_s: float) -> None:
    spec = get_lidar(name)
    _, sizes = np.unique(np.round(spec.firing_s, 10), return_counts=True)
    assert (sizes == at_once).all()
    assert spec.column_s == pytest.approx(sequence_s, rel=1e-3)


@pytest.mark.parametrize("name", ["hdl-64e-s2", "hdl-64e-s3"])
def test_both_blocks_of_the_hdl_64e_fire_together(name: str) -> None:
    firing = get_lidar(name).firing_s
    assert sorted(firing[:32]) == sorted(firing[32:])


def test_vls_128_rests_between_its_eighth_and_ninth_group() -> None:
    groups = np.unique(np.round(get_lidar("vls-128").firing_s, 10))
    np.testing.assert_allclose(np.diff(groups), [2.665e-6] * 7 + [5.33e-6] + [2.665e-6] * 7, rtol=1e-6)


def test_the_beams_of_an_ouster_fire_at_once() -> None:
    for name in ("os1-64", "os1-128"):
        assert np.ptp(get_lidar(name).time_offset, axis=0).max() == 0.0


def test_neighbouring_beams_of_the_dense_middle_look_aside_of_each_other() -> None:
    for name in ("hdl-64e-s3", "vlp-32c", "vls-128", "pandar64", "pandar128", "os1-64", "rs-ruby-plus"):
        spec = get_lidar(name)
        middle = np.abs(np.array(spec.elevation_deg) + 2.0) < 2.0
        assert np.abs(np.diff(np.array(spec.azimuth_offset_deg)[middle])).min() > 0.5


def test_at128_sees_near_with_every_fourth_row_and_far_with_its_middle() -> None:
    spec = get_lidar("at128")
    near, far = spec.beam_range.T
    assert (near == 0.5).sum() == 32 and (near == 7.2).sum() == 96
    assert np.abs(np.array(spec.elevation_deg)[far == 200.0]).max() < 6.4
    assert np.degrees(np.ptp(spec.azimuth)) == pytest.approx(119.9)


def test_opv2v_preset_follows_the_data_protocol() -> None:
    spec = get_lidar("opv2v-64")
    np.testing.assert_allclose(spec.elevation_deg, np.linspace(2.0, -25.0, 64), atol=1e-6)
    assert spec.rings * spec.columns * 20 == pytest.approx(1_300_000, rel=1e-3)
    assert (spec.range_max_m, spec.range_noise_m) == (120.0, 0.02)
    assert (spec.dropoff_rate, spec.dropoff_intensity_limit, spec.dropoff_zero_intensity) == (0.1, 0.7, 0.15)
    assert spec.intensity_law == "reflectivity"


def test_carla_intensity_depends_on_range_alone_and_the_world_is_frozen() -> None:
    spec = get_lidar("carla-64")
    assert (spec.intensity_law, spec.attenuation) == ("distance", 0.004)
    assert (spec.dropoff_rate, spec.dropoff_intensity_limit, spec.dropoff_zero_intensity) == (0.45, 0.8, 0.4)
    assert not spec.rolling_shutter
    assert np.abs(spec.time_offset).max() == 0.0


@pytest.mark.parametrize("name", ["debug-16", *REAL, *ROSETTES])
def test_only_simulated_sensors_lose_points_at_random(name: str) -> None:
    spec = get_lidar(name)
    assert spec.dropoff_rate == spec.dropoff_zero_intensity == 0.0


def test_field_of_view_of_a_roadside_unit_is_not_a_circle() -> None:
    spec = get_lidar("dair-roadside")
    assert np.degrees(spec.azimuth[[0, -1]]) == pytest.approx([-50.0, 49.9])
    assert spec.rings == 300


@pytest.mark.parametrize("name", list_scenarios())
def test_roadside_units_of_the_scenarios_look_down_on_the_road(name: str) -> None:
    for unit in load_scenario(name).agents.roadside:
        spec = get_lidar(unit.lidar)
        top, bottom = spec.elevation_deg[0] - unit.pitch_deg, spec.elevation_deg[-1] - unit.pitch_deg
        assert top <= 10.0
        assert unit.xyz_m[2] / np.tan(np.radians(-bottom)) < 15.0


def test_half_maximum_becomes_full_width() -> None:
    width = full_divergence(0.13)
    assert np.exp(-2.0 * (np.radians(0.13) / width) ** 2) == pytest.approx(0.5, abs=1e-3)


def test_a_typo_in_a_preset_name_gets_the_nearest_name() -> None:
    with pytest.raises(SettingsError, match=r"unknown lidar 'opv2v64'; did you mean 'opv2v-64'\?"):
        get_lidar("opv2v64")


def test_the_table_in_the_documentation_is_current() -> None:
    path = ROOT / "docs" / "lidar_presets.md"
    assert path.read_text() == document(), "python -m sensors.presets > docs/lidar_presets.md"


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_what_a_document_leaves_open_is_named_as_assumed(name: str) -> None:
    """An accuracy without its confidence is taken as one standard deviation, a divergence without its level as FWHM."""
    spec = get_lidar(name)
    if "taken as 1 sigma" in spec.source:
        assert "range_noise_m" in spec.assumed
    if "taken as full width" in spec.source:
        assert {"divergence_rad", "divergence_vertical_rad"} <= set(spec.assumed)
    assert ("taken as 1 sigma" in spec.source) == name.startswith(("vlp", "vls", "pandar"))
    assert ("taken as full width" in spec.source) == name.startswith("livox")
