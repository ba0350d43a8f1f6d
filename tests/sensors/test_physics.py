"""What any LiDAR must measure, whichever engine makes the sweep."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
import trimesh

from sensors.motion import Path
from sensors.optics.reflectance import COSINE_BINS, optics_of, returned_power, wet_reflectivity
from sensors.presets import LIDARS, get_lidar
from sensors.scan.lidar import Sensor, scan, scan_all
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import POINT_FIELDS, STATIC, Sweep
from sim.errors import DataError, SettingsError
from sim.geometry import pose_matrix
from sim.mesh.materials import MATERIALS, material_index
from sim.traffic.base import Actors
from tests.sensors.fakes import BRIGHT, CAR, box, box_body, cars, ground, ideal, painted

SENSOR = pose_matrix([0.0, 0.0, 1.9])
ENGINES = ("public", "fused")


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


def scene_of(engine: str, static: trimesh.Trimesh | None, actors: Actors | None = None, **motion: Any) -> RayScene:
    scene = RayScene(static, body_mesh=box_body, engine=engine)
    return scene if actors is None else scene.with_bodies(actors, **motion)


def still(scene: RayScene, spec: LidarSpec, pose: np.ndarray = SENSOR, seed: int = 0, **more: Any) -> Sweep:
    return scan(scene, spec, pose, pose, 0.0, np.random.default_rng(seed), **more)


def test_points_lie_on_a_sphere_around_the_sensor(engine: str) -> None:
    ball = painted(trimesh.creation.icosphere(subdivisions=6, radius=20.0))
    sweep = still(scene_of(engine, ball), ideal(), pose_matrix([1.0, -2.0, 0.5], 0.7, 0.2, -0.1))
    # The facets of the ball are up to 3 mm inside it: its own planes are what is measured.
    face = ball.ray.intersects_first(
        np.tile([[1.0, -2.0, 0.5]], (len(sweep), 1)), sweep.world_points - np.array([1.0, -2.0, 0.5])
    )
    off = np.einsum("ij,ij->i", sweep.world_points - ball.triangles_center[face], ball.face_normals[face])
    assert np.abs(off).max() < 1e-4
    assert np.abs(np.linalg.norm(sweep.world_points, axis=1) - 20.0).max() < 4e-3


def test_points_in_a_box_room_are_analytic(engine: str) -> None:
    half = np.array([12.0, 9.0, 6.0])
    spec = ideal("opv2v-64")
    sweep = still(scene_of(engine, box(2 * half)), spec, pose_matrix([0.0, 0.0, 0.0]))
    assert len(sweep) == spec.rings * spec.columns
    elevation, azimuth = spec.elevation[sweep.ring], spec.azimuth[sweep.column]
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    with np.errstate(divide="ignore"):
        expected = direction * (half / np.abs(direction)).min(axis=1, keepdims=True)
    np.testing.assert_allclose(sweep.points, expected, rtol=0.0, atol=1e-4)


def test_points_lie_on_a_tilted_plane(engine: str) -> None:
    plane = ground(200.0)
    tilt = pose_matrix([0.0, 0.0, 0.0], 0.3, 0.06, -0.04)
    plane.apply_transform(tilt)
    sweep = still(scene_of(engine, plane), ideal("opv2v-64"))
    assert len(sweep) > 10_000
    assert np.abs(sweep.world_points @ tilt[:3, 2]).max() < 1e-4


def test_rings_on_flat_ground_lie_where_geometry_says(engine: str) -> None:
    spec = ideal("opv2v-64")
    sweep = still(scene_of(engine, ground()), spec)
    expected = 1.9 / np.tan(-spec.elevation[sweep.ring])
    np.testing.assert_allclose(np.hypot(sweep.points[:, 0], sweep.points[:, 1]), expected, rtol=1e-5)
    np.testing.assert_allclose(sweep.cosine, np.sin(-spec.elevation[sweep.ring]), rtol=1e-4)


def test_points_on_a_car_fall_with_the_square_of_its_distance(engine: str) -> None:
    view = {"azimuth_start_deg": -15.0, "azimuth_end_deg": 15.0}
    spec = ideal("opv2v-64", columns=341, elevation_deg=tuple(np.linspace(6.5, -6.5, 512).tolist()), **view)
    counts = []
    for distance in (10.0, 20.0, 40.0, 80.0):
        scene = scene_of(engine, None, cars([[distance + 0.5 * CAR[0], 0.0, 0.0]]))
        sweep = still(scene, spec, pose_matrix([0.0, 0.0, 0.75]))
        solid_angle = 4.0 * np.arctan(CAR[1] * CAR[2] / (4.0 * distance * np.hypot(distance, 0.5 * np.hypot(*CAR[1:]))))
        per_ray = np.radians(30.0) / spec.columns * np.radians(13.0 / 511.0)
        counts.append((len(sweep), solid_angle / per_ray))
    made, expected = np.array(counts).T
    np.testing.assert_allclose(made, expected, rtol=0.05)


def test_a_sensor_above_a_vertex_of_the_mesh_loses_no_ground(engine: str) -> None:
    side = np.arange(-60.0, 61.0, 2.0)
    x, y = np.meshgrid(side, side, indexing="ij")
    count = len(side)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + count, corner + 1], 1),
            np.stack([corner + 1, corner + count, corner + count + 1], 1),
        ]
    )
    grid = painted(trimesh.Trimesh(np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()]), faces, process=False))
    spec = ideal("opv2v-64", columns=3600, elevation_deg=tuple(np.linspace(-2.0, -89.0, 64).tolist()))
    sweep = still(scene_of(engine, grid), spec)
    assert len(sweep) == spec.rings * spec.columns


@pytest.mark.parametrize("name", [material.name for material in MATERIALS if material.finish != "glass"])
def test_intensity_follows_the_law_of_its_material(engine: str, name: str) -> None:
    index = material_index(name)
    road = ground()
    road.face_attributes["material"][:] = index
    sweep = still(scene_of(engine, road), ideal("opv2v-64"))
    assert len(sweep) > 10_000
    law = returned_power(MATERIALS[index], sweep.cosine.astype(float)) * np.exp(-2.0 * 2e-4 * sweep.range.astype(float))
    np.testing.assert_allclose(sweep.intensity, np.minimum(law, 1.0), atol=2e-3, rtol=5e-3)
    assert (sweep.material == index).all()


@pytest.mark.parametrize("range_10_m", [40.0, 300.0, 1e4])
@pytest.mark.parametrize("distance", [3.0, 60.0])
@pytest.mark.parametrize("subrays", [1, 4])
def test_window_panes_are_seen_only_when_hit_squarely(
    engine: str, range_10_m: float, distance: float, subrays: int
) -> None:
    pane = box((0.1, 60.0, 30.0), (distance + 0.05, 0.0, 0.0), material_index("glass"))
    spec = ideal("opv2v-64", range_10_m=range_10_m, subrays=subrays)
    sweep = still(scene_of(engine, pane), spec, pose_matrix([0.0, 0.0, 0.0]))
    # The pane is square to the x axis.
    angle = np.degrees(np.arccos(np.cos(spec.elevation)[:, None] * np.cos(spec.azimuth)))
    on_it = np.zeros(angle.shape, bool)
    on_it[sweep.ring, sweep.column] = True
    assert on_it[angle < 3.5].all()
    assert not on_it[angle > 5.3].any()
    assert (angle < 3.5).sum() > 60


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_every_preset_sees_panes_squarely_at_any_range_and_aslant_at_none(name: str) -> None:
    optics = optics_of(get_lidar(name))
    pane = optics.power[material_index("glass")]
    angle = np.degrees(np.arccos(np.linspace(0.0, 1.0, COSINE_BINS + 1)))
    assert pane[-1] > optics.need.max()
    assert not pane[angle > 5.1].any()


def test_a_pane_that_mirrors_a_beam_away_joins_no_echoes(engine: str) -> None:
    """Two walls 2.1 m apart are two echoes of a 10 ns pulse, with a slanted pane half-way between them or without.

    Of the beams that go past the edge of the near wall, the upper half meets the pane.
    """
    near, far = (box((0.001, 5.0, 40.0), (14.0, 2.5, 0.0)), box((0.2, 40.0, 40.0), (16.1, 0.0, 0.0)))
    pane = box((0.001, 40.0, 4.0), (0.0, 0.0, 2.0), material_index("glass"))
    pane.apply_transform(pose_matrix([15.0, 0.0, 0.0], 0.0, 0.3))
    spec = ideal(subrays=8, divergence_rad=0.02, elevation_deg=(0.0,), columns=3600, returns="dual")
    pose = pose_matrix([0.0, 0.0, 0.0])
    without, behind = (still(scene_of(engine, static), spec, pose) for static in (near + far, near + far + pane))
    for sweep in (without, behind):
        ahead = sweep[(np.abs(sweep.points[:, 1]) < 0.2) & (sweep.points[:, 0] > 0.0)]
        assert (sweep.return_number == 2).any()
        assert ((ahead.points[:, 0] < 14.01) | (ahead.points[:, 0] > 15.98)).all()


def test_wet_ground_is_darker_and_wet_plates_are_not(engine: str) -> None:
    road, plate = ground(), ground()
    road.face_attributes["material"][:] = material_index("asphalt")
    plate.face_attributes["material"][:] = material_index("plate")
    spec = ideal("opv2v-64")
    dry, wet = (still(scene_of(engine, road), spec, wetness=w) for w in (0.0, 1.0))
    ratio = wet_reflectivity(0.15) / 0.15
    np.testing.assert_allclose(wet.intensity / dry.intensity, ratio, rtol=1e-3)
    assert 0.5 < ratio < 0.6
    shiny = [still(scene_of(engine, plate), spec, wetness=w).intensity for w in (0.0, 1.0)]
    np.testing.assert_array_equal(*shiny)


def test_carla_s_intensity_depends_on_the_range_alone(engine: str) -> None:
    spec = ideal("opv2v-64", intensity_law="distance", attenuation=0.004)
    sweep = still(scene_of(engine, ground(), cars([[9.0, 2.0, 0.3]])), spec)
    np.testing.assert_allclose(sweep.intensity, np.exp(-0.004 * sweep.range), atol=1e-4)


def leaf(engine: str) -> RayScene:
    """A wall at 20 m and a leaf at 14 m whose edge runs straight ahead."""
    static = box((0.2, 40.0, 40.0), (20.1, 0.0, 0.0)) + box((0.001, 5.0, 40.0), (14.0, 2.5, 0.0))
    return scene_of(engine, static)


@pytest.mark.parametrize("subrays", [4, 8])
def test_a_beam_on_the_edge_of_a_leaf_has_two_returns(engine: str, subrays: int) -> None:
    spec = ideal(
        subrays=subrays, returns="dual", divergence_rad=0.02, pulse_s=5e-9, elevation_deg=(1.0, 0.0, -1.0), columns=3600
    )
    sweep = still(leaf(engine), spec, pose_matrix([0.0, 0.0, 0.0]))
    sweep = sweep[(np.abs(sweep.points[:, 1]) < 0.3) & (sweep.points[:, 0] > 0.0)]
    key = sweep.ring.astype(int) * spec.columns + sweep.column
    both = np.flatnonzero(np.diff(key) == 0)
    assert len(both) >= 3
    assert (sweep.return_number[both] == 1).all() and (sweep.return_number[both + 1] == 2).all()
    np.testing.assert_allclose(sweep.points[both, 0], 14.0, atol=5e-3)
    np.testing.assert_allclose(sweep.points[both + 1, 0], 20.0, atol=0.01)
    # Each surface fills a part of the beam.
    assert (sweep.intensity[both] + sweep.intensity[both + 1] < MATERIALS[BRIGHT].reflectivity * 1.01).all()


def test_one_return_is_the_strongest_or_the_last(engine: str) -> None:
    spec = ideal(subrays=4, divergence_rad=0.02, pulse_s=5e-9, elevation_deg=(1.0, 0.0, -1.0), columns=3600)
    made = {}
    for returns in ("strongest", "last"):
        made[returns] = still(
            leaf(engine), msgspec.structs.replace(spec, returns=returns), pose_matrix([0.0, 0.0, 0.0])
        )
    edge = np.abs(made["last"].points[:, 1]) < 0.1
    assert made["strongest"].range.min() < 14.5
    assert (made["last"].points[edge & (made["last"].points[:, 0] > 0.0), 0] > 13.99).all()
    assert len(made["last"]) == len(made["strongest"])
    assert (made["last"].range >= made["strongest"].range - 1e-4).all()


def test_surfaces_within_a_pulse_length_are_one_mixed_point(engine: str) -> None:
    static = box((0.2, 40.0, 40.0), (20.1, 0.0, 0.0)) + box((0.001, 5.0, 40.0), (19.6, 2.5, 0.0))
    spec = ideal(subrays=4, divergence_rad=0.02, pulse_s=1e-8, elevation_deg=(0.0,), columns=3600, returns="dual")
    sweep = still(scene_of(engine, static), spec, pose_matrix([0.0, 0.0, 0.0]))
    ahead = sweep[np.abs(sweep.points[:, 1]) < 0.08]
    assert (np.diff(ahead.column) > 0).all()
    between = (ahead.points[:, 0] > 19.7) & (ahead.points[:, 0] < 19.95)
    assert between.any()


def test_the_own_body_is_seen_by_sensors_that_are_not_cropped(engine: str) -> None:
    scene = scene_of(engine, ground(), cars([[0.0, 0.0, 0.0]], size=(4.5, 1.8, 1.5)))
    steep = {"elevation_deg": tuple(np.linspace(0.0, -60.0, 32).tolist())}
    masked = still(scene, ideal(**steep), exclude_id=1000)
    seen = still(scene, ideal(own_body=True, **steep), exclude_id=1000)
    assert (masked.object_id == STATIC).all()
    assert (seen.object_id == 1000).sum() > 500


def test_more_sensors_than_a_ray_mask_has_bits_each_miss_their_own_body(engine: str) -> None:
    count = 40
    rows = np.column_stack([6.0 * (np.arange(count) % 8), 5.0 * (np.arange(count) // 8), np.zeros(count)])
    actors = cars(rows)
    scene = scene_of(engine, ground(), actors)
    spec = ideal(columns=90, elevation_deg=tuple(np.linspace(0.0, -50.0, 8).tolist()))
    sensors = []
    for row, key in enumerate(actors.boxes.object_id):
        path = Path.through([-0.05, 0.05], np.stack([pose_matrix([*rows[row, :2], 1.9])] * 2))
        sensors.append(Sensor(spec, path, 0.0, np.random.default_rng(row), rides_on=int(key)))
    for sensor, sweep in zip(sensors, scan_all(scene, sensors), strict=True):
        assert sensor.rides_on not in sweep.object_id
        assert len(np.unique(sweep.object_id)) > 3


def test_a_world_500_km_away_gives_the_same_sweep(engine: str) -> None:
    offset = np.array([500_000.0, 5_700_000.0, 0.0])
    far_cars = cars([[9.0, 4.0, 0.4]], speed=7.0)
    far_cars.boxes.center[:] += offset
    near = scene_of(engine, ground() + box((6, 3, 5), (12.0, -6.0, 2.5)), cars([[9.0, 4.0, 0.4]], speed=7.0))
    there = ground() + box((6, 3, 5), (12.0, -6.0, 2.5))
    there.apply_translation(offset)
    a = still(near, ideal("opv2v-64"))
    b = still(scene_of(engine, there, far_cars), ideal("opv2v-64"), pose_matrix(offset + SENSOR[:3, 3]))
    np.testing.assert_array_equal(a.object_id, b.object_id)
    np.testing.assert_allclose(a.range, b.range, atol=5e-4)


@pytest.mark.parametrize("name", ["opv2v-64", "vlp-16", "at128", "livox-avia"])
def test_one_seed_gives_the_same_bytes_on_one_thread_and_on_two(engine: str, name: str) -> None:
    actors = cars([[0.0, 0.0, 0.0], [9.0, 3.0, 0.2], [-12.0, -5.0, 2.0]], speed=[8.0, 5.0, 0.0])
    scene = scene_of(engine, ground() + box((8, 20, 9), (25.0, 0.0, 4.5)), actors)
    path = Path.through([-0.1, 0.1], np.stack([pose_matrix([-0.8, 0, 1.9]), pose_matrix([0.8, 0, 1.9], 0.02)]))

    def sweeps(threads: int) -> list[Sweep]:
        sensors = [Sensor(get_lidar(name), path, 0.0, np.random.default_rng(k), 1000) for k in range(3)]
        return scan_all(scene, sensors, threads=threads)

    for one, two in zip(sweeps(1), sweeps(2), strict=True):
        assert len(one) > 100
        for field in POINT_FIELDS:
            assert getattr(one, field).tobytes() == getattr(two, field).tobytes()


def test_firing_times_of_beams_move_with_the_sensor(engine: str) -> None:
    """A sensor that drives at 30 m/s fires its last beam 50 us after its first: 1.5 mm farther on."""
    firing = tuple(np.linspace(0.0, 5e-5, 16).tolist())
    spec = ideal(firing_s=firing, columns=1800)
    start, end = pose_matrix([-1.5, 0.0, 0.0]), pose_matrix([1.5, 0.0, 0.0])
    half = np.array([15.0, 11.0, 5.0])
    sweep = scan(scene_of(engine, box(2 * half)), spec, start, end, 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(sweep.world_points / half).max(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(sweep.time_offset, spec.time_offset[sweep.ring, sweep.column], atol=1e-8)
    fired_at = np.column_stack([30.0 * sweep.time_offset, np.zeros((len(sweep), 2))])
    ray = sweep.points - fired_at
    elevation = np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1]))
    np.testing.assert_allclose(elevation, spec.elevation[sweep.ring], atol=1e-5)


def test_a_car_that_brakes_and_turns_is_met_where_it_is(engine: str) -> None:
    times = np.array([-0.1, 0.0, 0.1])
    rows = [[12.0 - 8.0 * t - 3.0 * t**2, 3.0 + 2.0 * t, 0.4 + 0.9 * t] for t in times]
    before, now, after = (replace(cars([row]), time_s=t) for row, t in zip(rows, times, strict=True))
    scene = scene_of(engine, None, now, before=before, after=after)
    sweep = still(scene, ideal("opv2v-64"))
    assert len(sweep) > 300
    path = scene.bodies.path[0]
    moments, which = np.unique(sweep.time_offset, return_inverse=True)
    body_from_world = np.linalg.inv(path.at(moments.astype(float)))[which]
    local = np.einsum("nij,nj->ni", body_from_world[:, :3, :3], sweep.world_points) + body_from_world[:, :3, 3]
    half = 0.5 * np.array(CAR)
    off = np.abs(np.abs(local - [0.0, 0.0, half[2]]) - half).min(axis=1)
    assert off.max() < 5e-4


def test_jitter_turns_the_ray_and_not_the_point(engine: str) -> None:
    spec = ideal("opv2v-64", angle_noise_deg=0.1)
    room = box((30, 30, 30))
    clean = still(scene_of(engine, room), ideal("opv2v-64"), pose_matrix([0.0, 0.0, 0.0]))
    noisy = still(scene_of(engine, room), spec, pose_matrix([0.0, 0.0, 0.0]))
    assert len(clean) == len(noisy)
    cosine = np.einsum("ij,ij->i", clean.points, noisy.points) / (clean.range * noisy.range)
    np.testing.assert_allclose(cosine, 1.0, atol=1e-6)
    assert 0.001 < np.std(noisy.range - clean.range) < 0.1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_mesh_with_nan_or_infinity_is_refused(bad: float) -> None:
    mesh = ground()
    mesh.vertices = np.where(np.arange(4)[:, None] == 2, bad, mesh.vertices)
    with pytest.raises(DataError, match="static world: vertices: expected finite coordinates"):
        RayScene(mesh)


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(SettingsError, match="the name of an engine, found fast"):
        RayScene(ground(), engine="fast")


def test_tables_of_power_hold_every_material() -> None:
    table = optics_of(ideal()).power
    assert table.shape == (len(MATERIALS), COSINE_BINS + 1)
    assert (np.diff(table, axis=1) >= -1e-6).all()


@pytest.mark.parametrize("bad", [len(MATERIALS), 255])
def test_an_unknown_material_is_refused(bad: int) -> None:
    mesh = ground()
    mesh.face_attributes["material"][1] = bad
    with pytest.raises(DataError, match=f"material: expected an index below {len(MATERIALS)}, found {bad} of face 1"):
        RayScene(mesh)


def test_a_sweep_longer_than_its_bodies_motion_is_refused() -> None:
    scene = scene_of("public", ground(), cars([[9.0, 0.0, 0.0]]))
    with pytest.raises(SettingsError, match=r"time: expected within the -0\.05 to 0\.05 s"):
        still(scene, ideal(rate_hz=5.0))


@pytest.mark.parametrize("wetness", [-0.1, 1.5, np.nan])
def test_a_wetness_outside_0_to_1_is_refused(wetness: float) -> None:
    with pytest.raises(SettingsError, match="wetness: expected 0 to 1"):
        still(scene_of("public", ground()), ideal(), wetness=wetness)


def test_engines_agree_on_cars_that_turn() -> None:
    rows = [[9.0, 4.0, 0.3], [-8.0, 7.0, 2.0], [4.0, -11.0, -1.0], [22.0, -3.0, 1.2]]
    moved = [[9.4, 4.3, 0.35], [-8.6, 7.5, 2.1], [4.5, -11.4, -1.15], [22.9, -2.2, 1.4]]
    back = [[8.6, 3.7, 0.25], [-7.4, 6.5, 1.9], [3.5, -10.6, -0.85], [21.1, -3.8, 1.0]]
    before, now, after = (replace(cars(table), time_s=t) for table, t in ((back, -0.1), (rows, 0.0), (moved, 0.1)))
    made = []
    for engine in ENGINES:
        scene = scene_of(engine, ground(), now, before=before, after=after)
        made.append(still(scene, ideal("opv2v-64", columns=2048)))
    keys = [sweep.ring.astype(int) * 4096 + sweep.column for sweep in made]
    both, a, b = np.intersect1d(*keys, return_indices=True)
    apart = np.linalg.norm(made[0].points[a].astype(float) - made[1].points[b], axis=1) > 5e-4
    apart |= made[0].object_id[a] != made[1].object_id[b]
    assert apart.sum() + len(keys[0]) + len(keys[1]) - 2 * len(both) <= 5
    assert (made[0].object_id >= 1000).sum() > 1000
