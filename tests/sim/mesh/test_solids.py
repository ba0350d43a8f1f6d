import numpy as np
import pytest
import shapely
import trimesh

from sim.mesh.solids import MeshPart, box, carpet, ellipsoid, fit, join, move, prism, ring, slab, strip, to_mesh, tube


def level(xy: np.ndarray) -> np.ndarray:
    return np.zeros(len(xy))


def slope(xy: np.ndarray) -> np.ndarray:
    return 0.1 * xy[:, 0]


@pytest.mark.parametrize(
    "solid",
    [
        box([0, 0, 0], [1, 2, 3], "glass"),
        prism([[0, 0], [2, 0], [1, 1]], -1.0, 1.0, "glass"),
        tube([0, 0, 0], [0, 1, 1], (0.2, 0.1), "glass"),
        tube([1, 0, 0], [1, 0, 2], (0.2, 0.2), "glass", 12),
        ellipsoid([1, 1, 1], [1, 2, 3], "glass"),
        ring([0, 0, 1], 1.0, 0.1, "glass"),
    ],
    ids=["box", "prism", "slanted tube", "upright tube", "ellipsoid", "ring"],
)
def test_solids_are_closed_and_face_outwards(solid: MeshPart) -> None:
    mesh = to_mesh(solid)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


def test_turning_by_a_quarter_takes_forward_to_left() -> None:
    turned = move(box([0, 0, 0], [2, 0.1, 0.1], "glass"), yaw=np.pi / 2)
    assert turned.vertices[:, 1].max() == pytest.approx(2.0)


def test_joined_pieces_keep_their_materials_and_triangles() -> None:
    a, b = box([0, 0, 0], [1, 1, 1], "glass"), box([2, 0, 0], [3, 1, 1], "metal")
    whole = join([a, b])
    assert np.array_equal(whole.material, np.concatenate([a.material, b.material]))
    assert np.array_equal(whole.vertices[whole.faces], np.concatenate([a.vertices[a.faces], b.vertices[b.faces]]))


def test_a_fitted_piece_fills_its_box() -> None:
    part = fit(ellipsoid([5, 5, 5], [1, 2, 3], "glass"), (4.0, 2.0, 1.0))
    assert np.allclose(part.vertices.min(axis=0), [-2, -1, 0]) and np.allclose(part.vertices.max(axis=0), [2, 1, 1])


def test_a_carpet_covers_its_polygon_once_and_follows_the_slope() -> None:
    shape = shapely.box(0, 0, 10, 10) - shapely.box(4, 4, 6, 6)
    mesh = to_mesh(carpet(shape, slope, 0.01, "asphalt"))
    triangles = np.asarray(mesh.triangles)[:, :, :2]
    assert shapely.polygons(triangles).size and sum(p.area for p in shapely.polygons(triangles)) == pytest.approx(96.0)
    assert np.allclose(mesh.vertices[:, 2], 0.1 * mesh.vertices[:, 0] + 0.01)
    assert (mesh.face_normals[:, 2] > 0).all()


def test_a_slab_faces_outwards_on_top_and_around_its_holes() -> None:
    mesh = to_mesh(slab(shapely.box(0, 0, 4, 4) - shapely.box(1, 1, 2, 2), level, 2.0, "brick", "roof"))
    sides = np.abs(mesh.face_normals[:, 2]) < 0.5
    middles = mesh.triangles_center[sides] + 0.05 * mesh.face_normals[sides]
    inside = shapely.contains_xy(shapely.box(0, 0, 4, 4) - shapely.box(1, 1, 2, 2), *middles[:, :2].T)
    assert not inside.any() and (mesh.face_normals[~sides, 2] > 0).all()


def test_a_strip_faces_upwards() -> None:
    line = np.array([[0.0, 0.0], [5.0, 1.0], [9.0, 0.0]])
    mesh = to_mesh(strip(line + np.array([0, 0.5]), line - np.array([0, 0.5]), level, 0.0, "marking"))
    assert (mesh.face_normals[:, 2] > 0.99).all() and mesh.area == pytest.approx(9.0)


@pytest.mark.parametrize("subdivisions", [0, 1, 2])
def test_balls_are_trimeshs_to_the_bit(subdivisions: int) -> None:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    part = ellipsoid([0, 0, 0], [1, 1, 1], "glass", subdivisions)
    assert np.array_equal(part.vertices, ball.vertices)
    assert np.array_equal(part.faces, ball.faces)
