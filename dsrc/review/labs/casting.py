"""DriveWorld: static world and traffic of a recorded drive, through which further sensors are cast."""

import math
import threading
import time
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD
from dsrc.review.labs.placement import Cast, Placement
from sensors.motion import Path as MotionPath
from sensors.scan.lidar import Sensor, scan_all
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sim.errors import DataError, complaint
from sim.streams import Stream, random_generator
from sim.traffic.base import Actors
from sim.traffic.log import TrafficLog
from sim.world.world_file import load_world

_WORLDS_KEPT = 2
"""Worlds kept: a city takes some hundred MB."""


class DriveWorld:
    """Static world and traffic of a simulated drive; threads may share it.

    Raises:
        DataError: a file is missing, as in drives of real sensors, or damaged.
    """

    def __init__(self, folder: Path) -> None:
        for name in (WORLD, TRAFFIC_LOG):
            if not (folder / name).is_file():
                hint = "; drives of dsrc generate have it"
                raise DataError(complaint(folder, name, "the world and traffic of the drive", "none", hint))
        world = load_world(folder / WORLD)
        self._folder = folder
        self._log = TrafficLog.load(folder / TRAFFIC_LOG)
        self._scene = RayScene(world.static, body_mesh=world.body_mesh)
        self._casting = threading.Lock()

    def cast(
        self,
        index: int,
        time_s: float,
        spec: LidarSpec,
        placement: Placement,
        carrier: int | NDArray[np.float64],
    ) -> Cast:
        """Cast the sweep of a sensor at one instant.

        Args:
            index: of the frame, which draws the sensor's noise.
            carrier: id of a road user, with which the sensor moves; or (4, 4) world_from_body of something that stands.

        Raises:
            DataError: the traffic lacks the instant or the road user.
        """
        step, margin = self._step(time_s), math.ceil(0.5 * spec.period_s / self._log.step_s - 1e-9)
        now, known = self._log[step], range(len(self._log))
        # At an end of the log both sides are extrapolated.
        inside = step - margin in known and step + margin in known
        before, after = (self._log[step - margin], self._log[step + margin]) if inside else (None, None)
        scene = self._scene.with_bodies(now, before, after, reach_s=0.5 * spec.period_s)
        sensor = _mounted(scene, now, index, spec, placement, carrier)
        rays = spec.rings * spec.columns * spec.subrays
        with self._casting:
            started = time.perf_counter()
            (sweep,) = scan_all(scene, [sensor])
            return Cast(sweep, rays, time.perf_counter() - started)

    def _step(self, time_s: float) -> int:
        first = self._log[0].time_s
        step = round((time_s - first) / self._log.step_s)
        if not 0 <= step < len(self._log) or abs(self._log[step].time_s - time_s) > 0.5 * self._log.step_s:
            found = f"{first:g} to {self._log[len(self._log) - 1].time_s:g} s"
            raise DataError(complaint(self._folder, TRAFFIC_LOG, f"traffic at {time_s:g} s", found))
        return step


def _mounted(
    scene: RayScene,
    now: Actors,
    index: int,
    spec: LidarSpec,
    placement: Placement,
    carrier: int | NDArray[np.float64],
) -> Sensor:
    rng = random_generator(0, Stream.LIDAR_NOISE, index)
    if isinstance(carrier, np.ndarray):
        pose = carrier @ placement.matrix
        return Sensor(
            spec, MotionPath.through(now.time_s + np.array([-1.0, 1.0]), np.stack([pose] * 2)), now.time_s, rng
        )
    if carrier not in now.boxes.object_id:
        raise DataError(complaint("traffic", "carrier", f"road user {carrier} at {now.time_s:g} s", "none"))
    body = scene.bodies.path[now.row(carrier)]
    path = MotionPath.through(body.time_s, body.at(body.time_s) @ placement.matrix)
    return Sensor(spec, path, now.time_s, rng, rides_on=carrier)


@lru_cache(maxsize=_WORLDS_KEPT)
def open_world(folder: Path) -> DriveWorld:
    """World of a drive, the latest used kept; raises as `DriveWorld`."""
    return DriveWorld(folder)
