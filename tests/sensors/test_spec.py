import msgspec
import numpy as np
import pytest

from sensors.spec import LIDARS, LidarSpec, get_lidar
from sim.errors import SettingsError


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_presets_list_beams_from_the_top_and_name_their_source(name):
    spec = get_lidar(name)
    assert spec.name == name
    assert (np.diff(spec.elevation_deg) < 0).all()
    assert len(spec.azimuth) == len(spec.time_offset) == spec.columns
    assert spec.source


def test_opv2v_preset_follows_the_data_protocol():
    spec = get_lidar("opv2v-64")
    np.testing.assert_allclose(spec.elevation_deg, np.linspace(2.0, -25.0, 64), atol=1e-6)
    assert spec.rings * spec.columns * 20 == pytest.approx(1_300_000, rel=1e-3)
    assert (spec.range_max_m, spec.range_noise_m, spec.dropoff_rate) == (120.0, 0.02, 0.1)


def test_firing_times_are_centred_on_the_reference_time():
    spec = get_lidar("opv2v-64")
    assert spec.time_offset.mean() == pytest.approx(0.0, abs=1e-12)
    assert -0.05 < spec.time_offset[0] < spec.time_offset[-1] < 0.05


def test_field_of_view_of_a_roadside_unit_is_not_a_circle():
    spec = get_lidar("dair-roadside")
    assert np.degrees(spec.azimuth[[0, -1]]) == pytest.approx([-50.0, 49.9])
    assert spec.rings == 300


def test_a_typo_in_a_preset_name_gets_the_nearest_name():
    with pytest.raises(SettingsError, match=r"unknown lidar 'opv2v64'; did you mean 'opv2v-64'\?"):
        get_lidar("opv2v64")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"elevation_deg": (-1.0, 1.0)}, "elevation_deg"),
        ({"columns": 0}, "columns"),
        ({"range_min_m": 200.0}, "range"),
        ({"dropoff_rate": 1.5}, "dropoff"),
        ({"azimuth_end_deg": 181.0}, "azimuth"),
    ],
)
def test_impossible_sensors_are_refused(changes, field):
    with pytest.raises(SettingsError, match=field):
        msgspec.structs.replace(get_lidar("debug-16"), **changes)


def test_spec_survives_json():
    spec = get_lidar("vlp-32c")
    assert msgspec.json.decode(msgspec.json.encode(spec), type=LidarSpec) == spec
