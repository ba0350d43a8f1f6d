"""What any engine must do."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike

from sensors.motion import Path
from sensors.raycast import Solid, open_engine
from sensors.raycast.base import Engine
from sensors.scan.lidar import Sensor, scan_all
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec, Prism
from sensors.sweep import POINT_FIELDS, STATIC, Sweep
from sim.geometry import pose_matrix
from sim.mesh.materials import material_index
from sim.traffic.base import Actors
from tests.sensors.fakes import box, box_body, cars, ground
from tests.sensors.raycast.oracle import Oracle

ENGINES = ("public", "fused")

EIGHT = LidarSpec(
    name="eight",
    elevation_deg=(8.0, 3.0, 0.0, -3.0, -6.0, -10.0, -16.0, -25.0),
    columns=77,
    range_max_m=60.0,
    range_10_m=25.0,
    range_noise_m=0.03,
)
SPECS = {
    "plain": {},
    "clockwise and partial": {"clockwise": True, "azimuth_start_deg": -70.0, "azimuth_end_deg": 95.0},
    "one beam after another": {
        "firing_s": tuple(0.0001 * i for i in range(8)),
        "azimuth_offset_deg": (4.0, -4.0, 1.0, -1.0) * 2,
    },
    "all at once": {"rolling_shutter": False},
    "own ranges": {"beam_range_m": tuple((2.0 * i + 1.0, 20.0 + 5.0 * i) for i in range(8))},
    "lost": {"dropoff_rate": 0.3, "dropoff_zero_intensity": 0.9, "dropoff_intensity_limit": 0.7},
    "jitter": {"angle_noise_deg": 1.0},
    "by distance": {"intensity_law": "distance", "attenuation": 0.02},
    "by power": {"intensity_law": "power"},
    "four rays": {"subrays": 4, "divergence_rad": 0.05},
    "four rays, last": {"subrays": 4, "divergence_rad": 0.05, "returns": "last"},
    "eight rays, dual": {"subrays": 8, "divergence_rad": 0.05, "divergence_vertical_rad": 0.02, "returns": "dual"},
    "dual with everything": {
        "subrays": 4,
        "divergence_rad": 0.08,
        "returns": "dual",
        "angle_noise_deg": 0.5,
        "dropoff_rate": 0.1,
        "firing_s": tuple(0.0001 * i for i in range(8)),
    },
    "rosette": {"prisms": (Prism(-130.0, 18.0, 1.51), Prism(70.0, 17.0, 1.51)), "columns": 600},
}


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Engine:
    return open_engine(request.param)


def town() -> trimesh.Trimesh:
    walls = [box((30.0, 1.0, 6.0), (5.0, 14.0, 3.0)), box((1.0, 20.0, 2.0), (-12.0, -5.0, 1.0))]
    sign = box((0.1, 1.0, 1.0), (9.0, -3.0, 2.5), material_index("sign"))
    pane = box((0.1, 6.0, 4.0), (18.0, 0.0, 2.0), material_index("glass"))
    road = ground(90.0)
    road.face_attributes["material"][:] = material_index("asphalt")
    mesh = trimesh.util.concatenate([road, *walls, sign, pane])
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def traffic() -> tuple[Actors, ...]:
    """Cars that turn, speed up and brake within a sweep; one carries the sensor, one stands across its last column."""
    table = [[0.0, 0.0, 0.3], [7.0, 2.0, 0.2], [-8.0, 0.5, 3.0], [3.0, -9.0, 1.5], [14.0, 7.0, -2.0], [-20.0, 0.0, 0.1]]
    rows = np.array(table)
    before, after = rows.copy(), rows.copy()
    before[:, 0] -= 1.5
    after[:, 0] += 2.5
    before[:, 2] += 0.1
    after[:, 2] += 0.15
    return tuple(cars(at, time_s=t, speed=20.0) for at, t in ((rows, 3.0), (before, 2.93), (after, 3.06)))


def scene_in(engine: Engine, static: trimesh.Trimesh | None = None) -> RayScene:
    scene = RayScene(town() if static is None else static, body_mesh=box_body)
    scene.engine = engine
    return scene.with_bodies(*traffic())


def sensor_of(spec: LidarSpec, seed: int = 0, rides_on: int | None = 1000) -> Sensor:
    times = np.array([2.93, 3.0, 3.06])
    poses = pose_matrix([[-1.5, 0.0, 1.9], [0.0, 0.0, 1.9], [2.5, 0.1, 2.0]], [0.2, 0.3, 0.5], [0.0, 0.02, 0.0], 0.01)
    return Sensor(spec, Path.through(times, poses), 3.0, np.random.default_rng(seed), rides_on)


def scan_in(engine: Engine, spec: LidarSpec, threads: int = 1) -> Sweep:
    return scan_all(scene_in(engine), [sensor_of(spec)], threads=threads)[0]


@pytest.mark.parametrize("name", SPECS)
def test_an_engine_measures_what_the_definition_says(engine: Engine, name: str) -> None:
    spec = msgspec.structs.replace(EIGHT, **SPECS[name])
    made, expected = scan_in(engine, spec), scan_in(Oracle(), spec)
    assert len(expected) > 0.1 * spec.rings * spec.columns
    assert len(set(expected.object_id.tolist())) >= 3
    assert 1000 not in made.object_id

    def key(sweep: Sweep) -> np.ndarray:
        return (sweep.ring.astype(np.int64) * spec.columns + sweep.column) * 2 + sweep.return_number - 1

    keys, theirs = key(made), key(expected)
    assert (np.diff(keys) > 0).all()
    # Rays along the edge of a body, and returns at the very limit of detection or loss, may go either way.
    either = 2 + len(theirs) // 200
    common, here, there = np.intersect1d(keys, theirs, return_indices=True)
    assert max(len(keys), len(theirs)) - len(common) <= either
    same = (np.abs(made.points[here] - expected.points[there]) < 5e-4).all(axis=1)
    # A body's axes may be those of the middle of a few columns.
    for field, tolerance in {"intensity": 4e-3, "cosine": 1e-2, "object_id": 0, "material": 0}.items():
        same &= np.abs(getattr(made, field)[here] - getattr(expected, field)[there].astype(float)) <= tolerance
    assert (~same).sum() <= either
    np.testing.assert_allclose(made.time_offset[here], expected.time_offset[there], atol=1e-6)


@pytest.mark.parametrize("wide", [{"angle_noise_deg": 3.0}, {"subrays": 8, "divergence_rad": 0.1, "returns": "dual"}])
def test_steep_beams_that_are_tilted_or_divided_meet_every_body(
    engine: Engine, wide: dict[str, float] | dict[str, float | str]
) -> None:
    """Aside by 3 degrees is 17 degrees of azimuth for a beam that points 80 degrees down."""
    steep = {"elevation_deg": (-50.0, -60.0, -66.0, -70.0, -74.0, -77.0, -80.0, -82.0), "columns": 400}
    spec = msgspec.structs.replace(EIGHT, range_noise_m=0.0, range_10_m=100.0, pulse_s=1e-9, **steep, **wide)
    actors = cars([[3.0, 0.3, 0.1], [0.4, 3.2, 1.5], [-5.0, -2.0, 2.8], [1.5, -3.1, -0.2]], size=(2.4, 1.2, 1.5))
    pose = pose_matrix([0.0, 0.0, 12.0])
    seen = []
    for each in (engine, Oracle()):
        scene = RayScene(ground(90.0), body_mesh=box_body)
        scene.engine = each  # type: ignore[assignment]
        sensor = Sensor(spec, Path.through([-1.0, 1.0], [pose, pose]), 0.0, np.random.default_rng(0))
        sweep = scan_all(scene.with_bodies(actors), [sensor])[0]
        grid = np.zeros((spec.rings, spec.columns, 2), np.int64)
        grid[sweep.ring, sweep.column, sweep.return_number - 1] = sweep.object_id
        seen.append(grid)
    assert all((seen[1] == object_id).sum() > 30 for object_id in actors.boxes.object_id)
    assert (seen[0] != seen[1]).sum() <= 3


def test_the_number_of_threads_and_of_sensors_changes_no_byte(engine: Engine) -> None:
    spec = msgspec.structs.replace(EIGHT, columns=3000, subrays=4, divergence_rad=0.02, returns="dual")
    plain = msgspec.structs.replace(EIGHT, columns=9000)
    sensors = [lambda: sensor_of(spec), lambda: sensor_of(plain, 1), lambda: sensor_of(spec, 2, None)]
    together = [scan_all(scene_in(engine), [make() for make in sensors], threads=n) for n in (1, 2, 5)]
    alone = [scan_all(scene_in(engine), [make()], threads=2)[0] for make in sensors]
    for sweeps in zip(*together, alone, strict=True):
        for field in POINT_FIELDS:
            assert len({getattr(sweep, field).tobytes() for sweep in sweeps}) == 1


def test_bodies_that_move_equal_bodies_baked_into_the_world(engine: Engine) -> None:
    rng = np.random.default_rng(3)
    rows = np.column_stack([rng.uniform(-40, 40, (30, 2)), rng.uniform(-3, 3, 30)])
    actors = cars(rows[np.hypot(rows[:, 0], rows[:, 1]) > 4.0])
    baked = ground()
    for pose in actors.world_from_body():
        body = box_body("", tuple(actors.boxes.size[0]))
        body.apply_transform(pose)
        baked = baked + body
    spec = msgspec.structs.replace(EIGHT, columns=720, range_noise_m=0.0)
    moving, still = RayScene(ground(), body_mesh=box_body), RayScene(baked, body_mesh=box_body)
    moving.engine = still.engine = engine
    pose = pose_matrix([0.0, 0.0, 1.9], 0.4, 0.05, -0.03)
    sensor = Sensor(spec, Path.through([-1.0, 1.0], [pose, pose]), 0.0, np.random.default_rng(0))
    a, b = (scan_all(scene, [sensor])[0] for scene in (moving.with_bodies(actors), still))
    np.testing.assert_array_equal(a.ring, b.ring)
    np.testing.assert_array_equal(a.column, b.column)
    np.testing.assert_allclose(a.range, b.range, atol=1e-3)
    np.testing.assert_allclose(a.cosine, b.cosine, atol=1e-4)
    assert len(np.unique(a.object_id)) > 15


def test_a_sensor_above_a_body_sees_it_all_around(engine: Engine) -> None:
    scene = RayScene(box((200, 200, 0.1)), body_mesh=box_body)
    scene.engine = engine
    scene = scene.with_bodies(cars([[0.0, 0.0, 0.3]], size=(12.0, 6.0, 3.0)))
    pose = pose_matrix([0.0, 0.0, 4.0])
    sensor = Sensor(EIGHT, Path.through([-1.0, 1.0], [pose, pose]), 0.0, np.random.default_rng(0))
    sweep = scan_all(scene, [sensor])[0]
    low = sweep.ring == EIGHT.rings - 1
    assert low.sum() == EIGHT.columns
    assert (sweep.object_id[low] == 1000).all()


def test_a_body_of_the_same_shape_is_met_where_each_of_them_is(engine: Engine) -> None:
    """Two cars share one solid."""
    spec = msgspec.structs.replace(EIGHT, columns=720)
    scene = RayScene(ground(), body_mesh=box_body)
    scene.engine = engine
    actors = cars([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    pose = pose_matrix([0.0, 0.0, 1.9])
    sensor = Sensor(spec, Path.through([-1.0, 1.0], [pose, pose]), 0.0, np.random.default_rng(0))
    sweep = scan_all(scene.with_bodies(actors), [sensor])[0]
    inside = actors.boxes.contains(sweep.world_points, margin=0.2)
    for row, object_id in enumerate(actors.boxes.object_id):
        assert (sweep.object_id == object_id).sum() > 20
        assert inside[row][sweep.object_id == object_id].all()


def solid_of(mesh: trimesh.Trimesh) -> Solid:
    return Solid(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), np.zeros(len(mesh.faces), np.uint8))


def rays(directions: ArrayLike) -> np.ndarray:
    directions = np.asarray(directions, np.float64)
    return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("across", [0.0, 1e-20, -1e-20])
def test_a_ray_along_an_axis_costs_its_neighbours_no_hit(engine: Engine, across: float) -> None:
    """Embree's packets take tiny negative components for positive ones; six of these rays missed."""
    y = np.linspace(-0.02, 0.04, 16)
    y[5] = across
    along = np.column_stack([np.ones(16), y, np.full(16, -0.07)]).astype(np.float32)
    origins = np.tile(np.float32([-6.5, -5e-4, 0.4]), (16, 1))
    sphere = solid_of(trimesh.creation.icosphere(3, 2.0))
    assert (engine.cast(sphere, origins, along, np.full(16, 50.0, np.float32)).face >= 0).all()


@pytest.mark.parametrize("across", [0.0, 1e-20, -1e-20])
@pytest.mark.parametrize("what", ["world", "body", "braking body"])
def test_a_column_along_an_axis_costs_a_sweep_no_hit(engine: Engine, what: str, across: float) -> None:
    """The same in the packets of a sweep: of a block as a whole, and of each column for a body on no straight line."""
    spec = msgspec.structs.replace(
        EIGHT, elevation_deg=(-4.0,), columns=16, azimuth_start_deg=-1.25, azimuth_end_deg=2.75, range_noise_m=0.0
    )
    sphere = trimesh.creation.icosphere(3, 2.0)
    sphere.face_attributes["material"] = np.full(len(sphere.faces), material_index("asphalt"), np.uint8)
    scene = RayScene(sphere if what == "world" else None, body_mesh=lambda model, size: sphere)
    scene.engine = engine
    if what != "world":
        moved_m = 0.5 if what == "braking body" else 0.0
        before, now, after = (
            cars([[x, 0.0, 0.0]], time_s=t, size=(4.0, 4.0, 4.0))
            for x, t in ((-moved_m, 2.95), (0.0, 3.0), (0.0, 3.05))
        )
        scene = scene.with_bodies(now, before, after)
    pose = pose_matrix([-6.5, -5e-4, 0.4], across)
    sensor = Sensor(spec, Path.through([2.9, 3.1], [pose, pose]), 3.0, np.random.default_rng(0))
    assert len(scan_all(scene, [sensor])[0]) == spec.columns


def test_distances_to_a_box_from_inside_are_exact(engine: Engine) -> None:
    mesh = trimesh.creation.box((4.0, 6.0, 8.0))
    directions = rays([[1, 0, 0], [0, 1, 0], [0, 0, -1]])
    hits = engine.cast(solid_of(mesh), np.zeros((3, 3), np.float32), directions, np.full(3, 99.0, np.float32))
    np.testing.assert_allclose(hits.distance, [2, 3, 4], atol=1e-6)
    np.testing.assert_allclose(hits.cosine, 1.0, atol=1e-6)
    np.testing.assert_allclose(mesh.face_normals[hits.face], -directions * [-1, -1, -1], atol=1e-6)


def test_rays_aimed_at_shared_edges_never_leak(engine: Engine) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    ends = mesh.vertices[mesh.edges_unique]
    share = np.linspace(0.1, 0.9, 9)[:, None, None]
    directions = rays((ends[None, :, 0] * share + ends[None, :, 1] * (1 - share)).reshape(-1, 3))
    reach = np.full(len(directions), 50.0, np.float32)
    hits = engine.cast(solid_of(mesh), np.zeros_like(directions), directions, reach)
    assert (hits.face >= 0).all()


def test_reach_ends_a_ray_and_is_not_changed(engine: Engine) -> None:
    reach = np.array([4.0, 6.0], np.float32)
    directions = rays([[1, 0, 0], [1, 0, 0]])
    hits = engine.cast(solid_of(trimesh.creation.box((10.0,) * 3)), np.zeros((2, 3), np.float32), directions, reach)
    assert (hits.face >= 0).tolist() == [False, True]
    assert hits.distance.tolist() == [4.0, 5.0]
    assert reach.tolist() == [4.0, 6.0]
    assert hits.cosine[0] == 0.0


def test_zero_and_nan_directions_miss(engine: Engine) -> None:
    directions = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [1.0, 0.0, 0.0]], np.float32)
    reach = np.full(3, 9.0, np.float32)
    hits = engine.cast(solid_of(trimesh.creation.box((4.0,) * 3)), np.zeros((3, 3), np.float32), directions, reach)
    assert (hits.face >= 0).tolist() == [False, False, True]
    assert hits.distance == pytest.approx([9.0, 9.0, 2.0], rel=1e-6)


def test_no_triangles_and_no_rays_are_legal(engine: Engine) -> None:
    empty = Solid(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8))
    hits = engine.cast(empty, np.zeros((1, 3), np.float32), rays([[1, 0, 0]]), np.ones(1, np.float32))
    assert hits.face.tolist() == [-1]
    none = np.zeros((0, 3), np.float32)
    assert len(engine.cast(empty, none, none, np.zeros(0, np.float32)).distance) == 0


def test_a_solid_is_known_by_identity(engine: Engine) -> None:
    """A solid that takes the place of another one in memory is not taken for it."""
    directions, origin, reach = rays([[1, 0, 0]]), np.zeros((1, 3), np.float32), np.full(1, 99.0, np.float32)
    for side in range(2, 30):
        hits = engine.cast(solid_of(trimesh.creation.box((side,) * 3)), origin, directions, reach)
        assert hits.distance[0] == pytest.approx(side / 2, rel=1e-6)


def test_a_world_without_triangles_holds_its_bodies(engine: Engine) -> None:
    scene = RayScene(None, body_mesh=box_body)
    scene.engine = engine
    sweep = scan_all(scene.with_bodies(*traffic()), [replace(sensor_of(EIGHT), rides_on=None)])[0]
    assert len(sweep) > 20
    assert STATIC not in sweep.object_id
