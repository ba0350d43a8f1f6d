import numpy as np
import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.page.cameras import birds_eye, chase, overview, scene_from_review
from dsrc.review.shapes import CUBE_FACES, CUBE_VERTICES, crossed, dashed, edges, quaternions
from dsrc.review.state import ReviewState
from dsrc.review.static import split_by_material
from sim.boxes import Boxes

TURNED = Boxes.from_array([[5.0, 3.0, 1.0, 4.0, 2.0, 1.5, 0.7], [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, -2.0]])


def test_a_box_is_twelve_edges_and_a_tick_along_its_heading() -> None:
    lines = edges(TURNED)
    assert lines.shape == (26, 2, 3)
    lengths = np.linalg.norm(lines[:24, 1] - lines[:24, 0], axis=1).reshape(2, 12)
    assert lengths.sum(axis=1) == pytest.approx([4 * (4.0 + 2.0 + 1.5), 24.0], rel=1e-5)
    tick = lines[24, 1] - lines[24, 0]
    assert np.arctan2(tick[1], tick[0]) == pytest.approx(0.7, abs=1e-5) and tick[2] == pytest.approx(0.0)


def test_tp_fp_and_fn_differ_in_form() -> None:
    assert len(crossed(TURNED)) == len(edges(TURNED)) + 4
    solid, broken = edges(TURNED), dashed(TURNED)
    length = [np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() for lines in (solid, broken)]
    assert len(broken) > 2 * len(solid) and 0.4 < length[1] / length[0] < 0.75


def test_no_boxes_have_no_lines() -> None:
    for form in (edges, crossed, dashed):
        assert form(Boxes.zeros()).shape == (0, 2, 3)


def test_the_unit_cube_faces_outwards() -> None:
    triangles = CUBE_VERTICES[CUBE_FACES]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (np.einsum("fc,fc->f", normals, triangles.mean(axis=1)) > 0).all()
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(6.0)


def test_a_quaternion_turns_about_z() -> None:
    np.testing.assert_allclose(quaternions(np.array([0.0, np.pi / 2])), [[1, 0, 0, 0], [2**-0.5, 0, 0, 2**-0.5]], 1e-6)


def test_cameras_look_at_the_ego(truth_model: ReviewModel) -> None:
    view = truth_model.view(ReviewState())
    ego = view.ego.review_from_body[:3, 3]
    for pose in (chase(view), birds_eye(view), overview(view)):
        assert pose.position[2] > ego[2] + 10 and np.isfinite(pose.position).all()
    np.testing.assert_allclose(birds_eye(view).look_at, ego)
    assert chase(view).position[0] < ego[0] < chase(view).look_at[0]


def test_the_scene_of_a_following_camera_keeps_the_ego_at_its_origin(truth_model: ReviewModel) -> None:
    for frame in (0, 5):
        view = truth_model.view(ReviewState(frame=frame))
        for camera in ("chase", "bev"):
            ego = scene_from_review(camera, view) @ view.ego.review_from_body
            np.testing.assert_allclose(ego[:3, 3], 0.0, atol=1e-9)
        np.testing.assert_allclose(scene_from_review("free", view), np.eye(4))


def test_the_world_is_cut_to_the_surroundings_and_split_by_material() -> None:
    import trimesh

    from sim.mesh.materials import MATERIALS

    names = [m.name for m in MATERIALS]
    near, far = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((2, 2, 2))
    far.apply_translation([500, 0, 0])
    mesh = trimesh.util.concatenate([near, far])
    material = np.full(24, names.index("asphalt"), np.uint8)
    material[:2] = names.index("brick")
    mesh.face_attributes["material"] = material
    parts = {p.name: p for p in split_by_material(mesh, np.zeros(3), np.zeros((1, 2)), 50.0)}
    assert {name: len(p.faces) for name, p in parts.items()} == {"roads": 10, "buildings": 2}
    assert all(p.faces.max() < len(p.vertices) for p in parts.values())


def test_ground_of_two_large_triangles_is_drawn_below_the_roads() -> None:
    import trimesh

    from sim.mesh.materials import MATERIALS

    names = [m.name for m in MATERIALS]
    corners = np.array([[-600, -600, -0.05], [600, -600, -0.05], [600, 600, -0.05], [-600, 600, -0.05]])
    road = np.array([[-5, -300, 0], [5, -300, 0], [5, 300, 0]])
    mesh = trimesh.Trimesh(np.concatenate([corners, road]), [[0, 1, 2], [0, 2, 3], [4, 5, 6]], process=False)
    mesh.face_attributes["material"] = np.array([names.index(m) for m in ("ground", "ground", "asphalt")], np.uint8)
    parts = {p.name: p for p in split_by_material(mesh, np.zeros(3), np.array([[10.0, 20.0]]), 50.0)}
    assert {name: len(p.faces) for name, p in parts.items()} == {"roads": 1, "ground": 2}
    assert parts["ground"].vertices[:, 2].max() < parts["roads"].vertices[:, 2].min() - 0.2
    assert not split_by_material(mesh, np.zeros(3), np.array([[900.0, 900.0]]), 50.0)
