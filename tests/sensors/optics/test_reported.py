"""What sensors of data sets report: hidden sectors, their own scale of intensity, paint under clear coat."""

from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
import pytest
import trimesh

from sensors.corruptions.physics.medium import rays_of
from sensors.corruptions.physics.receiver import reported_intensity, target_power
from sensors.optics.reflectance import optics_of, reported
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.bodies.choice import body_mesh, models_for
from sim.geometry import pose_matrix
from sim.mesh.materials import MATERIALS, material_index
from tests.sensors.fakes import box_body, cars, ground, ideal

UNSET_FIELDS = ("blocked_deg", "intensity_curve", "intensity_fade_m", "lacquer")
CURVE = ((0.0, 0.0), (0.1, 0.3), (1.0, 0.5), (4.0, 0.9))

INTENSITIES = {
    # medians of vehicles and of the ground in real sweeps, least and greatest
    "hdl-64e-kitti": ((0.0, 0.08), (0.25, 0.32)),
    "vlp-32c-av2": ((0.008, 0.051), (0.024, 0.043)),
}
RETURNS_KITTI = {4: (0.993, 1.0), 5: (0.926, 0.965), 6: (0.865, 0.871), 7: (0.635, 0.678)}
"""Returns of the lowest eighths of the beams, as a share of the fullest, in three sweeps of KITTI."""


@pytest.fixture(params=["public", "fused"])
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


def test_a_sensor_without_a_scale_of_its_own_is_written_as_before() -> None:
    for name in ("hdl-64e-s2", "opv2v-64"):
        assert not set(UNSET_FIELDS) & set(msgspec.to_builtins(get_lidar(name)))
    written = msgspec.json.encode(get_lidar("hdl-64e-kitti"))
    assert all(field.encode() in written for field in UNSET_FIELDS)
    assert msgspec.json.decode(written, type=LidarSpec) == get_lidar("hdl-64e-kitti")


def test_the_scale_changes_intensities_alone_and_keeps_their_order(engine: str) -> None:
    plain, own = ideal(), ideal(intensity_curve=CURVE)
    road, beyond = (street_sweep(engine, spec) for spec in (plain, own))
    assert len(road) > 5000
    np.testing.assert_array_equal(road.points, beyond.points)
    np.testing.assert_array_equal(road.cosine, beyond.cosine)
    below = road.intensity < 0.999
    law, scale = np.array(CURVE).T
    np.testing.assert_allclose(beyond.intensity[below], np.interp(road.intensity[below], law, scale), atol=1e-4)
    order = np.argsort(road.intensity)
    assert (np.diff(beyond.intensity[order]) > -1e-4).all()


def test_retroreflectors_lie_beyond_white_on_the_scale(engine: str) -> None:
    signs = ground()
    signs.face_attributes["material"][:] = material_index("sign")
    sweep = still(RayScene(signs, engine=engine), ideal(intensity_curve=CURVE))
    assert (sweep.intensity > 0.89).all() and (sweep.intensity <= 0.9).all()
    assert (still(RayScene(signs, engine=engine), ideal()).intensity > 0.99).all()


def test_intensity_fades_with_range_and_points_stay(engine: str) -> None:
    scene, fade = RayScene(ground(), engine=engine), (20.0, 60.0)
    plain, faded = still(scene, ideal()), still(scene, ideal(intensity_fade_m=fade))
    np.testing.assert_array_equal(plain.points, faded.points)
    near, far = plain.range <= fade[0], plain.range >= fade[1]
    assert near.sum() > 100 and far.sum() > 100
    np.testing.assert_array_equal(plain.intensity[near], faded.intensity[near])
    assert not faded.intensity[far].any()


def test_hidden_sectors_lose_their_beams_and_nothing_else(engine: str) -> None:
    scene, sector = RayScene(ground(), engine=engine), (150.0, 170.0, -10.0)
    whole, seen = still(scene, ideal()), still(scene, ideal(blocked_deg=(sector,)))
    azimuth = np.degrees(np.arctan2(whole.points[:, 1], whole.points[:, 0]))
    elevation = np.degrees(np.arcsin(whole.points[:, 2] / whole.range))
    # Beams on the border of the sector may be on either side of it.
    inside = (azimuth > 150.01) & (azimuth < 169.99) & (elevation < -10.01)
    outside = (azimuth < 149.99) | (azimuth > 170.01) | (elevation > -9.99)
    kept = np.isin(keys(whole), keys(seen))
    assert inside.sum() > 50
    assert not kept[inside].any() and kept[outside].all()
    np.testing.assert_array_equal(whole.points[kept], seen.points)


def test_weather_returns_nothing_from_hidden_sectors() -> None:
    spec = ideal(blocked_deg=((-180.0, 180.0, 90.0),))
    sweep = still(RayScene(ground()), spec)
    assert len(sweep) == 0
    assert len(rays_of(sweep, None, np.random.default_rng(0))) == 0
    assert len(rays_of(still(RayScene(ground()), ideal())[:0], None, np.random.default_rng(0))) > 1000


def test_clear_coat_darkens_paint_alone_and_the_more_the_less_it_lets_through() -> None:
    bare, thin, thick = (optics_of(spec).power for spec in (ideal(), ideal(lacquer=0.4), ideal(lacquer=0.04)))
    for row, material in enumerate(MATERIALS):
        if material.name.startswith("paint_") or material.finish in ("lacquer", "flakes"):
            assert (thick[row, 1:] < thin[row, 1:]).all()
            if material.reflectivity > 0.1:
                assert (thin[row, 1:] < bare[row, 1:]).all()
        else:
            np.testing.assert_array_equal(thick[row], bare[row])


def test_power_and_intensity_of_a_calibrated_sensor_agree_in_weather() -> None:
    spec = ideal(intensity_curve=CURVE, intensity_fade_m=(20.0, 60.0))
    sweep = street_sweep("public", spec)
    distance = sweep.range.astype(np.float64)
    again = reported_intensity(spec, target_power(sweep, distance), distance)
    diffuse = np.isin(sweep.material, [k for k, m in enumerate(MATERIALS) if m.finish == "diffuse"])
    assert diffuse.sum() > 5000
    np.testing.assert_allclose(again[diffuse], sweep.intensity[diffuse], atol=2e-3)


@pytest.mark.parametrize("name", sorted(INTENSITIES))
def test_a_reported_intensity_never_falls_as_the_power_grows(name: str) -> None:
    spec = get_lidar(name)
    power = np.linspace(0.0, 10.0, 2001)
    for distance in (5.0, 30.0, 70.0):
        values = reported(spec, power, np.full(len(power), distance))
        assert (np.diff(values) >= 0.0).all()
        assert 0.0 == values[0] and values[-1] <= 1.0


@pytest.mark.parametrize("name", sorted(INTENSITIES))
def test_medians_of_vehicles_and_of_the_ground_are_those_of_real_sweeps(name: str) -> None:
    sweep = simulated(name)
    on_car = sweep.object_id >= 0
    near = (sweep.range > 2.5) & (sweep.range < 60.0)
    assert (on_car & near).sum() > 1000 and (~on_car & near).sum() > 5000
    for among, (low, high) in zip((on_car, ~on_car), INTENSITIES[name], strict=True):
        assert low <= np.median(sweep.intensity[among & near]) <= high


def test_the_lowest_rings_return_as_much_as_in_kitti() -> None:
    spec = get_lidar("hdl-64e-kitti")
    counts = np.bincount(still(RayScene(ground()), spec).ring, minlength=64)
    full = np.quantile(counts, 0.9)
    for eighth, (low, high) in RETURNS_KITTI.items():
        assert low <= np.minimum(counts[8 * eighth : 8 * eighth + 8] / full, 1.0).mean() <= high


def test_two_upside_down_sensors_of_av2_see_up_as_far_as_down() -> None:
    elevation = np.array(get_lidar("vlp-32c-av2").elevation_deg)
    assert len(elevation) == 64
    assert abs(elevation[0] + elevation[-1]) < 0.5 and elevation[0] > 24.0


def still(scene: RayScene, spec: LidarSpec) -> Sweep:
    pose = pose_matrix([0.0, 0.0, 1.73])
    return scan(scene, spec, pose, pose, 0.0, np.random.default_rng(0))


def keys(sweep: Sweep) -> np.ndarray:
    return sweep.ring.astype(np.int64) * 10_000 + sweep.column


def street() -> trimesh.Trimesh:
    """A road of asphalt between verges of grass."""
    road, verges = ground(), ground()
    road.vertices[:, 1] *= 0.03
    road.vertices[:, 2] += 0.02
    road.face_attributes["material"][:] = material_index("asphalt")
    verges.face_attributes["material"][:] = material_index("ground")
    return trimesh.util.concatenate([road, verges])


def street_sweep(engine: str, spec: LidarSpec) -> Sweep:
    scene = RayScene(street(), body_mesh=box_body, engine=engine)
    return still(scene.with_bodies(cars([(9.0, 3.0, 0.0), (-15.0, -3.0, 0.0)])), spec)


@lru_cache(maxsize=2)
def simulated(name: str) -> Sweep:
    """Return a sweep of the sensor between cars of all paints."""
    models = models_for("car")
    rows = [(7.0 * (k + 1) * (-1) ** k, 3.0 * (-1) ** (k // 2), 0.0) for k in range(len(models))]

    actors = replace(cars(rows), model=models)
    scene = RayScene(street(), body_mesh=body_mesh).with_bodies(actors)
    return still(scene, get_lidar(name))
