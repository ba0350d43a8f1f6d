"""Sensors that a recording lacks are cast in the world, traffic and instant of its frames."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dsrc.data.drives import Drive, open_drive
from dsrc.review.labs.casting import DriveWorld, Placement, open_world
from sensors.frame import AgentFrame
from sensors.presets import get_lidar
from sensors.sweep import Sweep
from sim.errors import DataError
from sim.geometry import invert, pose_angles
from tests.dsrc.review.labs.drive import small_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return open_drive(small_drive(tmp_path_factory.mktemp("data")))


def placed_as(agent: AgentFrame) -> Placement:
    local = invert(agent.world_from_body) @ agent.sweep.world_from_lidar
    yaw, pitch, _ = pose_angles(local)
    return Placement(tuple(local[:3, 3].tolist()), float(np.degrees(yaw)), float(np.degrees(pitch)))


@pytest.mark.parametrize("row", [0, 1, 2])
def test_the_drives_own_sensor_is_cast_as_it_was_recorded(drive: Drive, row: int) -> None:
    frame = drive.read(1)
    agent = frame.agents[row]
    carrier = agent.world_from_body if agent.kind == "roadside" else agent.agent_id
    made = open_world(drive.drive).cast(1, frame.time_s, agent.sweep.spec, placed_as(agent), carrier)
    assert made.rays == agent.sweep.spec.rings * agent.sweep.spec.columns and made.seconds > 0.0
    assert len(made.sweep) == pytest.approx(len(agent.sweep), rel=0.05)
    away = cKDTree(made.sweep.world_points).query(agent.sweep.world_points)[0]
    assert np.quantile(away, 0.9) < 0.15, "range noise of the sensor, and what its beams just miss"


def test_a_sensor_that_is_raised_sees_farther_and_one_that_looks_up_sees_less(drive: Drive) -> None:
    frame, world, spec = drive.read(0), open_world(drive.drive), get_lidar("vlp-16")
    ego = frame.agents[0].agent_id

    def cast(height: float, pitch: float = 0.0) -> Sweep:
        return world.cast(0, frame.time_s, spec, Placement((0.0, 0.0, height), 0.0, pitch), ego).sweep

    low, high, up = cast(2.0), cast(6.0), cast(2.0, -45.0)
    on_road = [sweep.range[sweep.object_id < 0] for sweep in (low, high)]
    assert np.median(on_road[1]) > np.median(on_road[0]) and len(up) < len(low)


def test_a_drive_of_real_sensors_has_no_world(tmp_path: Path, drive: Drive) -> None:
    with pytest.raises(DataError, match=r"world\.npz: expected the world and traffic of the drive, found none"):
        DriveWorld(tmp_path)
    world, spec = open_world(drive.drive), get_lidar("vlp-16")
    with pytest.raises(DataError, match="expected traffic at 1000 s"):
        world.cast(0, 1000.0, spec, Placement((0.0, 0.0, 2.0)), drive.read(0).agents[0].agent_id)
    with pytest.raises(DataError, match="expected road user 4711"):
        world.cast(0, drive.read(0).time_s, spec, Placement((0.0, 0.0, 2.0)), 4711)
