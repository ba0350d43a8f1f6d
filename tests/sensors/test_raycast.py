import numpy as np
import trimesh

from sensors.raycast import TriangleScene


def rays(directions):
    directions = np.asarray(directions, np.float64)
    return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


def test_distances_to_a_box_from_inside_are_exact():
    mesh = trimesh.creation.box((4.0, 6.0, 8.0))
    directions = rays([[1, 0, 0], [0, 1, 0], [0, 0, -1]])
    hits = TriangleScene(mesh.vertices, mesh.faces).cast(np.zeros((3, 3), np.float32), directions, np.full(3, 99.0))
    np.testing.assert_allclose(hits.distance, [2, 3, 4], atol=1e-6)
    np.testing.assert_allclose(hits.cosine, 1.0, atol=1e-6)
    np.testing.assert_allclose(mesh.face_normals[hits.face], -directions * [-1, -1, -1], atol=1e-6)


def test_rays_aimed_at_shared_edges_never_leak():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    ends = mesh.vertices[mesh.edges_unique]
    share = np.linspace(0.1, 0.9, 9)[:, None, None]
    directions = rays((ends[None, :, 0] * share + ends[None, :, 1] * (1 - share)).reshape(-1, 3))
    origin = np.zeros_like(directions)
    hits = TriangleScene(mesh.vertices, mesh.faces).cast(origin, directions, np.full(len(directions), 50.0))
    assert (hits.face >= 0).all()


def test_reach_ends_a_ray_and_is_left_alone():
    mesh = trimesh.creation.box((10.0, 10.0, 10.0))
    reach = np.array([4.0, 6.0], np.float32)
    hits = TriangleScene(mesh.vertices, mesh.faces).cast(
        np.zeros((2, 3), np.float32), rays([[1, 0, 0], [1, 0, 0]]), reach
    )
    assert (hits.face >= 0).tolist() == [False, True]
    assert hits.distance.tolist() == [4.0, 5.0]
    assert reach.tolist() == [4.0, 6.0]
    assert hits.cosine[0] == 0.0


def test_no_triangles_and_no_rays_are_legal():
    empty = TriangleScene(np.zeros((0, 3)), np.zeros((0, 3), int))
    hits = empty.cast(np.zeros((1, 3), np.float32), rays([[1, 0, 0]]), np.ones(1))
    assert hits.face.tolist() == [-1]
    none = np.zeros((0, 3), np.float32)
    assert len(empty.cast(none, none, np.zeros(0)).distance) == 0
