"""Raw sweeps of analytic planes seen from a moving sensor: what compensation must give back is known exactly."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sensors.deskew import deskew, deskew_frame, deskew_objects
from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.optics.beams import beams_of
from sensors.scan.lidar import Sensor, scan_all
from sensors.spec import LidarSpec
from sensors.sweep import MOTIONS, POINT_FIELDS, STATIC, Sweep, make_sweep
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from sim.geometry import invert, pose_matrix, transform_points
from tests.sensors.fakes import cars, ground, ideal, scene_of

SPEC = LidarSpec(
    name="eight",
    elevation_deg=(8.0, 4.0, 1.0, -2.0, -5.0, -9.0, -14.0, -20.0),
    columns=360,
    # Beams of a column fire one after another: each point has a time of its own.
    firing_s=tuple(i * 3e-5 for i in range(8)),
    source="a toy",
)
NOW_S = 12.3
HALF_S = 0.05
CAR_MPS = np.array([14.0, 0.0, 0.0])
# point, normal, velocity, id: the road, a wall along it, and the rear of a car that drives away.
ROAD = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), STATIC)
WALL = ((0.0, 9.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), STATIC)
REAR = ((16.0, 0.0, 0.0), (1.0, 0.0, 0.0), tuple(CAR_MPS), 1000)


def path_through(*poses: np.ndarray) -> Path:
    return Path.through(NOW_S + np.linspace(-HALF_S, HALF_S, len(poses)), np.stack(poses))


def driving(speed: float = 15.0, turn: float = 1.0, offset: float = 0.0) -> Path:
    """A sensor 1.9 m above the road that drives a curve, nodding and leaning a little."""
    times = np.array([-HALF_S, -0.02, 0.0, HALF_S])
    yaw = turn * times
    xyz = np.stack([speed * times + offset, 0.5 * speed * turn * times**2 - offset, 1.9 + 0.3 * times], axis=1)
    return Path.through(NOW_S + times, pose_matrix(xyz, yaw, 0.2 * times, 0.1 * times))


def measured(path: Path, planes: Sequence[tuple] = (ROAD, WALL), spec: LidarSpec = SPEC, offset: float = 0.0) -> Sweep:
    """Raw points: for each beam the range along its direction, from where the sensor is when it fires."""
    azimuth = spec.azimuth + spec.azimuth_offset[:, None]
    elevation = np.broadcast_to(spec.elevation[:, None], azimuth.shape)
    level = np.cos(elevation)
    axis = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    after = spec.time_offset.astype(np.float32).astype(np.float64).ravel()
    pose = path.at(NOW_S + after)
    ray = np.einsum("pij,pj->pi", pose[:, :3, :3], axis)
    ranges, ids = np.full(len(axis), np.inf), np.zeros(len(axis), int)
    for point, normal, velocity, key in planes:
        place = np.add(point, [offset, -offset, 0.0]) + after[:, None] * velocity
        with np.errstate(divide="ignore"):
            distance = ((place - pose[:, :3, 3]) @ normal) / (ray @ normal)
        nearer = (distance > 0.0) & (distance < ranges)
        ranges[nearer], ids[nearer] = distance[nearer], key
    ring, column = np.divmod(np.arange(len(axis)), spec.columns)
    hit = ranges < 60.0
    sweep = make_sweep(
        axis[hit] * ranges[hit, None],
        path.at(np.array([NOW_S]))[0],
        NOW_S,
        spec,
        ring=ring[hit],
        column=column[hit],
        time_offset=after[hit],
        object_id=ids[hit],
    )
    return replace(sweep, path=path, motion="raw")


def seen(sweep: Sweep) -> np.ndarray:
    """Where one pose puts the points, as every user of the sweep does."""
    return transform_points(sweep.world_from_lidar, sweep.points.astype(np.float64))


def off_the_planes(sweep: Sweep, offset: float = 0.0) -> float:
    """Farthest that a static point is from both the road and the wall."""
    _, y, z = (seen(sweep) - [offset, -offset, 0.0])[sweep.object_id == STATIC].T
    return float(np.minimum(np.abs(z), np.abs(y - 9.0)).max())


def straight(velocity: np.ndarray, time_s: float) -> Path:
    """Paths of bodies of (N, 3) velocities; positions cancel as long as no body turns."""
    away = np.array([-0.1, 0.1])
    xyz = velocity[:, None] * away[:, None]
    return Path(time_s + away, xyz, np.zeros_like(xyz))


@pytest.mark.parametrize("to", ["middle", "start", "end"])
@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_deskewing_straightens_static_points_bent_by_the_sensors_motion(to: str, turn: float) -> None:
    raw = measured(driving(turn=turn))
    assert off_the_planes(raw) > 0.05
    assert off_the_planes(deskew(raw, to)) < 1e-4


def test_the_frame_of_the_points_is_that_of_the_sensor_at_the_start_middle_or_end() -> None:
    path = driving()
    for to, after in (("start", -HALF_S), ("middle", 0.0), ("end", HALF_S)):
        sweep = deskew(measured(path), to)
        assert sweep.motion == to
        assert sweep.time_s == pytest.approx(NOW_S + after, abs=1e-12)
        np.testing.assert_allclose(sweep.world_from_lidar, path.at(np.array([NOW_S + after]))[0], atol=1e-9)
        # What was measured about that instant is where the beam has measured it.
        near = np.abs(sweep.time_offset) < 3e-4
        assert near.any()
        np.testing.assert_allclose(sweep.points[near], measured(path).points[near], atol=0.03)


def test_points_in_the_world_and_firing_times_never_change() -> None:
    raw = measured(driving(), (ROAD, WALL, REAR))
    for to in MOTIONS:
        sweep = deskew(raw, to)
        np.testing.assert_allclose(sweep.world_points, raw.world_points, atol=2e-5)
        fired = sweep.time_s + sweep.time_offset.astype(np.float64)
        np.testing.assert_allclose(fired, raw.time_s + raw.time_offset.astype(np.float64), rtol=0, atol=1e-8)
        for name in set(POINT_FIELDS) - {"points", "time_offset"}:
            assert getattr(sweep, name) is getattr(raw, name)


@pytest.mark.parametrize("there", MOTIONS)
@pytest.mark.parametrize("home", MOTIONS)
def test_there_and_back_is_the_same_sweep(home: str, there: str) -> None:
    sweep = deskew(measured(driving()), home)
    back = deskew(deskew(sweep, there), home)
    np.testing.assert_allclose(back.points, sweep.points, rtol=0, atol=2e-5)
    np.testing.assert_allclose(back.time_offset, sweep.time_offset, rtol=0, atol=1e-8)
    np.testing.assert_allclose(back.world_from_lidar, sweep.world_from_lidar, rtol=0, atol=1e-12)
    assert back.time_s == pytest.approx(sweep.time_s, abs=1e-12) and back.motion == home


def test_deskewing_to_the_same_motion_returns_the_same_sweep() -> None:
    sweep = make_sweep(np.ones((2, 3)))
    assert deskew(sweep, "middle") is sweep


def test_raw_and_deskewed_points_of_a_sensor_at_rest_are_equal() -> None:
    still = path_through(*[pose_matrix([3.0, 1.0, 1.9], 0.4)] * 2)
    raw = measured(still)
    np.testing.assert_allclose(deskew(raw, "middle").points, raw.points, atol=1e-6)


def test_far_from_the_origin_nothing_is_lost() -> None:
    raw = measured(driving(offset=5e5), offset=5e5)
    assert off_the_planes(deskew(raw, "end"), offset=5e5) < 1e-4


def test_an_error_of_the_pose_does_not_bend_the_world() -> None:
    raw = measured(driving())
    wrong = pose_matrix([0.5, -0.3, 0.0], 0.02)
    shifted = deskew(replace(raw, world_from_lidar=raw.world_from_lidar @ wrong), "start")
    np.testing.assert_allclose(shifted.points, deskew(raw, "start").points, atol=2e-5)
    inside = transform_points(invert(raw.world_from_lidar @ wrong), shifted.world_points)
    np.testing.assert_allclose(inside, deskew(raw, "middle").points, atol=2e-5)


@pytest.mark.parametrize("to", ["middle", "start", "end"])
def test_a_moving_car_is_sheared_by_its_speed_times_column_time_and_deskewed(to: str) -> None:
    sweep = deskew(measured(driving(turn=0.0), (ROAD, REAR)), to)
    on = sweep.object_id == 1000
    rear_x = 16.0 + CAR_MPS[0] * (sweep.time_s - NOW_S)
    shear = seen(sweep)[on, 0] - rear_x
    assert np.ptp(shear) > 0.4
    np.testing.assert_allclose(shear, CAR_MPS[0] * sweep.time_offset[on], atol=1e-4)
    upright = deskew_objects(sweep, np.array([1000]), straight(CAR_MPS[None], sweep.time_s))
    np.testing.assert_allclose(seen(upright)[on, 0], rear_x, atol=1e-4)
    np.testing.assert_allclose(upright.points[~on], sweep.points[~on], atol=1e-5)


def test_raw_points_of_a_car_are_deskewed_too() -> None:
    raw = measured(driving(), (ROAD, REAR))
    ids, path = np.array([999, 1000]), straight(np.array([[90.0, 0.0, 0.0], CAR_MPS]), NOW_S)
    made = deskew_objects(raw, ids, path)
    assert made.motion == "raw"
    np.testing.assert_allclose(
        made.world_points, deskew_objects(deskew(raw, "middle"), ids, path).world_points, atol=2e-5
    )


def test_a_turning_object_is_deskewed_by_its_path() -> None:
    """Corners of a box that spins at 2 rad/s about (10, 0), each met at another time."""
    times = np.linspace(-HALF_S, HALF_S, 5)
    turning = Path.through(NOW_S + times, pose_matrix([10.0, 0.0, 0.0], 2.0 * times)[None])
    corners = np.array([[2.0, 1, 0], [-2, 1, 0], [-2, -1, 1], [2, -1, 1]])
    fired = np.array([-0.05, -0.0125, 0.02, 0.05])
    met = np.stack([transform_points(turning[0].at(NOW_S + fired)[i], corners[i][None])[0] for i in range(4)])
    sweep = make_sweep(met, time_s=NOW_S, time_offset=fired, object_id=np.full(4, 7))
    made = deskew_objects(sweep, np.array([7]), turning)
    np.testing.assert_allclose(made.points, corners + np.array([10, 0, 0]), atol=1e-5)


def test_a_sensor_that_fires_all_at_once_has_one_frame() -> None:
    frozen = LidarSpec(name="frozen", elevation_deg=(-5.0, -9.0), columns=90, rolling_shutter=False, source="a toy")
    raw = measured(driving(), spec=frozen)
    for to in MOTIONS:
        made = deskew(raw, to)
        np.testing.assert_allclose(made.points, raw.points, atol=1e-6)
        assert made.time_s == NOW_S


def test_an_empty_sweep_is_deskewed() -> None:
    raw = measured(driving())[:0]
    assert deskew(raw, "start").points.shape == (0, 3)
    assert deskew(deskew(raw, "end"), "raw").time_s == pytest.approx(NOW_S)


@pytest.mark.parametrize("to", ["start", "end", "raw"])
def test_missing_paths_and_firing_times_are_reported(to: str) -> None:
    sweep = deskew(measured(driving()), "middle")
    with pytest.raises(DataError, match="sweep: path: expected the sensor's poses over the sweep, found none"):
        deskew(replace(sweep, path=None), to)
    with pytest.raises(DataError, match="sweep: time_offset: expected a firing time of each point, found none"):
        deskew(replace(sweep, time_offset=np.zeros_like(sweep.time_offset)), to)
    with pytest.raises(DataError, match="sweep: time_offset: expected finite firing times"):
        deskew(replace(sweep, time_offset=np.full_like(sweep.time_offset, np.nan)), to)
    with pytest.raises(DataError, match=r"sweep: path: expected poses from 12.\d+ to 12.\d+ s, found those from 2"):
        deskew(replace(sweep, path=Path(sweep.path.time_s + 10.0, sweep.path.xyz, sweep.path.angles)), to)
    if to != "raw":
        with pytest.raises(DataError, match=f"sweep: spec: expected a sensor, to know the {to} of its sweep"):
            deskew(replace(sweep, spec=None), to)


def test_raw_points_of_an_unknown_path_have_no_place_in_the_world() -> None:
    raw = measured(driving())
    with pytest.raises(DataError, match="path"):
        _ = replace(raw, path=None).world_points


def test_a_misspelt_motion_gets_the_nearest_name() -> None:
    with pytest.raises(SettingsError, match="motion: expected a compensation, found strat; did you mean 'start'"):
        deskew(measured(driving()), "strat")


def test_a_frame_is_deskewed_agent_by_agent_and_its_truth_stays() -> None:
    raw = measured(driving())
    agents = tuple(AgentFrame(i, "vehicle", np.eye(4), 15.0, raw) for i in (1000, 1001))
    frame = Frame(4, NOW_S, agents, Boxes.zeros(), np.zeros((0, 2)), np.zeros((2, 0), np.int32))
    made = deskew_frame(frame, "end")
    assert [a.sweep.motion for a in made.agents] == ["end", "end"] and made.time_s == NOW_S
    broken = replace(frame, agents=(agents[0], replace(agents[1], sweep=replace(raw, path=None))))
    with pytest.raises(DataError, match="frame 4: agent 1001: sweep: path"):
        deskew_frame(broken, "end")


def test_raw_points_of_a_scan_lie_on_the_beams_that_measured_them() -> None:
    """The turning sensor of a real sweep: what it measured lies where its beams point, the ground is flat again."""
    spec = ideal("opv2v-64")
    path = path_through(pose_matrix([-0.75, 0.0, 1.9], -0.05, 0.01), pose_matrix([0.75, 0.2, 1.9], 0.05, -0.01))
    sweep = scan_all(scene_of(ground()), [Sensor(spec, path, NOW_S, np.random.default_rng(0))])[0]
    assert len(sweep) > 30000 and np.abs(sweep.world_points[:, 2]).max() < 1e-4
    raw = deskew(sweep, "raw")
    axis = beams_of(spec, NOW_S).axis[:, raw.ring, raw.column].T
    away = np.linalg.norm(raw.points, axis=1)
    np.testing.assert_allclose(raw.points, axis * away[:, None], atol=1e-4)
    assert np.abs(seen(raw)[:, 2]).max() > 0.05
    for to in ("start", "end"):
        assert np.abs(seen(deskew(raw, to))[:, 2]).max() < 1e-4


def test_a_scanned_car_is_put_back_into_its_box() -> None:
    now = cars([[12.0, 4.0, 0.2]], time_s=NOW_S, speed=20.0)
    scene = scene_of(ground(), now)
    sweep = scan_all(scene, [Sensor(ideal("opv2v-64"), driving(), NOW_S, np.random.default_rng(0))])[0]
    on = sweep.object_id == 1000
    assert on.sum() > 100
    made = deskew_objects(sweep, scene.bodies.object_id, scene.bodies.path)
    world_from_car = now.world_from_body()[0]
    half = np.array([2.25, 0.9, 0.75])

    def off_the_box(points: np.ndarray) -> np.ndarray:
        inside = half - np.abs(transform_points(invert(world_from_car), points) - [0.0, 0.0, 0.75])
        return np.abs(inside.min(axis=1))

    assert off_the_box(sweep.world_points[on]).max() > 0.02
    assert off_the_box(made.world_points[on]).max() < 1e-4
