from typing import Any

import msgspec
import numpy as np
import pytest

from sensors.optics.beams import BLOCK, beams_of, halo
from sensors.presets import LIDARS, get_lidar
from sensors.spec import LidarSpec

SPINNING = sorted(name for name, spec in LIDARS.items() if not spec.prisms)


def spec_of(name: str = "debug-16", **changes: Any) -> LidarSpec:
    return msgspec.structs.replace(get_lidar(name), **changes)


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation of (..., 3, R, W) unit vectors, rad."""
    x, y, z = np.moveaxis(directions.astype(np.float64), -3, 0)
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def turned(difference: np.ndarray) -> np.ndarray:
    return (difference + np.pi) % (2 * np.pi) - np.pi


def test_beams_point_at_the_elevation_of_their_ring_and_the_azimuth_of_their_column() -> None:
    spec = spec_of(elevation_deg=(10.0, -20.0), columns=4)
    azimuth, elevation = angles(beams_of(spec, 0.0).axis[:, :, :4])
    np.testing.assert_allclose(np.degrees(elevation), [[10.0] * 4, [-20.0] * 4], atol=1e-5)
    np.testing.assert_allclose(np.degrees(azimuth) % 360.0, [[180.0, 270.0, 0.0, 90.0]] * 2, atol=1e-5)


def test_a_clockwise_head_looks_right_after_ahead() -> None:
    spec = spec_of(elevation_deg=(0.0,), columns=4, clockwise=True)
    azimuth, _ = angles(beams_of(spec, 0.0).axis[:, :, :4])
    np.testing.assert_allclose(turned(azimuth[0] - np.radians([180.0, 90.0, 0.0, -90.0])), 0.0, atol=1e-6)


def test_a_beam_looks_aside_by_its_offset() -> None:
    spec = spec_of(elevation_deg=(1.0, 0.0), azimuth_offset_deg=(3.0, -5.0), columns=360)
    azimuth, _ = angles(beams_of(spec, 0.0).axis[:, :, :360])
    offset = np.degrees(turned(azimuth - spec.azimuth))
    np.testing.assert_allclose(offset, [[3.0] * 360, [-5.0] * 360], atol=1e-4)


@pytest.mark.parametrize(("clockwise", "turn"), [(False, 0.25), (True, -0.25)])
def test_the_head_keeps_turning_until_a_beam_fires(clockwise: bool, turn: float) -> None:
    quarter = 0.25 * 0.1 / 360
    spec = spec_of(elevation_deg=(1.0, 0.0), firing_s=(0.0, quarter), columns=360, clockwise=clockwise)
    azimuth, _ = angles(beams_of(spec, 0.0).axis[:, :, :360])
    np.testing.assert_allclose(np.degrees(turned(azimuth[1] - azimuth[0])), turn, atol=1e-4)
    np.testing.assert_allclose(beams_of(spec, 0.0).firing_share, [0.0, 0.25], atol=1e-6)


def test_a_beam_has_one_ray_along_its_axis_by_default() -> None:
    beams = beams_of(get_lidar("vlp-16"), 0.0)
    np.testing.assert_array_equal(beams.subray[0], beams.axis)
    assert len(beams.subray) == 1


@pytest.mark.parametrize("subrays", [4, 8])
@pytest.mark.parametrize("vertical", [None, 0.0015])
def test_sub_rays_have_the_second_moments_of_the_beam(subrays: int, vertical: float | None) -> None:
    spec = spec_of("vlp-16", subrays=subrays, divergence_rad=0.006, divergence_vertical_rad=vertical)
    beams = beams_of(spec, 0.0)
    up = np.array([0.0, 0.0, 1.0])
    for ring, column in ((0, 0), (7, 500), (15, 1111)):
        axis, rays = beams.axis[:, ring, column], beams.subray[:, :, ring, column].astype(np.float64)
        left = np.cross(up, axis) / np.linalg.norm(np.cross(up, axis))
        across, along = rays @ left, rays @ np.cross(axis, left)
        # The full width at 1/e^2 is four standard deviations.
        expected = np.diag([0.006**2, (vertical or 0.006) ** 2]) / 16.0
        np.testing.assert_allclose(np.cov(across, along, bias=True), expected, atol=2e-9)
        np.testing.assert_allclose([across.mean(), along.mean()], 0.0, atol=1e-6)


def test_columns_come_in_whole_blocks_that_repeat_the_last() -> None:
    beams = beams_of(spec_of(columns=37), 0.0)
    assert beams.axis.shape[2] == 3 * BLOCK == BLOCK * beams.blocks
    assert beams.columns == 37
    np.testing.assert_array_equal(beams.axis[:, :, 37:], np.repeat(beams.axis[:, :, 36:37], 11, axis=2))
    np.testing.assert_array_equal(beams.fan.azimuth[37:], beams.fan.azimuth[36])


def test_whole_blocks_need_no_padding() -> None:
    assert beams_of(spec_of(columns=32), 0.0).axis.shape[2] == 32


def test_a_rosette_repeats_its_last_firing_too() -> None:
    beams = beams_of(spec_of("livox-avia", columns=37), 0.0)
    np.testing.assert_array_equal(beams.axis[:, :, 37:], np.repeat(beams.axis[:, :, 36:37], 11, axis=2))
    assert beams.fan is None


@pytest.mark.parametrize("name", SPINNING)
def test_no_ray_leaves_the_spread_of_its_column_and_ring(name: str) -> None:
    beams = beams_of(spec_of(name, subrays=8, columns=64, firing_s=(), angle_noise_deg=0.0), 0.0)
    azimuth, elevation = angles(beams.subray)
    rounding = 1e-6
    assert np.abs(turned(azimuth - beams.fan.azimuth)).max() <= beams.fan.spread + rounding
    assert np.abs(elevation - beams.fan.elevation[:, None]).max() <= beams.fan.spread + rounding


def test_the_spread_holds_for_steep_beams_with_jitter() -> None:
    spec = spec_of(elevation_deg=(80.0, -80.0), angle_noise_deg=0.2, subrays=4, divergence_rad=0.01)
    beams = beams_of(spec, 0.0)
    tilt = halo(spec)
    axis = beams.axis[:, 0, 0].astype(np.float64)
    left = np.cross([0.0, 0.0, 1.0], axis)
    left /= np.linalg.norm(left)
    around = np.linspace(0.0, 2 * np.pi, 361)
    aside = np.cos(around)[:, None] * left + np.sin(around)[:, None] * np.cross(axis, left)
    rays = np.cos(tilt) * axis + np.sin(tilt) * aside
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    assert np.abs(turned(azimuth - beams.fan.azimuth[0])).max() <= beams.fan.spread
    assert np.abs(turned(azimuth - beams.fan.azimuth[0])).max() > 5 * tilt


def test_reach_is_that_of_each_beam() -> None:
    beams = beams_of(get_lidar("at128"), 0.0)
    np.testing.assert_allclose(beams.reach, get_lidar("at128").beam_range)
    np.testing.assert_allclose(beams_of(get_lidar("vlp-16"), 0.0).reach, [[0.5, 100.0]] * 16)
