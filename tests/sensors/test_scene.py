import numpy as np

from sensors.scene import Rays
from sensors.windows import windows_of
from sim.geometry import pose_matrix, transform_points
from tests.sensors.fakes import CAR, box, box_body, cars, ground, ideal, nothing, scene_of


def rays_of(spec, pose, reach=120.0):
    poses = np.broadcast_to(pose, (spec.columns, 4, 4))
    return Rays(spec.elevation, spec.azimuth, spec.time_offset, poses, reach)


def test_bodies_met_in_windows_equal_bodies_baked_into_the_world():
    rng = np.random.default_rng(3)
    rows = np.column_stack([rng.uniform(-40, 40, (30, 2)), rng.uniform(-3, 3, 30)])
    rows = rows[np.hypot(rows[:, 0], rows[:, 1]) > 4.0]
    actors = cars(rows)
    baked = ground()
    for pose in actors.world_from_body():
        body = box_body("", CAR)
        body.apply_transform(pose)
        baked = baked + body
    rays = rays_of(ideal(columns=720), pose_matrix([0.0, 0.0, 1.9], 0.4, 0.05, -0.03))
    moving = scene_of(ground(), actors).trace(rays)
    still = scene_of(baked).trace(rays)
    np.testing.assert_array_equal(moving.hit, still.hit)
    np.testing.assert_allclose(moving.distance, still.distance, atol=1e-3)
    np.testing.assert_allclose(moving.cosine, still.cosine, atol=1e-4)
    assert len(np.unique(moving.object_id)) > 15


def test_a_sensor_above_a_body_sees_it_all_around():
    actors = cars([[0.0, 0.0, 0.3]], size=(12.0, 6.0, 3.0))
    trace = scene_of(nothing(), actors).trace(rays_of(ideal(), pose_matrix([0.0, 0.0, 4.0])))
    assert (trace.object_id[-1] == 1000).all()


def test_a_far_world_origin_costs_no_precision():
    offset = np.array([480_000.0, 5_700_000.0, 0.0])
    near = scene_of(box((20, 14, 10)), cars([[4.0, 2.0, 0.5]]))
    moved = cars([[4.0, 2.0, 0.5]])
    moved.boxes.center[:] += offset
    far = scene_of(box((20, 14, 10), offset), moved)
    pose = pose_matrix([0.0, 0.0, 1.9])
    there = pose_matrix(offset + np.array([0.0, 0.0, 1.9]))
    a, b = near.trace(rays_of(ideal(), pose)), far.trace(rays_of(ideal(), there))
    np.testing.assert_allclose(a.distance, b.distance, atol=1e-4)


def test_one_body_is_built_once():
    calls = []

    def body(model, size):
        calls.append(model)
        return box_body(model, size)

    from sensors.scene import RayScene

    scene = RayScene(nothing(), body_mesh=body)
    for _ in range(3):
        scene = scene.with_bodies(cars([[5, 0, 0], [9, 0, 0]]))
    assert len(calls) == 1


def test_ground_height_is_the_lowest_surface():
    static = ground() + box((4, 4, 1), (10.0, 0.0, 8.0))
    static.apply_translation([0, 0, 80.0])
    heights = scene_of(static).ground_height(np.array([[10.0, 0.0], [0.0, 3.0], [900.0, 0.0]]))
    np.testing.assert_allclose(heights, [80.0, 80.0, 0.0], atol=1e-3)


def test_windows_hold_every_point_of_random_boxes():
    rng = np.random.default_rng(0)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for _ in range(200):
        size = rng.uniform(0.5, 12, 3)
        pose = pose_matrix(rng.uniform(-15, 15, 3), *rng.uniform(-0.5, 0.5, 3))
        inside = transform_points(pose, rng.uniform(-0.5, 0.5, (200, 3)) * size)
        windows = windows_of(np.asarray(transform_points(pose, signs * size))[None])
        azimuth = np.arctan2(inside[:, 1], inside[:, 0])
        level = np.hypot(inside[:, 0], inside[:, 1])
        assert windows.columns(azimuth).all()
        assert windows.rings(np.arctan2(inside[:, 2], level)).all()
        assert (level >= windows.near[0] - 1e-9).all()
