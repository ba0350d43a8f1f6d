"""Rings by elevation: estimated for any sensor and order, refused for clouds without rings."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensors.corruptions.physics.rings import CREDIBLE, IDENTITIES, estimate_rings, measured_elevation, rings_of
from sensors.optics.beams import beams_of
from sensors.presets import get_lidar
from sensors.spec import LidarSpec
from sensors.sweep import make_sweep
from sim.errors import DataError
from tests.sensors.corruptions.street import spinning, street, synth16

few_examples = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def cloud(spec: LidarSpec, noise_m: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Points of a street in shuffled order, rounded to millimetres as files are, and the ring of each."""
    ray = beams_of(spec, 0.0).axis[:, :, : spec.columns].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.minimum(np.abs(np.where(ray[1] > 0, 9.0, -14.0) / ray[1]), np.where(ray[2] < 0, -1.9 / ray[2], 80.0))
    ring, column = np.nonzero(reach < 120.0)
    far = reach[ring, column] + rng().normal(0.0, noise_m, len(ring))
    order = rng().permutation(len(ring))
    return np.round(ray[:, ring, column].T * far[:, None], 3)[order].astype(np.float32), ring[order]


def rank(ring: np.ndarray) -> np.ndarray:
    """Rings counted without those that have no points."""
    return np.unique(ring, return_inverse=True)[1]


def at_elevation(points: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    flat = np.hypot(points[:, 0], points[:, 1])
    return np.column_stack([points[:, :2], flat * np.tan(elevation)])


@few_examples
@given(
    gaps=st.lists(st.floats(0.12, 3.0), min_size=1, max_size=130).filter(lambda gaps: sum(gaps) < 60.0),
    top=st.floats(-5.0, 25.0),
    columns=st.integers(60, 200),
    start=st.floats(-180.0, 180.0),
    clockwise=st.booleans(),
)
def test_uneven_rings_are_found_in_any_order_from_any_start(
    gaps: list[float], top: float, columns: int, start: float, clockwise: bool
) -> None:
    elevation = top - np.cumsum([0.0, *gaps])
    spec = LidarSpec(
        name="any",
        elevation_deg=tuple(elevation.tolist()),
        columns=columns,
        azimuth_start_deg=start,
        azimuth_end_deg=start + 360.0,
        clockwise=clockwise,
    )
    points, ring = cloud(spec, noise_m=0.0)
    found = estimate_rings(points)
    assert (found.ring == rank(ring)).all()
    assert (np.diff(found.elevation) < 0.0).all() and found.quality > 0.8
    assert np.allclose(np.degrees(found.elevation), elevation[np.unique(ring)], atol=0.01)


@pytest.mark.parametrize(
    "name", ["debug-16", "vlp-16", "vlp-32c", "pandar40p", "hdl-64e-s2", "pandar128", "rs-ruby-plus", "dair-roadside"]
)
def test_real_sensors_of_16_to_300_rings(name: str) -> None:
    points, ring = cloud(get_lidar(name))
    found = estimate_rings(points)
    assert (found.ring == rank(ring)).all() and found.quality > 0.9


def test_the_rings_of_the_golden_cloud() -> None:
    sweep = synth16()
    found = estimate_rings(sweep.points, rings=16)
    assert (found.ring == sweep.ring).all()


def test_the_order_of_the_points_does_not_matter() -> None:
    points, _ = cloud(spinning(40))
    order = rng(5).permutation(len(points))
    first, second = estimate_rings(points), estimate_rings(points[order])
    assert (first.ring[order] == second.ring).all() and first.quality == pytest.approx(second.quality)


def test_strays_between_the_rings_are_no_rings() -> None:
    points, ring = cloud(spinning(64))
    stray = rng(2).random(len(points)) < 0.02
    points = np.where(stray[:, None], at_elevation(points, rng(3).uniform(-0.4, 0.05, len(points))), points)
    found = estimate_rings(points)
    assert len(found.elevation) == len(np.unique(ring))
    assert (found.ring == rank(ring))[~stray].all()


def test_beams_that_do_not_start_in_one_point() -> None:
    points, ring = cloud(get_lidar("hdl-64e-s2"))
    points[:, 2] += np.where(ring < 32, 0.2155 - 0.0007 * ring, 0.16 - 0.0012 * (ring - 32))
    assert (estimate_rings(points).ring == rank(ring)).mean() > 0.999


@pytest.mark.parametrize("way_m", [0.4, -1.1, 2.0])
def test_points_compensated_for_the_sensors_motion(way_m: float) -> None:
    points, ring = cloud(get_lidar("pandar64"))
    points[:, 0] += way_m * np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    assert (estimate_rings(points).ring == rank(ring)).mean() > 0.999


def test_quality_falls_with_noise_until_rings_are_refused() -> None:
    points, ring = cloud(spinning(64))
    spacing = np.radians(28.0 / 63.0)
    exact = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    noise = rng().standard_normal(len(points))
    quality = []
    for share in (0.0, 0.05, 0.1):
        found = estimate_rings(at_elevation(points, exact + share * spacing * noise))
        assert (found.ring == rank(ring)).mean() > 0.999
        quality.append(found.quality)
    assert quality[0] > quality[1] > quality[2] > CREDIBLE
    with pytest.raises(DataError, match=f"expected elevations of quality {CREDIBLE} or more, found points of quality"):
        estimate_rings(at_elevation(points, exact + 0.3 * spacing * noise))


def test_clouds_without_rings_are_refused() -> None:
    points, _ = cloud(spinning(64))
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.1), -np.sin(0.1)], [0.0, np.sin(0.1), np.cos(0.1)]])
    rosette = beams_of(get_lidar("livox-mid-70"), 0.0).axis.reshape(3, -1).T * 20.0
    merged = np.concatenate([points, points + np.array([10.0, 3.0, 0.5])])
    for bad in (rng().normal(0.0, 10.0, (5000, 3)), points @ tilt.T, rosette, merged):
        with pytest.raises(DataError, match="points: rings: expected"):
            estimate_rings(bad)


@few_examples
@given(count=st.integers(2, 300), seed=st.integers(0, 1000))
def test_a_handful_of_points_anywhere_is_refused(count: int, seed: int) -> None:
    with pytest.raises(DataError):
        estimate_rings(rng(seed).normal(0.0, 10.0, (count, 3)))


def test_more_rings_than_the_sensor_has_are_refused() -> None:
    points, ring = cloud(spinning(20))
    seen = len(np.unique(ring))
    assert len(estimate_rings(points, rings=seen).elevation) == seen
    with pytest.raises(DataError, match="expected elevations of quality"):
        estimate_rings(points, rings=seen // 2 + 1)


def test_no_point_one_point_and_one_ring() -> None:
    assert estimate_rings(np.zeros((0, 3))).ring.shape == (0,)
    one = estimate_rings(np.array([[3.0, 4.0, -1.0]]))
    assert one.ring.tolist() == [0] and one.elevation == pytest.approx([np.arctan2(-1.0, 5.0)]) and one.quality == 1.0
    flat = cloud(spinning(1))[0]
    assert (estimate_rings(flat).ring == 0).all()
    assert estimate_rings(np.zeros((3, 3))).ring.tolist() == [0, 0, 0]


def test_recorded_rings_are_taken_as_they_are() -> None:
    sweep = street(spinning(16))
    rings = rings_of(sweep, "test")
    assert rings.count == 16 and rings.ring is sweep.ring and (rings.identity == np.arange(16)).all()
    told = make_sweep(sweep.points, ring=sweep.ring)
    assert rings_of(told, "test").count == sweep.ring.max() + 1
    bare = rings_of(make_sweep(sweep.points), "test")
    assert (bare.ring == rank(sweep.ring)).all()
    assert np.allclose(bare.elevation, measured_elevation(sweep.points, rank(sweep.ring), bare.count))


@pytest.mark.parametrize("ring", [16, -1])
def test_rings_outside_the_sensor_are_refused_in_one_line(ring: int) -> None:
    points = street(spinning(16)).points[:50]
    wrong = make_sweep(points, spec=spinning(16), ring=np.full(50, ring))
    with pytest.raises(DataError, match=r"beam_missing: ring: expected rings from 0 of the 16 of 'test', found"):
        rings_of(wrong, "beam_missing")


def test_a_ring_keeps_its_identity_while_others_have_no_points() -> None:
    points, ring = cloud(spinning(32))
    whole = rings_of(make_sweep(points), "test")
    present = np.isin(ring, np.unique(ring)[::3], invert=True)
    part = rings_of(make_sweep(points[present]), "test")
    assert (part.identity[part.ring] == whole.identity[whole.ring][present]).all()
    assert len(set(whole.identity)) == whole.count and whole.identity.max() < IDENTITIES
