import numpy as np
import pytest
import trimesh

from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene, mesh_arrays
from sim.geometry import pose_matrix
from tests.sensors.fakes import box, box_body, cars, ground, ideal, scene_of


def test_a_far_world_origin_costs_no_precision() -> None:
    offset = np.array([480_000.0, 5_700_000.0, 0.0])
    near = scene_of(box((20, 14, 10)), cars([[4.0, 2.0, 0.5]]))
    moved = cars([[4.0, 2.0, 0.5]])
    moved.boxes.center[:] += offset
    far = scene_of(box((20, 14, 10), offset), moved)
    here, there = pose_matrix([0.0, 0.0, 1.9], 0.3), pose_matrix(offset + np.array([0.0, 0.0, 1.9]), 0.3)
    a, b = (
        scan(scene, ideal(), pose, pose, 0.0, np.random.default_rng(0)) for scene, pose in ((near, here), (far, there))
    )
    np.testing.assert_array_equal(a.object_id, b.object_id)
    np.testing.assert_allclose(a.points, b.points, atol=1e-4)


def test_one_body_is_built_once() -> None:
    calls = []

    def body(model: str, size: tuple[float, float, float]) -> trimesh.Trimesh:
        calls.append(model)
        return box_body(model, size)

    scene = RayScene(None, body_mesh=body)
    for _ in range(3):
        scene = scene.with_bodies(cars([[5, 0, 0], [9, 0, 0]]))
    assert len(calls) == 1


def test_ground_height_is_the_lowest_surface() -> None:
    static = ground() + box((4, 4, 1), (10.0, 0.0, 8.0))
    static.apply_translation([0, 0, 80.0])
    heights = scene_of(static).ground_height(np.array([[10.0, 0.0], [0.0, 3.0], [900.0, 0.0]]))
    np.testing.assert_allclose(heights, [80.0, 80.0, 0.0], atol=1e-3)


def test_rays_are_cast_in_the_world_frame() -> None:
    scene = scene_of(box((4.0, 4.0, 4.0), (1000.0, 2000.0, 50.0)))
    origins = np.array([[990.0, 2000.0, 50.0], [990.0, 2010.0, 50.0]])
    hits = scene.cast(origins, np.array([[1.0, 0.0, 0.0]] * 2), 100.0)
    assert (hits.face >= 0).tolist() == [True, False]
    assert hits.distance == pytest.approx([8.0, 100.0], rel=1e-6), "to the rounding of the processor's reciprocals"
    np.testing.assert_allclose(hits.cosine, [1.0, 0.0], atol=1e-6)


def test_a_mesh_without_materials_is_asphalt() -> None:
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    assert mesh_arrays(mesh, "box")[2].tolist() == [0] * 12
