import math
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from sensors.presets import get_lidar
from sensors.spec import LidarSpec, Prism
from sim.errors import SettingsError

NAN = math.nan
WEDGE = Prism(rate_hz=10.0, wedge_deg=20.0, refraction=1.5)

REFUSED = [
    # field, what is wrong, what the error must say was expected
    ("elevation_deg", {"elevation_deg": ()}, "at least one beam"),
    ("elevation_deg", {"elevation_deg": (0.0,) * 32768, "columns": 1}, "at most 32767 beams"),
    ("elevation_deg", {"elevation_deg": (NAN,)}, "angles within"),
    ("elevation_deg", {"elevation_deg": (91.0, 0.0)}, "angles within"),
    ("elevation_deg", {"elevation_deg": (-1.0, 1.0)}, "the highest beam first"),
    ("columns", {"columns": 0}, "at least 1"),
    ("columns", {"columns": -5}, "at least 1"),
    ("columns", {"columns": 10**9}, "at most 20000000 rays"),
    ("columns", {"columns": 10**6, "subrays": 8}, "at most 20000000 rays"),
    ("subrays", {"subrays": 3}, "1, 4 or 8"),
    ("subrays", {"subrays": 0}, "1, 4 or 8"),
    ("rate_hz", {"rate_hz": 0.0}, "a positive rate"),
    ("rate_hz", {"rate_hz": NAN}, "a positive rate"),
    ("rate_hz", {"rate_hz": math.inf}, "a positive rate"),
    ("azimuth_offset_deg", {"azimuth_offset_deg": (0.0, 1.0)}, "one value for each of the 16 beams"),
    ("azimuth_offset_deg", {"azimuth_offset_deg": (NAN,) * 16}, "angles within"),
    ("azimuth_offset_deg", {"azimuth_offset_deg": (181.0,) * 16}, "angles within"),
    ("firing_s", {"firing_s": (0.0,)}, "one value for each of the 16 beams"),
    ("firing_s", {"firing_s": (-1e-6,) * 16}, "times in"),
    ("firing_s", {"firing_s": (0.1 / 360,) * 16}, "times in"),
    ("firing_s", {"firing_s": (NAN,) * 16}, "times in"),
    ("azimuth_start_deg", {"azimuth_start_deg": NAN}, "within"),
    ("azimuth_start_deg", {"azimuth_start_deg": -361.0, "azimuth_end_deg": -180.0}, "within"),
    ("azimuth_end_deg", {"azimuth_end_deg": 181.0}, "by at most 360"),
    ("azimuth_end_deg", {"azimuth_end_deg": -180.0}, "more than azimuth_start_deg"),
    ("azimuth_end_deg", {"azimuth_end_deg": NAN}, "more than azimuth_start_deg"),
    ("prisms", {"prisms": (msgspec.structs.replace(WEDGE, rate_hz=NAN),)}, "finite rates"),
    ("prisms", {"prisms": (WEDGE, msgspec.structs.replace(WEDGE, wedge_deg=45.0))}, "wedges within 45 degrees"),
    ("prisms", {"prisms": (msgspec.structs.replace(WEDGE, wedge_deg=0.0),)}, "wedges within 45 degrees"),
    ("prisms", {"prisms": (msgspec.structs.replace(WEDGE, refraction=0.9),)}, "refraction of at least 1"),
    ("range_min_m", {"range_min_m": 200.0}, "range_min_m < range_max_m"),
    ("range_min_m", {"range_min_m": -0.1}, "0 <= range_min_m"),
    ("range_min_m", {"range_max_m": NAN}, "range_min_m < range_max_m"),
    ("range_max_m", {"range_max_m": math.inf}, "a finite range"),
    ("beam_range_m", {"beam_range_m": ((1.0, 100.0),)}, "one value for each of the 16 beams"),
    ("beam_range_m", {"beam_range_m": ((5.0, 5.0),) * 16}, "nearest < farthest"),
    ("beam_range_m", {"beam_range_m": ((0.1, 50.0),) * 16}, "within those of the sensor"),
    ("beam_range_m", {"beam_range_m": ((1.0, 500.0),) * 16}, "within those of the sensor"),
    ("beam_range_m", {"beam_range_m": ((NAN, 50.0),) * 16}, "nearest < farthest"),
    ("range_10_m", {"range_10_m": 0.0}, "a positive range"),
    ("range_10_m", {"range_10_m": math.inf}, "a positive range"),
    ("range_noise_m", {"range_noise_m": -0.01}, "at least 0"),
    ("range_noise_m", {"range_noise_m": NAN}, "at least 0"),
    ("angle_noise_deg", {"angle_noise_deg": -0.1}, "0 to 10"),
    ("angle_noise_deg", {"angle_noise_deg": 11.0}, "0 to 10"),
    ("dropoff_rate", {"dropoff_rate": 1.5}, "a share in"),
    ("dropoff_rate", {"dropoff_rate": NAN}, "a share in"),
    ("dropoff_intensity_limit", {"dropoff_intensity_limit": -0.1}, "a share in"),
    ("dropoff_zero_intensity", {"dropoff_zero_intensity": 1.1}, "a share in"),
    ("divergence_rad", {"divergence_rad": -0.001}, "0 to 0.1 rad"),
    ("divergence_rad", {"divergence_rad": NAN, "divergence_vertical_rad": 0.0}, "0 to 0.1 rad"),
    ("divergence_vertical_rad", {"divergence_vertical_rad": 0.2}, "0 to 0.1 rad"),
    ("pulse_s", {"pulse_s": 0.0}, "0 to 1 microsecond"),
    ("pulse_s", {"pulse_s": 1e-3}, "0 to 1 microsecond"),
    ("attenuation", {"attenuation": -1.0}, "at least 0"),
    ("attenuation", {"attenuation": NAN}, "at least 0"),
    ("mount_xyz_m", {"mount_xyz_m": (0.0, NAN, 1.9)}, "finite coordinates"),
    ("returns", {"returns": "first"}, "strongest"),
    ("intensity_law", {"intensity_law": "linear"}, "reflectivity"),
    ("blocked_deg", {"blocked_deg": ((10.0, -10.0, 0.0),)}, "sectors within"),
    ("blocked_deg", {"blocked_deg": ((0.0, 200.0, 0.0),)}, "sectors within"),
    ("blocked_deg", {"blocked_deg": ((0.0, 90.0, NAN),)}, "sectors within"),
    ("blocked_deg", {"blocked_deg": ((0.0, 90.0, 0.0),), "prisms": (WEDGE,)}, "of a head that turns"),
    ("intensity_curve", {"intensity_curve": ((0.0, 0.0),)}, "knots from (0, 0) on"),
    ("intensity_curve", {"intensity_curve": ((0.0, 0.1), (1.0, 1.0))}, "knots from (0, 0) on"),
    ("intensity_curve", {"intensity_curve": ((0.0, 0.0), (1.0, 1.1))}, "up to 1"),
    ("intensity_curve", {"intensity_curve": ((0.0, 0.0), (0.5, 0.9), (1.0, 0.8))}, "that grow"),
    ("intensity_curve", {"intensity_curve": ((0.0, 0.0), (NAN, 0.5))}, "that grow"),
    (
        "intensity_law",
        {"intensity_curve": ((0.0, 0.0), (1.0, 1.0)), "intensity_law": "power"},
        "beside intensity_curve",
    ),
    (
        "dropoff_zero_intensity",
        {"intensity_curve": ((0.0, 0.0), (1.0, 1.0)), "dropoff_zero_intensity": 0.5},
        "0 beside intensity_curve",
    ),
    ("intensity_fade_m", {"intensity_fade_m": (20.0, 20.0)}, "two ranges that grow"),
    ("intensity_fade_m", {"intensity_fade_m": (NAN, 20.0)}, "two ranges that grow"),
    ("lacquer", {"lacquer": 1.5}, "a share in"),
    ("lacquer", {"lacquer": NAN}, "a share in"),
    ("assumed", {"assumed": ("wavelength_nm",)}, "names of fields"),
]


@pytest.mark.parametrize(("field", "changes", "expected"), REFUSED)
def test_an_impossible_sensor_is_refused_with_its_name_the_field_what_was_expected_and_found(
    field: str, changes: dict[str, Any], expected: str
) -> None:
    found = changes.get(field, getattr(get_lidar("debug-16"), field))
    shown = found if isinstance(found, str) else repr(found)
    with pytest.raises(SettingsError, match=re.escape(expected)) as error:
        msgspec.structs.replace(get_lidar("debug-16"), **changes)
    message = str(error.value)
    assert message.startswith(f"LidarSpec 'debug-16': {field}: expected ")
    assert f"found {shown[:40]}" in message
    assert "\n" not in message


def test_every_fact_about_a_sensor_has_a_refusal_here() -> None:
    facts = {(field, expected) for field, expected, _ in get_lidar("debug-16")._facts()}
    untested = {
        (field, expected)
        for field, expected in facts
        if not any(field == f and part in expected for f, _, part in REFUSED)
    }
    assert not untested


def test_a_sensor_at_the_limits_is_fine() -> None:
    msgspec.structs.replace(
        get_lidar("debug-16"),
        elevation_deg=(90.0, 0.0, 0.0, -90.0),
        columns=1,
        range_min_m=0.0,
        azimuth_start_deg=-360.0,
        azimuth_end_deg=0.0,
        dropoff_rate=1.0,
        divergence_rad=0.0,
    )


MISTAKEN = [
    # field, a value of another type, what the error must say was expected
    ("name", 5, "text"),
    ("columns", 100.5, "a whole number"),
    ("columns", "100", "a whole number"),
    ("columns", True, "a whole number"),
    ("columns", NAN, "a whole number"),
    ("columns", 10**400, "a whole number"),
    ("subrays", None, "a whole number"),
    ("range_max_m", "120", "a number"),
    ("range_max_m", np.array([1.0, 2.0]), "a number"),
    ("rate_hz", None, "a number"),
    ("divergence_vertical_rad", "0.003", "a number or None"),
    ("own_body", "no", "True or False"),
    ("rolling_shutter", 0, "True or False"),
    ("elevation_deg", 3.0, "a table of numbers"),
    ("elevation_deg", None, "a table of numbers"),
    ("elevation_deg", "12", "a table of numbers"),
    ("elevation_deg", (2.0, "a"), "a table of numbers"),
    ("elevation_deg", np.zeros((2, 2)), "a table of numbers"),
    ("azimuth_offset_deg", {0.0}, "a table of numbers"),
    ("beam_range_m", [1.0, 2.0], "a table of pairs of numbers"),
    ("beam_range_m", [(1.0, 2.0, 3.0)] * 16, "a table of pairs of numbers"),
    ("mount_xyz_m", (0.0, 1.9), "three numbers"),
    ("prisms", [{"rate_hz": 1.0}], "a table of Prism"),
    ("returns", ["last"], "one of ('strongest', 'last', 'dual')"),
    ("intensity_law", np.array(["power", "distance"]), "one of ('reflectivity', 'distance', 'power')"),
    ("blocked_deg", [(0.0, 1.0)], "a table of triples of numbers"),
    ("intensity_curve", [0.0, 1.0], "a table of pairs of numbers"),
    ("intensity_fade_m", (1.0,), "two numbers"),
    ("lacquer", None, "a number"),
    ("assumed", ("columns", 3), "a table of texts"),
    ("source", None, "text"),
]


@pytest.mark.parametrize(("field", "found", "expected"), MISTAKEN)
def test_a_value_of_another_type_is_refused_like_an_impossible_one(field: str, found: Any, expected: str) -> None:
    with pytest.raises(SettingsError, match=re.escape(f"{field}: expected {expected}, found ")) as error:
        msgspec.structs.replace(get_lidar("debug-16"), **{field: found})
    assert " ".join(repr(found).split())[:30] in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("field", "found"), [("rate_hz", "10"), ("wedge_deg", None), ("slanted_exit", "no")])
def test_a_prism_of_other_types_is_refused(field: str, found: str | None) -> None:
    with pytest.raises(SettingsError, match=f"Prism: {field}: expected .*, found {found!r}"):
        msgspec.structs.replace(WEDGE, **{field: found})


@pytest.mark.parametrize("kind", [list, np.array, lambda table: np.array(table, np.float32)])
def test_tables_may_be_lists_and_arrays(kind: Callable[..., Any]) -> None:
    tables = {
        "elevation_deg": (2.0, 0.5, -1.0),
        "azimuth_offset_deg": (0.25, 0.0, -0.25),
        "beam_range_m": ((1.0, 50.0),) * 3,
        "mount_xyz_m": (0.0, 0.5, 2.0),
    }
    plain = LidarSpec(name="x", columns=36, **tables)
    given = LidarSpec(name="x", columns=np.int32(36), **{field: kind(table) for field, table in tables.items()})
    assert given == plain
    assert hash(given) == hash(plain)
    assert msgspec.to_builtins(given) == msgspec.to_builtins(plain)


def test_a_misspelt_field_is_refused() -> None:
    with pytest.raises(TypeError, match="ring_count"):
        LidarSpec(name="x", elevation_deg=(0.0,), columns=1, ring_count=3)


def test_columns_share_the_field_of_view_evenly_in_both_directions() -> None:
    spec = msgspec.structs.replace(
        get_lidar("debug-16"), azimuth_start_deg=-60.0, azimuth_end_deg=60.0, columns=4, clockwise=True
    )
    np.testing.assert_allclose(np.degrees(spec.azimuth), [60.0, 30.0, 0.0, -30.0])
    back = msgspec.structs.replace(spec, clockwise=False)
    np.testing.assert_allclose(np.degrees(back.azimuth), [-60.0, -30.0, 0.0, 30.0])


def test_firing_times_are_centred_on_the_reference_time() -> None:
    spec = get_lidar("opv2v-64")
    assert spec.time_offset.shape == (64, 1016)
    assert spec.time_offset.mean() == pytest.approx(0.0, abs=1e-12)
    assert -0.05 < spec.time_offset[0, 0] < spec.time_offset[0, -1] < 0.05


def test_beams_fire_in_the_middle_of_their_column_by_default() -> None:
    spec = msgspec.structs.replace(get_lidar("debug-16"), elevation_deg=(1.0, 0.0), columns=100)
    assert spec.time_offset[0, 50] == pytest.approx(0.5 * 1e-3)
    told = msgspec.structs.replace(spec, firing_s=(0.0, 2e-4))
    np.testing.assert_allclose(told.time_offset[:, 50], [0.0, 2e-4], atol=1e-12)


def test_without_a_rolling_shutter_everything_fires_at_once() -> None:
    spec = msgspec.structs.replace(get_lidar("vlp-16"), rolling_shutter=False)
    assert np.abs(spec.time_offset).max() == 0.0


def test_beams_have_the_range_of_the_sensor_by_default() -> None:
    np.testing.assert_array_equal(get_lidar("debug-16").beam_range, [[0.5, 120.0]] * 16)
    told = msgspec.structs.replace(get_lidar("debug-16"), beam_range_m=((1.0, 50.0),) * 16)
    np.testing.assert_array_equal(told.beam_range, [[1.0, 50.0]] * 16)


def test_a_full_turn_may_start_anywhere() -> None:
    start = 152.11373162672265  # start + 360 - start is a little more than 360 in floating point
    assert (
        msgspec.structs.replace(
            get_lidar("debug-16"), azimuth_start_deg=start, azimuth_end_deg=start + 360.0
        ).azimuth_end_deg
        > start
    )
