import msgspec
import numpy as np
import pytest
from numpy.typing import ArrayLike

from sensors.optics.beams import beams_of
from sensors.optics.livox import rosette_axes
from sensors.presets import get_lidar
from sensors.spec import LidarSpec, Prism
from sim.errors import SettingsError


def thrown(spec: LidarSpec, time_s: ArrayLike) -> np.ndarray:
    """Degrees from the axis of the only line at some times."""
    azimuth, elevation = rosette_axes(spec, np.atleast_2d(time_s))
    return np.degrees(np.arccos(np.cos(azimuth) * np.cos(elevation)))


def wedges(*prisms: Prism) -> LidarSpec:
    return msgspec.structs.replace(get_lidar("livox-mid-70"), prisms=prisms)


def pattern(name: str, sweeps: int, first: int = 0) -> np.ndarray:
    """(3, N) directions of a run of sweeps."""
    spec = get_lidar(name)
    times = (first + np.arange(sweeps)) / spec.rate_hz
    return np.concatenate([beams_of(spec, t).axis.reshape(3, -1) for t in times], axis=1)


def cells(directions: np.ndarray, degrees: float = 1.0) -> set[tuple[int, ...]]:
    azimuth = np.degrees(np.arctan2(directions[1], directions[0]))
    elevation = np.degrees(np.arcsin(directions[2]))
    keys = np.stack([azimuth // degrees, elevation // degrees], axis=1).astype(int)
    return {tuple(key) for key in np.unique(keys, axis=0)}


@pytest.mark.parametrize("slanted_exit", [False, True])
def test_a_thin_wedge_bends_by_its_angle_times_the_index_less_one_towards_its_thick_end(slanted_exit: bool) -> None:
    spec = wedges(Prism(rate_hz=10.0, wedge_deg=0.5, refraction=1.5, slanted_exit=slanted_exit))
    azimuth, elevation = rosette_axes(spec, np.array([[0.0, 0.025, 0.05, 0.075]]))
    np.testing.assert_allclose(np.degrees(elevation[0]), [0.25, 0.0, -0.25, 0.0], atol=1e-4)
    np.testing.assert_allclose(np.degrees(azimuth[0]), [0.0, 0.25, 0.0, -0.25], atol=1e-4)


def test_a_thick_wedge_obeys_snell_at_both_faces() -> None:
    wedge, n = np.radians(20.0), 1.51
    into = wedge - np.arcsin(np.sin(wedge) / n)
    entry = np.degrees(np.arcsin(n * np.sin(into)))
    out = np.degrees(np.arcsin(n * np.sin(wedge)) - wedge)
    for slanted_exit, angle in ((False, entry), (True, out)):
        spec = wedges(Prism(rate_hz=7.0, wedge_deg=20.0, refraction=n, slanted_exit=slanted_exit))
        np.testing.assert_allclose(thrown(spec, np.linspace(0.0, 1.0, 50)), angle, atol=1e-9)


def test_glass_of_air_and_wedges_against_each_other_bend_nothing() -> None:
    air = wedges(Prism(rate_hz=7.0, wedge_deg=20.0, refraction=1.0))
    np.testing.assert_allclose(thrown(air, np.linspace(0.0, 1.0, 50)), 0.0, atol=1e-5)
    # Slanted faces inside, thick ends opposite: a plate with plane parallel faces, cut through its middle.
    pair = wedges(
        Prism(rate_hz=-10.0, wedge_deg=20.0, refraction=1.51, slanted_exit=True),
        Prism(rate_hz=10.0, wedge_deg=20.0, refraction=1.51),
    )
    np.testing.assert_allclose(thrown(pair, np.array([0.025, 0.075])), 0.0, atol=1e-5)
    assert thrown(pair, 0.0) > 20.0


@pytest.mark.parametrize(("name", "width", "height"), [("livox-mid-70", 70.4, 70.4), ("livox-avia", 70.4, 77.2)])
def test_the_rosette_has_the_field_of_view_of_the_datasheet(name: str, width: float, height: float) -> None:
    x, y, z = pattern(name, 20)
    assert np.ptp(np.degrees(np.arctan2(y, x))) == pytest.approx(width, abs=1.2)
    assert np.ptp(np.degrees(np.arcsin(z))) == pytest.approx(height, abs=1.2)
    assert np.degrees(np.arccos(x)).max() < height / 2 + 1.0


@pytest.mark.parametrize("name", ["livox-mid-70", "livox-avia"])
def test_the_rosette_does_not_repeat_and_fills_its_field_of_view(name: str) -> None:
    seen, covered = set(), []
    for sweep in range(10):
        seen |= cells(pattern(name, 1, first=sweep), 0.5)
        covered.append(len(seen))
    assert (np.diff(covered) > 0).all()
    assert covered[-1] > 1.15 * covered[0]
    inside = {(a, e) for a in range(-20, 20) for e in range(-20, 20)}
    assert len(inside & cells(pattern(name, 10), 1.0)) > 0.99 * len(inside)


def test_a_rosette_depends_on_the_time_and_a_spinning_head_does_not() -> None:
    rosette, spinning = get_lidar("livox-avia"), get_lidar("vlp-16")
    assert not np.allclose(beams_of(rosette, 1.0).axis, beams_of(rosette, 1.1).axis)
    assert beams_of(spinning, 1.0) is beams_of(spinning, 1.1)
    np.testing.assert_array_equal(beams_of(rosette, 1.0).axis, beams_of(rosette, 1.0).axis)


def test_the_pattern_continues_smoothly_from_sweep_to_sweep() -> None:
    first, then = (beams_of(get_lidar("livox-mid-70"), t).axis[:, 0, :10_000] for t in (3.0, 3.1))
    step = np.linalg.norm(np.diff(np.concatenate([first[:, -3:], then[:, :3]], axis=1), axis=1), axis=0)
    np.testing.assert_allclose(step, step.mean(), rtol=0.05)


def test_the_lines_of_the_avia_are_spread_over_seven_degrees() -> None:
    spec = get_lidar("livox-avia")
    still = msgspec.structs.replace(spec, prisms=(Prism(rate_hz=1.0, wedge_deg=10.0, refraction=1.0),))
    _, elevation = rosette_axes(still, np.zeros((6, 1)))
    np.testing.assert_allclose(np.degrees(elevation[:, 0]), spec.elevation_deg, atol=1e-9)


def test_wedges_that_reflect_the_beam_totally_are_refused() -> None:
    spec = wedges(Prism(rate_hz=1.0, wedge_deg=44.0, refraction=1.51, slanted_exit=True))
    with pytest.raises(SettingsError, match=r"livox-mid-70': prisms: .*, found total reflection"):
        beams_of(spec, 0.0)
