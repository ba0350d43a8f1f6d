"""One small scene that every format's test files hold: a moving sensor, a car ahead, a pedestrian beside it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES, Boxes
from sim.geometry import invert, pose_matrix, transform_points

FRAMES = 3
INTERVAL_S = 0.1
HEIGHT_M = 1.73
SPEED_MPS = 5.0


@dataclass(frozen=True)
class Instant:
    """What is true at one instant.

    Attributes:
        points: (P, 4) float32 x, y, z, intensity from 0 to 1, in the sensor's frame.
        ring: (P,) beam, 0 at the bottom, as Velodyne counts.
        world_from_lidar: (4, 4).
        boxes: in the world.
        time_s: since the first frame.
    """

    points: NDArray[np.float32]
    ring: NDArray[np.uint8]
    world_from_lidar: NDArray[np.float64]
    boxes: Boxes
    time_s: float
    local: Boxes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "local", self.boxes.transform(invert(self.world_from_lidar)))


def instant(index: int, points: int = 1500, yaw: float = 0.35) -> Instant:
    """Return the scene at a frame: the car drives with the sensor, the pedestrian walks across."""
    rng = np.random.default_rng([7, index])
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    place = np.array([100.0, 50.0, HEIGHT_M]) + SPEED_MPS * INTERVAL_S * index * forward
    pose = pose_matrix(place, yaw)
    local = Boxes.from_array(
        [[12.0, -1.5, -0.98, 4.2, 1.8, 1.5, 0.1], [9.0, 2.0 + 0.1 * index, -0.83, 0.8, 0.7, 1.8, -1.2]],
        [CLASSES.index("car"), CLASSES.index("pedestrian")],
        [1, 2],
    )
    ground = np.column_stack([rng.uniform(-30, 30, (points, 2)), np.full(points, -HEIGHT_M)])
    shell = [_on(local[row : row + 1], rng, 120) for row in range(2)]
    xyz = np.concatenate([ground, *shell]).astype(np.float32)
    elevation = np.arctan2(xyz[:, 2], np.hypot(*xyz[:, :2].T))
    ring = np.argsort(np.argsort(elevation)) * 32 // len(xyz)
    # Eighths of 255 are exact in every scale that a format has.
    intensity = rng.integers(0, 256, len(xyz)) / 255.0
    cloud = np.column_stack([xyz, intensity]).astype(np.float32)
    return Instant(cloud, ring.astype(np.uint8), pose, local.transform(pose), INTERVAL_S * index)


def _on(box: Boxes, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return (count, 3) points inside a box."""
    half = 0.48 * box.size[0]
    return np.asarray(transform_points(pose_matrix(box.center[0], box.yaw[0]), rng.uniform(-half, half, (count, 3))))
