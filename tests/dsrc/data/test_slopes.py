"""A street of 8 % through each format and back: points stay in the world, and boxes hold their own points."""

from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.drives import open_drives
from dsrc.data.formats.opv2v.reader import write_frame
from sensors.frame import AgentFrame, Frame, count_points
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sim.boxes import upright_of
from sim.geometry import invert, pose_matrix, transform_points
from sim.traffic.base import Actors
from sim.world.standing import stand
from tests.sensors.fakes import cars, ground, scene_of

SLOPE = 0.08
PACKAGES = {"mcap": "mcap", "ros2": "rosbags"}


def street() -> Actors:
    """Five cars on the slope: the ego uphill, one up, one down, two across."""
    places = [[0.0, 0.0, 0.1], [14.0, -3.0, 0.0], [11.0, 4.0, np.pi], [-12.0, 5.0, 1.5], [6.0, -9.0, -2.2]]
    return stand(cars(places), lambda xy: SLOPE * xy[:, 0])


@pytest.fixture(scope="module")
def frame() -> Frame:
    plane, actors, spec = ground(), street(), get_lidar("opv2v-64")
    plane.vertices[:, 2] = SLOPE * plane.vertices[:, 0]
    body = actors.world_from_body()[0]
    post = pose_matrix([20.0, 12.0, SLOPE * 20.0], -2.0)
    poses = {1000: body @ pose_matrix([0.0, 0.0, 1.9]), -1: post @ pose_matrix([0.0, 0.0, 5.0], 0.0, 0.2)}
    others = actors[np.arange(len(actors)) > 0]
    agents = []
    for agent_id, pose in poses.items():
        scene = scene_of(plane, others if agent_id > 0 else actors)
        sweep = scan(scene, spec, pose, pose, 0.0, np.random.default_rng(1))
        agents.append(
            AgentFrame(agent_id, "vehicle" if agent_id > 0 else "roadside", body if agent_id > 0 else post, 0.0, sweep)
        )
    counts = np.stack([count_points(agent.sweep, actors.boxes.object_id) for agent in agents])
    tilt = np.column_stack([actors.pitch, actors.roll])
    return Frame(0, 0.0, tuple(agents), actors.boxes, actors.velocity, counts, tilt=tilt)


@pytest.mark.parametrize("to", ["compact", "kitti", "dair", "mcap", "ros2", "nuscenes"])
def test_points_poses_and_boxes_of_a_slope_come_back(frame: Frame, tmp_path: Path, to: str) -> None:
    for package in ("mcap", PACKAGES[to]) if to in PACKAGES else ():
        pytest.importorskip(package)
    write_frame(tmp_path / "data" / "slope", frame)
    options = {"agent_id": "all", "view": "around"} if to == "kitti" else {}
    drives = open_drives(convert(tmp_path / "data", tmp_path / to, to, **options))
    back = [drive.read(i) for drive in drives for i in range(len(drive))]
    agents = [agent for one in back for agent in one.agents]
    assert len(agents) == (1 if to == "nuscenes" else 2)
    for before, after in zip(frame.agents, agents, strict=to != "nuscenes"):
        np.testing.assert_allclose(after.sweep.world_points, before.sweep.world_points, atol=1e-4)
        if before.kind == "vehicle":
            np.testing.assert_allclose(after.sweep.world_from_lidar, before.sweep.world_from_lidar, atol=1e-9)
    first = frame.agents[0].sweep
    checked = 0
    for box, body in zip(back[0].truth.array, back[0].bodies(), strict=True):
        (row,) = np.flatnonzero(np.linalg.norm(frame.truth.center - box[:3], axis=1) < 1e-4)
        np.testing.assert_allclose(box[3:6], frame.truth.size[row], atol=1e-5)
        # A heading that is turned into the frame of a tilted LiDAR and back errs by the square of the tilt.
        assert abs(box[6] - frame.truth.yaw[row]) < (SLOPE**2 if to == "kitti" else 1e-5)
        own = first.world_points[first.object_id == frame.truth.object_id[row]]
        if len(own) < 50:
            continue
        assert back[0].truth.contains(own, margin=0.2).any(axis=0).all()
        if to not in ("kitti", "dair"):
            np.testing.assert_allclose(body, frame.bodies()[row], atol=1e-6)
            reach = np.abs(transform_points(invert(body), own.astype(np.float64)))
            assert (reach <= 0.5 * box[3:6] + 0.1).all()
        checked += 1
    assert checked == 4


def test_boxes_in_the_frame_of_a_tilted_lidar_hold_the_points_of_cars_on_the_same_slope(frame: Frame) -> None:
    """The rule of KITTI's labels and of samples: heading alone, in the LiDAR's own frame."""
    sweep = frame.agents[0].sweep
    boxes = frame.truth.transform(invert(sweep.world_from_lidar))
    for row, object_id in enumerate(frame.truth.object_id[1:], 1):
        own = sweep.points[sweep.object_id == object_id]
        assert len(own) > 50
        # The centre of an upright box stands over the footprint's, beside that of the tilted body.
        aside = 0.5 * SLOPE * frame.truth.size[row, 2]
        assert boxes.contains(own, margin=aside + 0.08)[row].all()


def test_the_upright_box_of_a_tilted_body_stands_on_the_same_footprint(frame: Frame) -> None:
    for row, body in enumerate(frame.bodies()):
        center, yaw, tilt = upright_of(body, frame.truth.size[row, 2])
        np.testing.assert_allclose(center, frame.truth.center[row], atol=1e-12)
        np.testing.assert_allclose([yaw, *tilt], [frame.truth.yaw[row], *frame.tilt[row]], atol=1e-12)
        below = [[0.0, 0.0, -0.5 * frame.truth.size[row, 2]]]
        foot = frame.truth.center[row] + below[0]
        np.testing.assert_allclose(transform_points(body, np.array(below))[0], foot, atol=1e-12)
