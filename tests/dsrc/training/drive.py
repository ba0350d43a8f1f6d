"""A made-up drive that a detector can learn: cars on a plane, seen by two of them and a roadside unit."""

from pathlib import Path

import numpy as np

from dsrc.data.formats.opv2v.reader import write_frame
from sensors.frame import AgentFrame, Frame, count_points
from sensors.spec import LidarSpec
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix, transform_points

SPEC = LidarSpec(name="made up", elevation_deg=(2.0, -3.0, -10.0), columns=100, source="a test")
CARS = 9


def cars(rng: np.random.Generator) -> Boxes:
    """Return cars in a grid of parking places, shaken; the first two carry a LiDAR."""
    x, y = np.meshgrid([-16.0, 0.0, 16.0], [-7.0, 0.0, 7.0])
    place = np.stack([x.ravel(), y.ravel()], axis=1)[[4, 7, 0, 1, 2, 3, 5, 6, 8]] + rng.uniform(-1, 1, (CARS, 2))
    size = np.tile([4.4, 1.8, 1.5], (CARS, 1)) + rng.uniform(-0.2, 0.2, (CARS, 3))
    yaw = rng.uniform(-0.3, 0.3, CARS)
    yaw[0] = 0.0
    rows = np.concatenate([place, size[:, 2:] / 2, size, yaw[:, None]], axis=1)
    return Boxes.from_array(rows, object_id=np.arange(1000, 1000 + CARS))


def frame(index: int, ground: int = 1500, per_car: int = 120) -> Frame:
    """Return a frame whose numbers depend on its index alone."""
    truth = cars(np.random.default_rng([5, index]))
    agents = []
    for agent_id in (1000, 1001, -1):
        rng = np.random.default_rng([6, index, agent_id + 1])
        if agent_id > 0:
            row = agent_id - 1000
            body = pose_matrix(truth.center[row] * [1, 1, 0], truth.yaw[row])
            lidar = body @ pose_matrix([0, 0, 1.8])
        else:
            body = pose_matrix([-10.0, -11.0, 0.0])
            lidar = body @ pose_matrix([0, 0, 2.0])
        # Every agent sees two thirds of the others' cars, the same ones in each frame.
        seen = np.array([i for i in range(CARS) if i + 1000 != agent_id and (i + agent_id) % 3])
        world, ids = [np.concatenate([rng.uniform(-26, 26, (ground, 2)), np.zeros((ground, 1))], axis=1)], [-1] * ground
        for car in seen:
            local = rng.uniform(-0.49, 0.49, (per_car, 3))
            side = rng.integers(0, 2, per_car)
            local[np.arange(per_car), side] = np.sign(local[np.arange(per_car), side]) * 0.49
            world.append(transform_points(pose_matrix(truth.center[car], truth.yaw[car]), local * truth.size[car]))
            ids += [1000 + car] * per_car
        points = transform_points(invert(lidar), np.concatenate(world)).astype(np.float32)
        n = len(points)
        sweep = make_sweep(
            points,
            lidar,
            0.1 * index,
            SPEC,
            intensity=rng.random(n, dtype=np.float32),
            ring=np.zeros(n),
            column=np.arange(n),
            time_offset=np.zeros(n),
            object_id=np.array(ids),
            return_number=np.ones(n),
            fate=np.zeros(n),
        )
        agents.append(AgentFrame(agent_id, "roadside" if agent_id < 0 else "vehicle", body, 0.0, sweep))
    counts = np.stack([count_points(a.sweep, truth.object_id) for a in agents])
    return Frame(index, 0.1 * index, tuple(agents), truth, np.zeros((CARS, 2)), counts)


def write_drive(root: Path, frames: int) -> Path:
    """Write a drive of this many frames below a folder; return the folder."""
    for index in range(frames):
        write_frame(root / "made_up", frame(index))
    return root
