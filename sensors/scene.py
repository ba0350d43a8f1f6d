"""RayScene: the static world once, each body once, and where the bodies are during a sweep.

No triangle moves: the rays that may meet a body are brought into the body's own frame at their firing time, so a
frame costs nothing to prepare and a body's shape in the sweep is smeared exactly as its motion asks.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sensors.motion import Path, actor_paths
from sensors.raycast import TriangleScene
from sensors.sweep import STATIC
from sensors.windows import windows_of
from sim.geometry import invert, transform_points
from sim.traffic.base import Actors

BodyMesh = Callable[[str, tuple[float, float, float]], trimesh.Trimesh]
"""(model, (l, w, h)) -> mesh in the body frame."""

_BODIES_KEPT = 1024
_GROW_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of one sweep: R rings fired together in each of C columns.

    Attributes:
        elevation: (R,) rad in the sensor frame.
        azimuth: (C,) rad in the sensor frame.
        time_s: (C,) firing times, s.
        world_from_lidar: (C, 4, 4) pose of the sensor at each firing.
        reach_m: farthest distance.
    """

    elevation: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    time_s: NDArray[np.float64]
    world_from_lidar: NDArray[np.float64]
    reach_m: float

    def directions(
        self, frame_from_world: NDArray[np.float64], rings: NDArray, columns: NDArray
    ) -> NDArray[np.float64]:
        """Return (r, c, 3) unit directions of some rings and columns in frames given per column (c, 4, 4)."""
        axes = frame_from_world[:, :3, :3] @ self.world_from_lidar[columns, :3, :3]
        azimuth, elevation = self.azimuth[columns, None], self.elevation[rings, None, None]
        level = np.cos(azimuth) * axes[:, :, 0] + np.sin(azimuth) * axes[:, :, 1]
        return np.cos(elevation) * level + np.sin(elevation) * axes[:, :, 2]


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """What the rays met, as (R, C) arrays.

    Attributes:
        hit: whether anything was met within reach.
        distance: float32, m.
        cosine: float32 |cos| of the incidence angle.
        material: uint8 index into `sim.world.materials.MATERIALS`.
        object_id: int32 actor, or `STATIC`.
        direction: (R, C, 3) float64 unit directions in the world.
    """

    hit: NDArray[np.bool_]
    distance: NDArray[np.float32]
    cosine: NDArray[np.float32]
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]
    direction: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Solid:
    """A mesh ready for rays: its hierarchy and the material of each face."""

    triangles: TriangleScene
    material: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """The N moving actors of one instant: who, which solid, how large and along which path."""

    object_id: NDArray[np.int64]
    size: NDArray[np.float64]
    solids: tuple[_Solid, ...]
    path: Path

    def near(self, rays: Rays) -> NDArray[np.int64]:
        """Return the rows that may come within reach of the rays."""
        sensor = rays.world_from_lidar[len(rays.time_s) // 2, :2, 3]
        # A quarter more than the reach covers any motion within the time of a path.
        half = 0.5 * np.linalg.norm(self.size[:, :2], axis=1)
        distance = np.linalg.norm(self.path.xyz[:, :, :2] - sensor, axis=2).min(axis=1, initial=np.inf)
        return np.flatnonzero(distance - half <= 1.25 * rays.reach_m)


_NO_BODIES = Bodies(np.zeros(0, np.int64), np.zeros((0, 3)), (), Path(np.arange(2.0), *np.zeros((2, 0, 2, 3))))


class RayScene:
    """A static world and the bodies in it; see `with_bodies`."""

    def __init__(self, static: trimesh.Trimesh, *, body_mesh: BodyMesh | None = None, robust: bool = True) -> None:
        """Prepare the static world.

        Args:
            static: triangles in the world frame with `face_attributes["material"]`.
            body_mesh: meshes of actors; `sim.world.bodies.body_mesh` when left out.
            robust: watertight at shared edges, for an eighth of the speed.
        """
        vertices = np.asarray(static.vertices, np.float64)
        # Embree computes in float32: away from the origin of a large network it would lose millimetres.
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0 if len(vertices) else np.zeros(3)
        self.origin: NDArray[np.float64] = np.round(middle)
        self.bodies: Bodies = _NO_BODIES
        self._robust = robust
        self._body_mesh = body_mesh
        self._static = _solid(static, self.origin, robust)
        self._solids: dict[tuple[str, tuple[float, ...]], _Solid] = {}

    def with_bodies(
        self, now: Actors, before: Actors | None = None, after: Actors | None = None, reach_s: float = 0.05
    ) -> "RayScene":
        """Return a scene with the actors of one instant, sharing everything that was built.

        Args:
            now: the actors at the reference time of the sweeps.
            before: the actors at least half a sweep earlier; without it they move straight.
            after: the actors at least half a sweep later; likewise.
            reach_s: half the longest sweep, s.
        """
        scene = object.__new__(RayScene)
        scene.__dict__.update(self.__dict__)
        scene.bodies = Bodies(
            object_id=now.boxes.object_id,
            size=now.boxes.size,
            solids=tuple(
                self._body(model, tuple(float(v) for v in size.round(3)))
                for model, size in zip(now.model, now.boxes.size, strict=True)
            ),
            path=actor_paths(now, before, after, reach_s),
        )
        return scene

    def ground_height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N,) height of the lowest static surface at (N, 2) places in the world; 0 where there is none."""
        high = np.zeros((len(xy), 3), np.float32)
        high[:, :2] = np.asarray(xy, np.float64) - self.origin[:2]
        top = np.float32(1000.0)
        high[:, 2] = top
        # From below the first surface is the lowest one, whatever trees and roofs stand above it.
        low = high * np.array([1, 1, -1], np.float32)
        up = np.tile(np.array([[0, 0, 1]], np.float32), (len(xy), 1))
        hits = self._static.triangles.cast(low, up, np.full(len(xy), 2 * top))
        return np.where(hits.face >= 0, hits.distance - top + self.origin[2], 0.0)

    def trace(self, rays: Rays, exclude_id: int | None = None) -> Trace:
        """Cast the rays of a sweep against the static world and every body but one."""
        trace = self._trace_static(rays)
        rows = self.bodies.near(rays)
        windows = windows_of(self._corners_seen(rays, rows))
        in_columns, in_rings = windows.columns(rays.azimuth), windows.rings(rays.elevation)
        for slot in np.argsort(windows.near, kind="stable"):
            row = rows[slot]
            if self.bodies.object_id[row] == exclude_id:
                continue
            rings, columns = np.flatnonzero(in_rings[slot]), np.flatnonzero(in_columns[slot])
            # Rays that have already met something nearer need no second look.
            open_rays = trace.distance[np.ix_(rings, columns)] > windows.near[slot]
            columns = columns[open_rays.any(axis=0)]
            rings = rings[open_rays.any(axis=1)]
            if len(rings) and len(columns):
                _trace_body(trace, rays, self.bodies, row, rings, columns)
        return trace

    def _trace_static(self, rays: Rays) -> Trace:
        shape = (len(rays.elevation), len(rays.azimuth))
        world_frames = np.broadcast_to(np.eye(4), (shape[1], 4, 4))
        direction = rays.directions(world_frames, np.arange(shape[0]), np.arange(shape[1]))
        origin = (rays.world_from_lidar[:, :3, 3] - self.origin).astype(np.float32)
        hits = self._static.triangles.cast(
            np.broadcast_to(origin, (*shape, 3)).reshape(-1, 3),
            direction.astype(np.float32).reshape(-1, 3),
            np.full(shape[0] * shape[1], rays.reach_m, np.float32),
        )
        return Trace(
            hit=(hits.face >= 0).reshape(shape),
            distance=hits.distance.reshape(shape),
            cosine=hits.cosine.reshape(shape),
            material=_materials(self._static, hits.face).reshape(shape),
            object_id=np.full(shape, STATIC, np.int32),
            direction=direction,
        )

    def _corners_seen(self, rays: Rays, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return (N, 24, 3) corners of bodies' boxes in the sensor frame at start, middle and end of a sweep."""
        moments = [0, len(rays.time_s) // 2, -1]
        lidar_from_body = invert(rays.world_from_lidar[moments]) @ self.bodies.path[rows].at(rays.time_s[moments])
        signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
        local = signs * (self.bodies.size[rows, None] + _GROW_M) - np.array([0.0, 0.0, 0.5 * _GROW_M])
        corners = transform_points(lidar_from_body, local[:, None])
        return np.asarray(corners, np.float64).reshape(len(rows), 24, 3)

    def _body(self, model: str, size: tuple[float, ...]) -> _Solid:
        key = (model, size)
        if key not in self._solids:
            if self._body_mesh is None:
                from sim.world.bodies import body_mesh

                self._body_mesh = body_mesh
            if len(self._solids) >= _BODIES_KEPT:
                self._solids.pop(next(iter(self._solids)))
            self._solids[key] = _solid(self._body_mesh(model, (size[0], size[1], size[2])), np.zeros(3), self._robust)
        return self._solids[key]


def _trace_body(trace: Trace, rays: Rays, bodies: Bodies, row: int, rings: NDArray, columns: NDArray) -> None:
    """Cast some rays against one body, in its own frame at each firing, and keep what is nearer."""
    body_from_world = invert(bodies.path[row].at(rays.time_s[columns]))
    origin = transform_points(body_from_world, rays.world_from_lidar[columns, None, :3, 3])[:, 0]
    direction = rays.directions(body_from_world, rings, columns)
    where = np.ix_(rings, columns)
    hits = bodies.solids[row].triangles.cast(
        np.broadcast_to(origin.astype(np.float32), direction.shape).reshape(-1, 3),
        direction.astype(np.float32).reshape(-1, 3),
        trace.distance[where].reshape(-1),
    )
    nearer = hits.face >= 0
    ring, column = (index.reshape(-1)[nearer] for index in np.broadcast_arrays(*where))
    trace.hit[ring, column] = True
    trace.distance[ring, column] = hits.distance[nearer]
    trace.cosine[ring, column] = hits.cosine[nearer]
    trace.material[ring, column] = bodies.solids[row].material[hits.face[nearer]]
    trace.object_id[ring, column] = bodies.object_id[row]


def _materials(solid: _Solid, face: NDArray[np.int32]) -> NDArray[np.uint8]:
    if len(solid.material) == 0:
        return np.zeros(len(face), np.uint8)
    return solid.material[np.maximum(face, 0)]


def _solid(mesh: trimesh.Trimesh, origin: NDArray[np.float64], robust: bool) -> _Solid:
    material = mesh.face_attributes.get("material")
    if material is None:
        material = np.zeros(len(mesh.faces), np.uint8)
    triangles = TriangleScene(np.asarray(mesh.vertices, np.float64) - origin, np.asarray(mesh.faces), robust=robust)
    return _Solid(triangles, np.asarray(material, np.uint8))
