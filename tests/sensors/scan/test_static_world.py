import gc
import weakref
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay

from sensors.motion import Path
from sensors.raycast.base import Solid
from sensors.scan import static_world as tiles
from sensors.scan.lidar import Sensor, scan, scan_all
from sensors.scan.scene import RayScene, mesh_arrays
from sensors.scan.static_world import TILE_M, StaticWorld, together
from sensors.sweep import Sweep
from sim.errors import DataError
from sim.geometry import pose_matrix
from tests.sensors.fakes import box, box_body, cars, ground, ideal, painted, scene_of

REACH_M = 100.0


@pytest.fixture
def cut_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every world be cut into tiles."""
    monkeypatch.setattr(tiles, "WHOLE_FACES", 0)


def town(size: float = 1600.0, houses: int = 300, offset: ArrayLike = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Houses of all sizes on a wide plain, and hangars across several tiles."""
    rng = np.random.default_rng(5)
    parts = [ground(4.0 * size)]
    for _ in range(houses):
        x, y = rng.uniform(-size / 2, size / 2, 2)
        extents = rng.uniform([4, 4, 3], [40, 40, 30])
        parts.append(box(extents, (x, y, extents[2] / 2)))
    parts += [box((700.0, 9.0, 12.0), (60.0, y, 6.0)) for y in (-180.0, 130.0, 420.0)]
    mesh = stacked(parts)
    mesh.apply_translation(offset)
    return mesh


def stacked(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.face_attributes["material"] = np.concatenate([part.face_attributes["material"] for part in parts])
    return mesh


def sweep_at(
    scene: RayScene, x: float, y: float, z: float = 2.0, offset: ArrayLike = (0.0, 0.0, 0.0), **changes: Any
) -> Sweep:
    pose = pose_matrix(np.array([x, y, z]) + offset, 0.3, 0.01)
    return scan(scene, ideal(range_max_m=REACH_M, **changes), pose, pose, 0.0, np.random.default_rng(0))


def assert_same(one: Sweep, other: Sweep) -> None:
    np.testing.assert_array_equal(one.ring, other.ring)
    np.testing.assert_array_equal(one.column, other.column)
    np.testing.assert_array_equal(one.object_id, other.object_id)
    np.testing.assert_array_equal(one.material, other.material)
    # Along a wall that a ray hardly grazes float32 shifts where it meets it.
    error = np.linalg.norm(one.points - other.points, axis=1)
    assert error[one.cosine > 0.1].max() < 1e-4 and error.max() < 1e-3


def world_of(mesh: trimesh.Trimesh) -> StaticWorld:
    return StaticWorld(*mesh_arrays(mesh, "static world"))


def corners(solid: Solid) -> np.ndarray:
    return solid.vertices[solid.faces].astype(np.float64) + solid.origin


PLACES = [(0.0, 0.0), (TILE_M, -TILE_M), (-777.0, 703.0), (124.9, 249.95), (2300.0, -2900.0)]


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_a_sweep_through_tiles_equals_one_through_the_whole(
    monkeypatch: pytest.MonkeyPatch, x: float, y: float
) -> None:
    mesh, traffic = town(), cars([[x + 9.0, y, 0.4], [x, y - 6.0, 2.0]])
    # The whole is exact near its middle only: far stones put that where the sensor is.
    stones = [box((1.0, 1.0, 1.0), (x + away, y + away, -50.0)) for away in (-9000.0, 9000.0)]
    monkeypatch.setattr(tiles, "WHOLE_M", np.inf)
    whole = RayScene(stacked([mesh, *stones]), body_mesh=box_body).with_bodies(traffic)
    monkeypatch.setattr(tiles, "WHOLE_FACES", 0)
    tiled = RayScene(mesh, body_mesh=box_body).with_bodies(traffic)
    sweep = sweep_at(tiled, x, y)
    assert set(sweep.object_id) == {-1, 1000, 1001}
    assert_same(sweep, sweep_at(whole, x, y))


def test_a_tiled_world_500_km_away_gives_the_same_sweep(cut_small: None) -> None:
    offset = np.array([481_234.5, 5_703_210.75, 512.0])
    there = cars([[9.0, 4.0, 0.4]])
    there.boxes.center[:] += offset
    near = RayScene(town(), body_mesh=box_body).with_bodies(cars([[9.0, 4.0, 0.4]]))
    far = RayScene(town(offset=offset), body_mesh=box_body).with_bodies(there)
    assert_same(sweep_at(far, 3.0, 1.0, offset=offset), sweep_at(near, 3.0, 1.0))


def test_the_tiles_in_use_depend_on_the_places_alone(cut_small: None) -> None:
    mesh = town(houses=60)
    places = np.array([[10.0, 20.0], [480.0, -333.0]])
    fresh, used = world_of(mesh), world_of(mesh)
    for x in np.arange(-700.0, 700.0, 90.0):
        used.around(np.array([[x, -x]]), REACH_M)
    one, other = fresh.around(places, REACH_M), used.around(np.repeat(places[::-1], 3, axis=0), REACH_M)
    for name in ("vertices", "faces", "material", "origin"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_same_solid_serves_while_the_sensors_stay_in_their_tiles(cut_small: None) -> None:
    world = world_of(town(houses=60))
    solid = world.around(np.array([[1.0, 1.0], [300.0, 1.0]]), REACH_M)
    assert world.around(np.array([[2.0, 249.0], [499.0, 30.0]]), REACH_M) is solid
    assert world.around(np.array([[2.0, 251.0], [499.0, 30.0]]), REACH_M) is not solid
    assert world.around(np.array([[9.0, 100.0], [301.0, 100.0]]), REACH_M) is solid


def test_a_small_world_is_one_solid_wherever_its_sensors_are() -> None:
    world = world_of(ground(600.0))
    solid = world.around(np.array([[0.0, 0.0]]), REACH_M)
    assert world.around(np.array([[-290.0, 100.0], [380.0, 3.0]]), REACH_M) is solid
    assert len(world.around(np.array([[80_000.0, 0.0]]), REACH_M).faces) == 0


def test_unused_solids_are_dropped(cut_small: None) -> None:
    world = world_of(town(houses=60))
    old = weakref.ref(world.around(np.zeros((1, 2)), REACH_M))
    assert old() is not None
    for x in range(40):
        world.around(np.array([[x * TILE_M + 1.0, 0.0]]), REACH_M)
    gc.collect()
    assert old() is None


def test_the_origin_is_near_the_sensors_and_few_triangles_are_far(cut_small: None) -> None:
    mesh = town(offset=(90_000.0, 0.0, 300.0))
    solid = world_of(mesh).around(np.array([[90_100.0, 50.0]]), REACH_M)
    assert np.abs(solid.origin[:2] - [90_100.0, 50.0]).max() <= TILE_M
    assert abs(solid.origin[2] - 300.0) < 30.0
    assert 0 < len(solid.faces) < 0.4 * len(mesh.faces)


def test_tiles_meet_without_a_seam(cut_small: None) -> None:
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(np.linspace(-400.0, 400.0, 60), np.linspace(-400.0, 400.0, 60))
    places = (
        np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-2.0, 2.0, (3600, 2)) + [5_000_000 / 7, 3_000_000 / 7]
    )
    mesh = trimesh.Trimesh(
        np.column_stack([places, rng.uniform(0, 9, 3600)]), Delaunay(places).simplices, process=False
    )
    solid = world_of(painted(mesh)).around(places, REACH_M)
    assert len(solid.faces) == len(mesh.faces) and len(solid.vertices) > 3600
    assert len(np.unique(solid.vertices, axis=0)) == 3600


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_triangle_within_reach_is_lost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-1.0, 3.8, (40, 1, 1))
    triangles = rng.uniform(-2000, 2000, (40, 1, 3)) * [1, 1, 0.01] + size * rng.normal(size=(40, 3, 3))
    share = rng.dirichlet(np.ones(3), 40)
    points = np.einsum("nk,nkd->nd", share, triangles)
    faces = np.arange(120, dtype=np.int32).reshape(-1, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "WHOLE_FACES", 0)
        patch.setattr(tiles, "_CHUNK", 7)
        world = StaticWorld(triangles.reshape(-1, 3), faces, np.arange(40, dtype=np.uint8))
    for row in range(0, 40, 5):
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(0, REACH_M)
        place = points[row, :2] + away * np.array([np.cos(angle), np.sin(angle)])
        solid = world.around(place[None], REACH_M)
        at = np.flatnonzero(solid.material == row)
        assert len(at) == 1 and len(set(solid.material)) == len(solid.material)
        np.testing.assert_allclose(
            corners(solid)[at[0]], triangles[row], atol=1e-6 * np.abs(triangles[row]).max() + 1e-3
        )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rays_through_tiles_meet_what_rays_through_the_whole_meet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(0.0, 2.8, (300, 1, 1))
    triangles = rng.uniform(-600, 600, (300, 1, 3)) * [1, 1, 0.03] + size * rng.normal(size=(300, 3, 3)) * [1, 1, 0.1]
    mesh = painted(trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(900).reshape(-1, 3), process=False))
    origins = rng.uniform(-600, 600, (200, 3)) * [1, 1, 0.03]
    directions = rng.normal(size=(200, 3)) * [1, 1, 0.3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "WHOLE_M", np.inf)
        whole = RayScene(mesh).cast(origins, directions, REACH_M)
        patch.setattr(tiles, "WHOLE_FACES", 0)
        tiled = RayScene(mesh)
    each = [tiled.cast(origins[row], directions[row], REACH_M) for row in range(200)]
    distance = np.array([hit.distance[0] for hit in each])
    # A ray along an edge may pass it on either side.
    differs = (np.array([hit.face[0] for hit in each]) >= 0) != (whole.face >= 0)
    differs |= np.abs(distance - whole.distance) > 1e-3
    assert (whole.face >= 0).sum() > 20 and differs.sum() <= 1


def test_sensors_30_km_apart_see_their_own_surroundings_exactly() -> None:
    places = np.array([[0.0, 0.0], [30_000.0, 11.0]])
    mesh = ground(40.0) + box((6.0, 6.0, 8.0), (12.3, 0.0, 4.0))
    far = mesh.copy()
    far.apply_translation([*places[1], 0.0])
    scene = RayScene(painted(mesh + far))
    poses = [pose_matrix([*xy, 2.0]) for xy in places]
    sensors = [
        Sensor(ideal(), Path.through(np.array([-1.0, 1.0]), np.stack([pose] * 2)), 0.0, np.random.default_rng(0))
        for pose in poses
    ]
    sweeps = scan_all(scene, sensors)
    assert len(sweeps[0].points) > 1000
    assert_same(*sweeps)
    np.testing.assert_allclose(scene.ground_height(np.array([[3.0, 3.0], [30_003.0, 3.0]])), 0.0, atol=1e-5)


def test_places_are_grouped_with_their_neighbours() -> None:
    places = np.array([[0.0, 0.0], [30_000.0, 0.0], [450.0, -450.0], [30_500.0, 0.0], [0.0, 501.0]])
    assert [group.tolist() for group in together(places)] == [[0, 2], [1, 3], [4]]
    assert together(np.zeros((0, 2))) == []


def test_an_empty_world_is_seen_by_no_ray_but_its_bodies_are_exactly() -> None:
    assert len(sweep_at(scene_of(), 0.0, 0.0).points) == 0
    offset = np.array([481_234.5, 5_703_210.75, 0.0])
    there = cars([[9.0, 4.0, 0.4]])
    there.boxes.center[:] += offset
    near, far = scene_of(None, cars([[9.0, 4.0, 0.4]])), scene_of(None, there)
    sweep = sweep_at(near, 0.0, 0.0)
    assert len(sweep.points) > 50
    assert_same(sweep_at(far, 0.0, 0.0, offset=offset), sweep)
    assert near.ground_height(np.array([[1.0, 2.0]])).tolist() == [0.0]


def test_a_broken_mesh_is_refused() -> None:
    mesh = ground()
    mesh.vertices[2, 1] = np.nan
    with pytest.raises(DataError, match=r"static world: vertices: expected finite coordinates, found .*nan.* in row 2"):
        RayScene(mesh)
    missing = painted(trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False))
    missing.faces[0, 2] = 3
    with pytest.raises(DataError, match=r"faces: expected rows of the 3 vertices, found 0 to 3"):
        mesh_arrays(missing, "static world")
    odd = ground()
    odd.face_attributes["material"] = np.zeros(5, np.uint8)
    with pytest.raises(DataError, match=r"material: expected one for each of the 2 faces, found \(5,\)"):
        RayScene(odd)


BROKEN = {
    "without anything": (trimesh.Trimesh(), "faces: expected at least one triangle, found 0"),
    "of points alone": (trimesh.Trimesh(np.eye(3), process=False), "faces: expected at least one triangle, found 0"),
    "with NaN": (box((np.nan, 1.0, 1.0)), "vertices: expected finite coordinates, found .*nan"),
    "with a missing vertex": (
        trimesh.Trimesh(np.eye(3), [[0, 1, 3]], process=False, validate=False),
        "faces: expected rows of the 3 vertices, found 0 to 3",
    ),
    "of a file": (trimesh.Scene([trimesh.creation.box()]), "mesh: expected a trimesh.Trimesh, found Scene"),
}


@pytest.mark.parametrize(("mesh", "found"), BROKEN.values(), ids=BROKEN)
def test_a_broken_mesh_is_refused_as_world_and_as_body(mesh: trimesh.Trimesh, found: str) -> None:
    with pytest.raises(DataError, match=f"static world: {found}"):
        RayScene(mesh)
    scene = RayScene(None, body_mesh=lambda model, size: mesh)
    with pytest.raises(DataError, match=f"body 'box': {found}"):
        scene.with_bodies(cars([[9.0, 0.0, 0.0]]))
