"""What the benchmark of the LiDAR times: frames of all agents, bare casts of the same rays, and parts of a frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from benchmarks.rivals import Rays
from benchmarks.street import BENCHMARK_LIDAR, Fleet, baked, fleet, street_world
from sensors.optics.beams import beams_of
from sensors.raycast import Returns, Solid, SweepRequest
from sensors.scan.lidar import Sensor, scan_all
from sensors.scan.scene import RayScene
from sensors.sweep import Sweep
from sim.traffic.base import Actors

FRAME_S = 0.1
"""Time from one frame to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """What is measured.

    Attributes:
        static: the streets.
        vehicles: the fleet.
        sensors: of its agents, at time 0.
        rays: of each sensor's sweep, as a sensor without noise fires them.
    """

    static: trimesh.Trimesh
    vehicles: Fleet
    sensors: list[Sensor]
    rays: list[Rays]

    @property
    def agents(self) -> int:
        """Number of sweeps per frame."""
        return len(self.sensors)

    def scene(self, engine: str) -> RayScene:
        """Return the streets without vehicles in one engine."""
        return RayScene(self.static, body_mesh=self.vehicles.body_mesh, engine=engine)


def make_street() -> Street:
    """Return the streets with 60 vehicles and 5 agents."""
    vehicles = fleet(60)
    sensors = vehicles.sensors(0.0, np.random.default_rng(1))
    return Street(street_world(), vehicles, sensors, [rays_of(sensor) for sensor in sensors])


def rays_of(sensor: Sensor) -> Rays:
    """Return the rays of a sweep in the world frame, ring by ring, each from where the sensor is when it fires."""
    axis = beams_of(sensor.spec, sensor.time_s).axis[:, :, : sensor.spec.columns].reshape(3, -1)
    poses = sensor.path.at(sensor.time_s + sensor.spec.time_offset.ravel())
    directions = np.einsum("nij,jn->ni", poses[:, :3, :3], axis)
    return Rays(poses[:, :3, 3].astype(np.float32), directions.astype(np.float32))


def bare_embree(street: Street) -> Callable[[], list[NDArray[np.float32]]]:
    """Return R for one frame: each sweep over the baked scene without the vehicle that carries the sensor."""
    scenes = []
    for row in street.vehicles.agents:
        vertices, faces = baked(street.static, street.vehicles, 0.0, left_out=row)
        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
        # The first ray commits the scene.
        scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
        scenes.append(scene)
    reach = BENCHMARK_LIDAR.range_max_m

    def run() -> list[NDArray[np.float32]]:
        return [
            scene.run(rays.origins, rays.directions, dists=reach, query="DISTANCE")
            for scene, rays in zip(scenes, street.rays, strict=True)
        ]

    return run


def complete_frame(scene: RayScene, street: Street, threads: int | None, subrays: int = 1) -> Callable[[], list[Sweep]]:
    """Return a frame from the traffic to the sweeps: the scene's update and a sweep of each agent."""
    now, before, after = _instants(street.vehicles)
    spec = msgspec.structs.replace(BENCHMARK_LIDAR, subrays=subrays)
    sensors = street.vehicles.sensors(0.0, np.random.default_rng(1), spec)
    return lambda: scan_all(scene.with_bodies(now, before, after), sensors, threads=threads)


def scene_update(scene: RayScene, vehicles: Fleet) -> Callable[[], object]:
    """Return the update alone: from the traffic's tables to the bodies and their paths."""
    now, before, after = _instants(vehicles)
    return lambda: scene.with_bodies(now, before, after)


class _Canned:
    """A scene that answers once and then keeps giving the same answer."""

    def __init__(self, scene: RayScene) -> None:
        self._scene = scene
        self._returns: list[Returns] = []
        self.requests: Sequence[SweepRequest] = ()

    def sweep(self, requests: Sequence[SweepRequest], threads: int = 1) -> list[Returns]:
        if not self._returns:
            self.requests, self._returns = requests, self._scene.sweep(requests, threads)
        return self._returns


def fused_parts(scene: RayScene, street: Street) -> dict[str, Callable[[], object]]:
    """Return parts of a frame of the fused engine on one thread.

    The kernel runs whole, with every beam lost before it is reported, without vehicles, and without any triangle, so
    that differences tell its stages apart. Packets are the same rays cast by the engine without a sensor: what any
    LiDAR made of such packets costs at least.
    """
    now, before, after = _instants(street.vehicles)
    moving = scene.with_bodies(now, before, after)
    canned, lost = _Canned(moving), _Canned(moving)
    scan_all(canned, street.sensors, threads=1)  # type: ignore[arg-type]
    deaf = msgspec.structs.replace(BENCHMARK_LIDAR, dropoff_rate=1.0)
    scan_all(lost, street.vehicles.sensors(0.0, np.random.default_rng(1), deaf), threads=1)  # type: ignore[arg-type]
    void = RayScene(None, engine="fused")
    reach = np.full(len(street.rays[0].origins), BENCHMARK_LIDAR.range_max_m, np.float32)
    everything = _solid(*baked(street.static, street.vehicles, 0.0))
    streets = _solid(street.static.vertices, street.static.faces)

    def packets(solid: Solid) -> Callable[[], object]:
        return lambda: [scene.engine.cast(solid, rays.origins, rays.directions, reach) for rays in street.rays]

    return {
        "python": lambda: scan_all(canned, street.sensors, threads=1),  # type: ignore[arg-type]
        "kernel": lambda: moving.sweep(canned.requests, 1),
        "kernel_lost": lambda: moving.sweep(lost.requests, 1),
        "kernel_static": lambda: scene.sweep(canned.requests, 1),
        "kernel_void": lambda: void.sweep(canned.requests, 1),
        "packets_static": packets(streets),
        "packets_baked": packets(everything),
    }


def _instants(vehicles: Fleet) -> tuple[Actors, Actors, Actors]:
    """Return the vehicles now, a frame earlier and a frame later, as a drive at 10 Hz knows them."""
    return vehicles.actors(0.0), vehicles.actors(-FRAME_S), vehicles.actors(FRAME_S)


def _solid(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Solid:
    return Solid(
        np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.zeros(len(faces), np.uint8), np.zeros(3)
    )
