"""Where sensors sit: on the roofs of vehicles and on roadside units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.scene import RayScene
from sensors.spec import LidarSpec, get_lidar
from sim.geometry import pose_matrix
from sim.scenario import RoadsideUnit

_ROOF_CLEARANCE_M = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Roadside:
    """A roadside unit: id (-1, -2, ...), place and sensor.

    Attributes:
        agent_id: negative.
        world_from_body: (4, 4) upright, on the ground below the sensor.
        world_from_lidar: (4, 4).
        spec: the sensor.
    """

    agent_id: int
    world_from_body: NDArray[np.float64]
    world_from_lidar: NDArray[np.float64]
    spec: LidarSpec


def mount(spec: LidarSpec, height_m: float) -> NDArray[np.float64]:
    """Return body_from_lidar (4, 4): at the preset's place, lifted clear of the roofs of tall vehicles."""
    x, y, z = spec.mount_xyz_m
    return pose_matrix(np.array([x, y, max(z, height_m + _ROOF_CLEARANCE_M)]))


def place_roadside(scene: RayScene, units: Sequence[RoadsideUnit]) -> tuple[Roadside, ...]:
    """Stand roadside units on the ground of the world; the first gets id -1."""
    if not units:
        return ()
    ground = scene.ground_height(np.array([unit.xyz_m[:2] for unit in units]))
    placed = []
    for row, unit in enumerate(units):
        x, y, z = unit.xyz_m
        yaw, pitch = np.radians(unit.yaw_deg), np.radians(unit.pitch_deg)
        placed.append(
            Roadside(
                agent_id=-1 - row,
                world_from_body=pose_matrix(np.array([x, y, ground[row]]), yaw),
                world_from_lidar=pose_matrix(np.array([x, y, ground[row] + z]), yaw, pitch),
                spec=get_lidar(unit.lidar),
            )
        )
    return tuple(placed)
