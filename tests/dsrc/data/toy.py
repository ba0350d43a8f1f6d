"""A toy drive for tests: two cars and a roadside unit around three other actors, made of formulas."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from sensors.frame import AgentFrame, Frame, count_points
from sensors.motion import Path as SensorPath
from sensors.spec import LidarSpec
from sensors.sweep import POINT_FIELDS, UNKNOWN_MATERIAL, make_sweep
from sim.boxes import CLASSES, Boxes
from sim.geometry import invert, pose_matrix, transform_points
from sim.mesh.materials import MATERIALS

SPEC = LidarSpec(name="toy", elevation_deg=(2.0, -3.0, -10.0), columns=100, source="a toy")
IDS = np.array([1000, 1001, 1002, 1003, 1004, 1005])
LABELS = np.array([CLASSES.index(n) for n in ("car", "truck", "car", "pedestrian", "bus", "car")])
SIZES = np.array([[4.5, 1.8, 1.5], [9, 2.5, 3], [4.2, 1.7, 1.4], [0.5, 0.5, 1.8], [12, 2.5, 3.2], [4, 1.8, 1.5]])
PLACES = np.array([[0, 0], [20, 6], [30, -5], [10, 8], [-25, 4], [900, 900.0]])
YAWS = np.array([0.1, 3.1, -1.2, 0.0, 1.5707963, 0.3])


def truth_at(index: int) -> Boxes:
    xy = PLACES + index * 0.1 * velocity_at(index)
    array = np.concatenate([xy, SIZES[:, 2:] / 2, SIZES, YAWS[:, None]], axis=1)
    return Boxes.from_array(array, LABELS, IDS)


def velocity_at(index: int) -> np.ndarray:
    speed = np.array([8.0, 5.5, 3.3, 1.1, 1e-5, 0.0]) + 0.01 * index
    return speed[:, None] * np.stack([np.cos(YAWS), np.sin(YAWS)], axis=1)


def toy_frame(index: int, seed: int = 0, points: int = 400) -> Frame:
    truth = truth_at(index)
    agents = []
    for agent_id in (1000, 1002, -1):
        rng = np.random.default_rng([seed, index, agent_id + 10])
        row = int(np.searchsorted(IDS, agent_id)) if agent_id > 0 else None
        if row is None:
            body = pose_matrix([15.0, 15.0, 0.0], -2.0)
            lidar = body @ pose_matrix([0, 0, 5.0], 0.0, 0.2, 0.01)
        else:
            base = truth.center[row] - [0, 0, truth.size[row, 2] / 2]
            body = pose_matrix(base, truth.yaw[row], 0.01)
            lidar = body @ pose_matrix([0, 0, 1.9])
        agents.append(_agent(agent_id, truth, body, lidar, rng, points, 0.1 * index))
    counts = np.stack([count_points(a.sweep, truth.object_id) for a in agents])
    rng = np.random.default_rng([seed, index, 9])
    fraction = rng.random(counts.shape, dtype=np.float32)
    fraction[counts == 0] = np.nan
    return Frame(
        index=index,
        time_s=0.1 * index,
        agents=tuple(agents),
        truth=truth,
        velocity=velocity_at(index),
        points_on=counts,
        acceleration=np.where(IDS[:, None] == 1003, np.nan, rng.normal(size=(len(IDS), 2))),
        signals=rng.integers(0, 16, len(IDS)).astype(np.int32),
        lane=("main_0", "main_1", ":j'0_1_0", "", "main_0", ""),
        visible_fraction=fraction,
        sight=np.array([[0, 1, 2], [1, 0, 0], [2, 0, 0]], np.int8),
    )


def _agent(
    agent_id: int,
    truth: Boxes,
    body: np.ndarray,
    lidar: np.ndarray,
    rng: np.random.Generator,
    points: int,
    time_s: float,
) -> AgentFrame:
    """Points scattered over the ground and inside every near object but the own body and object 1004's far side."""
    target = rng.integers(-1, 5, points)
    target[IDS[target] == agent_id] = -1
    if agent_id == 1002:
        target[target == 4] = -1
    local = rng.uniform(-0.49, 0.49, (points, 3)) * np.where(target[:, None] < 0, 0, truth.size[target])
    c, s = np.cos(truth.yaw[target]), np.sin(truth.yaw[target])
    turned = np.stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]], axis=1)
    ground = np.concatenate([rng.uniform(-60, 60, (points, 2)), np.full((points, 1), -0.02)], axis=1)
    world = np.where(target[:, None] < 0, ground, truth.center[target] + turned)
    kind = "roadside" if agent_id < 0 else "vehicle"
    sweep = make_sweep(
        transform_points(invert(lidar), world).astype(np.float32),
        lidar,
        time_s,
        SPEC,
        intensity=rng.random(points, dtype=np.float32),
        ring=rng.integers(0, 3, points),
        column=np.arange(points),
        time_offset=np.linspace(0, 0.1, points),
        object_id=np.where(target < 0, -1, IDS[target]),
        return_number=rng.integers(1, 3, points),
        fate=rng.integers(0, 4, points),
        material=np.where(rng.random(points) < 0.1, UNKNOWN_MATERIAL, rng.integers(0, len(MATERIALS), points)),
        cosine=rng.random(points, dtype=np.float32),
    )
    return AgentFrame(agent_id, kind, body, 7.25, replace(sweep, path=path_at(lidar, time_s, agent_id)))


def path_at(lidar: np.ndarray, time_s: float, agent_id: int) -> SensorPath:
    """Vehicles drive a curve, the roadside unit stands."""
    times = np.array([-0.2, 0.0, 0.2])
    speed, turn = (0.0, 0.0) if agent_id < 0 else (7.25, 0.5)
    way = pose_matrix(np.stack([speed * times, 0 * times, 0 * times], 1), turn * times)
    return SensorPath.through(time_s + times, lidar @ way)


def same_frames(a: Frame, b: Frame) -> bool:
    if (a.index, a.time_s, len(a.agents), a.lane) != (b.index, b.time_s, len(b.agents), b.lane):
        return False
    arrays = [(a.truth.array, b.truth.array), (a.truth.label, b.truth.label), (a.velocity, b.velocity)]
    arrays += [(a.truth.object_id, b.truth.object_id), (a.points_on, b.points_on), (a.signals, b.signals)]
    arrays += [(a.acceleration, b.acceleration), (a.visible_fraction, b.visible_fraction)]
    arrays += [(a.sight, b.sight)]
    for one, two in zip(a.agents, b.agents, strict=True):
        if (one.agent_id, one.kind, one.speed) != (two.agent_id, two.kind, two.speed):
            return False
        if (one.sweep.time_s, one.sweep.spec) != (two.sweep.time_s, two.sweep.spec):
            return False
        arrays += [(one.world_from_body, two.world_from_body)]
        arrays += [(one.sweep.world_from_lidar, two.sweep.world_from_lidar)]
        if one.sweep.motion != two.sweep.motion or (one.sweep.path is None) != (two.sweep.path is None):
            return False
        if one.sweep.path is not None:
            arrays += [(getattr(one.sweep.path, n), getattr(two.sweep.path, n)) for n in ("time_s", "xyz", "angles")]
        arrays += [(getattr(one.sweep, name), getattr(two.sweep, name)) for name in POINT_FIELDS]
    return all(x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in arrays)


class ToySource:
    def __init__(self, delay_s: float = 0.0) -> None:
        self.delay_s = delay_s
        self.made: list[int] = []

    def frame(self, index: int) -> Frame:
        time.sleep(self.delay_s)
        self.made.append(index)
        return toy_frame(index)

    def plans(self, index: int) -> dict[int, np.ndarray]:
        return {1000: np.array([[1.0, 2.0, 3.0 + index]])}

    @contextmanager
    def open(self, log: Path) -> Iterator["ToySource"]:
        if not log.exists():
            log.write_bytes(b"log")
        yield self


SETTINGS = {"format": 1, "seed": 3, "frames": 5, "interval_s": 0.1, "connected_vehicles": True, "motion": "middle"}
