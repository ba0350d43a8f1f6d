"""Points of frames that a device keeps."""

from dataclasses import replace

import numpy as np

from dsrc.training.resident.store import FramePoints, without_points
from sensors.frame import Frame
from sim.boxes import concatenate
from tests.dsrc.training.drive import frame


def test_points_know_the_boxes_that_they_are_in() -> None:
    world = frame(0)
    # A second box around the third car: its points are in both.
    truth = concatenate([world.truth, replace(world.truth[2:3], object_id=np.array([5000]))])
    both = Frame(0, 0.0, world.agents, truth, np.zeros((10, 2)), np.zeros((3, 10), np.int32))
    points = FramePoints.of(both)
    start = first = 0
    for agent, size, found in zip(world.agents, points.sizes, points.found, strict=True):
        rows, owners = points.rows[first : first + found].numpy(), points.owners[first : first + found].numpy()
        cloud = points.points[start : start + size].numpy()
        assert (np.diff(rows) > 0).all()
        in_world = cloud[:, :3].astype(float) @ agent.sweep.world_from_lidar[:3, :3].T
        inside = truth.contains(in_world + agent.sweep.world_from_lidar[:3, 3]).T
        np.testing.assert_array_equal(rows, np.flatnonzero(inside.any(1)))
        for row, own in zip(rows, owners, strict=True):
            assert set(own) == set(np.flatnonzero(inside[row]))
        start, first = start + size, first + found
    assert (points.owners[:, 0] != points.owners[:, 1]).any()
    assert (points.owners[:, 0] == points.owners[:, 1]).any()


def test_a_frame_without_points_keeps_everything_else() -> None:
    world = frame(1)
    light = without_points(world)
    assert [len(agent.sweep) for agent in light.agents] == [0, 0, 0]
    np.testing.assert_array_equal(light.points_on, world.points_on)
    for agent, other in zip(light.agents, world.agents, strict=True):
        np.testing.assert_array_equal(agent.sweep.world_from_lidar, other.sweep.world_from_lidar)
