"""LiDAR scans: sweeps of sensors through a scene.

Time: a sweep is centred on its reference time `time_s`; beam r of column c fires at `time_s + spec.time_offset[r, c]`,
within half a sweep of it. Every ray starts at the sensor's pose at its firing and meets every body where that body is
then (rolling shutter of both). Points are given in the sensor frame at `time_s`: the sensor's own motion is
compensated, as drivers do with odometry, so a still world is sharp; what moves is smeared by its motion, and its
ground-truth box at `time_s` sits in the middle of the smear. `sensors.deskew` gives the other conventions.

`sensors.raycast.Engine` defines what a beam measures, `sensors.optics.reflectance` how strongly surfaces return.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.optics.beams import BLOCK, Beams, beams_of
from sensors.optics.noise import draw_noise
from sensors.optics.reflectance import optics_of, reported
from sensors.raycast import Returns, SweepRequest
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import KEPT, Sweep
from sim.errors import DataError, SettingsError, complaint
from sim.machine import core_count


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Sensor:
    """LiDAR during one sweep: settings, path, time and random numbers.

    Attributes:
        spec: its settings.
        path: world_from_lidar over at least the sweep.
        rng: its random numbers, independent of the scene, so that a ray keeps its noise.
        rides_on: object that carries it, hidden unless `spec.own_body`.
    """

    spec: LidarSpec
    path: Path
    time_s: float
    rng: np.random.Generator
    rides_on: int | None = None


def scan_all(
    scene: RayScene, sensors: Sequence[Sensor], *, wetness: float = 0.0, threads: int | None = None
) -> list[Sweep]:
    """Scan one instant of a scene by several sensors at once.

    Args:
        scene: static world and the bodies around the sensors' times.
        wetness: of the surfaces, 0 dry to 1 covered by a film of water.
        threads: at most; left out: one per core. The number changes no byte.

    Returns:
        One sweep per sensor, in the sensor frame at its `time_s`, ring by ring from the top, columns ascending.

    Raises:
        SettingsError: wetness outside [0, 1], or a sweep outside the time of the scene's bodies.
        DataError: NaN or infinity in a path.
    """
    if not 0.0 <= wetness <= 1.0:
        raise SettingsError(complaint("scan", "wetness", "0 to 1", wetness))
    requests = [sweep_request(sensor, wetness) for sensor in sensors]
    made = scene.sweep(requests, threads or core_count())
    return [_sweep(sensor, request, returns) for sensor, request, returns in zip(sensors, requests, made, strict=True)]


def scan(
    scene: RayScene,
    spec: LidarSpec,
    world_from_lidar_start: NDArray[np.float64],
    world_from_lidar_end: NDArray[np.float64],
    time_s: float,
    rng: np.random.Generator,
    exclude_id: int | None = None,
    *,
    world_from_lidar: NDArray[np.float64] | None = None,
    wetness: float = 0.0,
) -> Sweep:
    """Scan a scene once by one sensor.

    Args:
        scene: static world and the bodies around `time_s`.
        world_from_lidar_start: (4, 4) pose half a rotation before `time_s`.
        world_from_lidar_end: (4, 4) pose half a rotation after.
        exclude_id: object that carries the sensor, hidden.
        world_from_lidar: (4, 4) pose at `time_s`; half-way between start and end when left out.
    """
    half = 0.5 * spec.period_s
    if world_from_lidar is None:
        poses, times = [world_from_lidar_start, world_from_lidar_end], [-half, half]
    else:
        poses, times = [world_from_lidar_start, world_from_lidar, world_from_lidar_end], [-half, 0.0, half]
    path = Path.through(time_s + np.array(times), np.stack(poses))
    return scan_all(scene, [Sensor(spec, path, time_s, rng, exclude_id)], wetness=wetness)[0]


def sweep_request(sensor: Sensor, wetness: float = 0.0, rng: np.random.Generator | None = None) -> SweepRequest:
    """Return the request of one sweep to a ray-casting engine.

    Args:
        rng: where the noise is drawn from; left out: the sensor's generator.

    Raises:
        DataError: NaN or infinity in a path.
    """
    spec = sensor.spec
    beams, knots, pose = _aimed.get(sensor) or _aim(sensor)
    return SweepRequest(
        spec=spec,
        beams=beams,
        optics=optics_of(spec, wetness),
        noise=draw_noise(beams, sensor.rng if rng is None else rng),
        knots=knots,
        pose=pose,
        time_s=sensor.time_s,
        hidden_id=None if spec.own_body else sensor.rides_on,
    )


_Aim = tuple[Beams, NDArray[np.float64], NDArray[np.float64]]
_aimed: WeakKeyDictionary[Sensor, _Aim] = WeakKeyDictionary()
"""Beams and poses of sensors whose sweep was requested: visibility asks for them again."""


def _aim(sensor: Sensor) -> _Aim:
    beams = beams_of(sensor.spec, sensor.time_s)
    knots, pose = _poses(sensor.spec, beams, sensor.path, sensor.time_s)
    if not np.isfinite(knots).all():
        raise DataError(complaint(f"sensor '{sensor.spec.name}'", "path", "finite poses", "NaN or infinity"))
    _aimed[sensor] = beams, knots, pose
    return beams, knots, pose


def _poses(spec: LidarSpec, beams: Beams, path: Path, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (B + 1, 3, 4) world_from_lidar at the borders of the blocks and (4, 4) at the reference time."""
    column = np.arange(beams.blocks + 2) * float(BLOCK)
    # The end of the sweep may cut the last block short; beyond it the path is unknown.
    full = BLOCK / (beams.columns - column[-3])
    column[-2:] = beams.columns, 0.5 * beams.columns
    times = time_s + (column - 0.5 * beams.columns) * spec.column_s
    poses = path.at(times.astype(np.float64))
    knots = poses[:-1, :3]
    knots[-1] = knots[-2] + full * (knots[-1] - knots[-2])
    return knots, poses[-1]


def _sweep(sensor: Sensor, request: SweepRequest, returns: Returns) -> Sweep:
    returns = _as_reported(sensor.spec, returns)
    return Sweep(
        **returns._asdict(),
        fate=np.full(len(returns.points), KEPT, np.uint8),
        world_from_lidar=request.pose,
        time_s=sensor.time_s,
        spec=sensor.spec,
        path=sensor.path,
    )


def _as_reported(spec: LidarSpec, returns: Returns) -> Returns:
    """Return the points that the carrier does not hide, with intensities on the sensor's own scale."""
    if spec.blocked_deg is not msgspec.UNSET:
        seen = ~spec.blocked[returns.ring, returns.column]
        returns = Returns._make(column[seen] for column in returns)
    if spec.intensity_curve is msgspec.UNSET and spec.intensity_fade_m is msgspec.UNSET:
        return returns
    full = 1.0 if spec.intensity_curve is msgspec.UNSET else spec.intensity_curve[-1][0]
    distance = np.linalg.norm(returns.points, axis=1)
    return returns._replace(intensity=reported(spec, returns.intensity * np.float32(full), distance))
