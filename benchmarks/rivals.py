"""The same frame by other means: what a user of trimesh, Open3D or mujoco-lidar would write.

None has a rolling shutter of the vehicles, noise, drop-off or intensity, and their rays are made for them: they answer
an easier question.
"""

import ctypes
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.street import Fleet
from sim.geometry import transform_points


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of one sweep in the world frame, ring by ring.

    Attributes:
        origins: (N, 3) float32.
        directions: (N, 3) float32 unit vectors.
    """

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]


def trimesh_frame(
    static: trimesh.Trimesh, vehicles: Fleet, time_s: float, sweeps: Sequence[Rays], reach_m: float
) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Return points and owners (-1: the streets) by trimesh's ray caster over one mesh of everything, joined anew."""
    poses = vehicles.actors(time_s).world_from_body()
    bodies = [mesh.copy().apply_transform(pose) for mesh, pose in zip(vehicles.meshes(), poses, strict=True)]
    whole = trimesh.util.concatenate([static, *bodies])
    first = np.cumsum([len(static.faces), *(len(body.faces) for body in bodies)])
    caster = RayMeshIntersector(whole)
    made = []
    for rays in sweeps:
        points, ray, face = caster.intersects_location(rays.origins, rays.directions, multiple_hits=False)
        near = np.linalg.norm(points - rays.origins[ray], axis=1) <= reach_m
        made.append((points[near], np.searchsorted(first, face[near], side="right") - 1))
    return made


class Open3DFrame:
    """Open3D's `RaycastingScene`: one scene for the streets, and one for the vehicles that is made anew per frame."""

    def __init__(self, static: trimesh.Trimesh) -> None:
        """Build the scene of the streets."""
        import open3d

        self._core, self._scene = open3d.core, open3d.t.geometry.RaycastingScene
        self._static = self._scene()
        self._add(self._static, np.asarray(static.vertices), np.asarray(static.faces))

    def __call__(
        self, vehicles: Fleet, time_s: float, sweeps: Sequence[Rays], reach_m: float
    ) -> list[tuple[NDArray[np.float32], NDArray[np.int64]]]:
        """Return points and owners, as `trimesh_frame`."""
        moving = self._scene()
        poses = vehicles.actors(time_s).world_from_body()
        for mesh, pose in zip(vehicles.meshes(), poses, strict=True):
            self._add(moving, transform_points(pose, mesh.vertices), mesh.faces)
        made = []
        for rays in sweeps:
            table = self._core.Tensor(np.hstack([rays.origins, rays.directions]))
            world, bodies = self._static.cast_rays(table), moving.cast_rays(table)
            to_world, to_body = world["t_hit"].numpy(), bodies["t_hit"].numpy()
            distance = np.minimum(to_world, to_body)
            owner = np.where(to_body < to_world, bodies["geometry_ids"].numpy().astype(np.int64), -1)
            hit = distance <= reach_m
            made.append((rays.origins[hit] + distance[hit, None] * rays.directions[hit], owner[hit]))
        return made

    def _add(self, scene: object, vertices: NDArray[np.floating], faces: NDArray[np.int64]) -> None:
        tensor = self._core.Tensor
        scene.add_triangles(  # type: ignore[attr-defined]
            tensor(np.ascontiguousarray(vertices, np.float32)), tensor(np.ascontiguousarray(faces, np.uint32))
        )


class MujocoFrame:
    """mujoco-lidar on the CPU, `mj_multiRay` of MuJoCo on one thread: one model, in which the vehicles are bodies.

    Easier still: the sensor stands where it is on average, and owners are unknown.
    """

    def __init__(self, static: trimesh.Trimesh, vehicles: Fleet, sweeps: Sequence[Rays], reach_m: float) -> None:
        """Build the model, and the angles of the rays."""
        import mujoco
        from mujoco_lidar.core_cpu.mjlidar_cpu import MjLidarCPU

        spec = mujoco.MjSpec()
        for number, mesh in enumerate([static, *vehicles.meshes()]):
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a street has no volume
            spec.add_mesh(name=str(number), uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel(), inertia=shell)
            body = spec.worldbody.add_body(mocap=number > 0)
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(number), contype=0, conaffinity=0)
        self._model = spec.compile()
        self._data, self._place = mujoco.MjData(self._model), mujoco.mj_kinematics
        self._lidar = MjLidarCPU(self._model, cutoff_dist=reach_m)
        self._origins = [rays.origins.mean(axis=0, dtype=np.float64) for rays in sweeps]
        angles = [rays.directions.T.astype(np.float64) for rays in sweeps]
        self._angles = [(np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))) for x, y, z in angles]

    def __call__(self, vehicles: Fleet, time_s: float) -> list[NDArray[np.float64]]:
        """Return points."""
        poses = vehicles.actors(time_s).world_from_body()
        self._data.mocap_pos[:] = poses[:, :3, 3]
        self._data.mocap_quat[:] = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
        self._place(self._model, self._data)
        self._lidar.update(self._data)
        made, pose = [], np.eye(4)
        for origin, (theta, phi) in zip(self._origins, self._angles, strict=True):
            pose[:3, 3] = origin
            self._lidar.trace_rays(pose, theta, phi)
            made.append(self._lidar.get_hit_points()[self._lidar.get_distances() >= 0.0] + origin)
        return made


def mujoco_lidar_version() -> str | None:
    """Return the version of mujoco-lidar, None where it is not installed."""
    try:
        return version("mujoco-lidar")
    except PackageNotFoundError:
        return None


def open3d_version() -> str | None:
    """Return the version of Open3D, None where it is not installed or cannot start."""
    # Open3D wants libusb for cameras that nobody uses here; the wheel `libusb-package` brings one.
    if importlib.util.find_spec("libusb_package") is not None:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        import open3d
    except (ImportError, OSError):
        return None
    return str(open3d.__version__)
