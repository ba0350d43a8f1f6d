"""Mounting of sensors on vehicles and roadside units."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.optics.beams import beams_of
from sensors.presets import get_lidar
from sensors.scan.lidar import Sensor
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sim.geometry import pose_matrix
from sim.scenario import RoadsideUnit
from sim.traffic.base import Actors

_ROOF_CLEARANCE_M = 0.2
_BLOCKED_M = 1.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Roadside:
    """Roadside unit: id (-1, -2, ...), place and sensor.

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


@dataclass(frozen=True, slots=True)
class Mount:
    """Place of the vehicles' sensors.

    Attributes:
        xyz_m: in the body frame; None for the preset's place, lifted clear of the roofs of tall vehicles.
        pitch_deg: positive looks down.
    """

    xyz_m: tuple[float, float, float] | None = None
    pitch_deg: float = 0.0


ON_ROOF = Mount()


def mount(spec: LidarSpec, height_m: float, place: Mount = ON_ROOF) -> NDArray[np.float64]:
    """Return body_from_lidar (4, 4) on a vehicle of a given height."""
    x, y, z = spec.mount_xyz_m if place.xyz_m is None else place.xyz_m
    z = max(z, height_m + _ROOF_CLEARANCE_M) if place.xyz_m is None else z
    return pose_matrix(np.array([x, y, z]), 0.0, np.radians(place.pitch_deg))


def on_vehicle(
    scene: RayScene, now: Actors, agent_id: int, spec: LidarSpec, place: Mount, rng: np.random.Generator
) -> Sensor:
    """Return the sensor on a vehicle of a scene with the bodies of `now`."""
    row = now.row(agent_id)
    body = scene.bodies.path[row]
    path = Path.through(body.time_s, body.at(body.time_s) @ mount(spec, now.boxes.size[row, 2], place))
    return Sensor(spec, path, now.time_s, rng, rides_on=agent_id)


def on_roadside(unit: Roadside, time_s: float, rng: np.random.Generator) -> Sensor:
    """Return the sensor of a roadside unit, at rest."""
    path = Path.through(time_s + np.array([-1.0, 1.0]), np.stack([unit.world_from_lidar] * 2))
    return Sensor(unit.spec, path, time_s, rng)


def place_roadside(scene: RayScene, units: Sequence[RoadsideUnit]) -> tuple[Roadside, ...]:
    """Place roadside units on the ground of the world; the first gets id -1.

    A unit whose view is mostly blocked within a metre is logged as a warning.
    """
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
        share = blocked_share(scene, placed[-1])
        if share > 0.5:
            log.warning(
                "roadside unit %d at (%g, %g, %g) stands in or before a wall: %.0f %% of its view ends within %g m",
                *(-1 - row, x, y, z, 100.0 * share, _BLOCKED_M),
            )
    return tuple(placed)


def blocked_share(scene: RayScene, unit: Roadside) -> float:
    """Return the share of a unit's view that the static world blocks within a metre."""
    axes = beams_of(unit.spec, 0.0).axis[:, :, ::10].reshape(3, -1)
    directions = unit.world_from_lidar[:3, :3] @ axes
    origins = np.broadcast_to(unit.world_from_lidar[:3, 3], (axes.shape[1], 3))
    return float((scene.cast(origins, directions.T, _BLOCKED_M).face >= 0).mean())
