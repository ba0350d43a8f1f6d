"""RayScene: static world, moving bodies and the engine that casts rays through both.

No hierarchy is rebuilt per frame: a body's triangles stay in its own frame, only its poses change.
"""

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from sensors.motion import Path, actor_paths
from sensors.raycast import Bodies, Hits, Returns, Solid, SweepRequest, open_engine
from sensors.scan.static_world import StaticWorld, together
from sim.errors import DataError, SettingsError, complaint
from sim.mesh.materials import MATERIALS
from sim.traffic.base import Actors

BodyMesh = Callable[[str, tuple[float, float, float]], trimesh.Trimesh]
"""(model, (l, w, h)) -> mesh in the body frame."""

_BODIES_KEPT = 1024

_NO_MESH = np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8)
_NO_BODIES = Bodies(
    np.zeros(0, np.int64), np.zeros((0, 3)), (), Path(np.arange(2.0), *np.zeros((2, 0, 2, 3))), (0.0, 1.0)
)


class RayScene:
    """Static world and the bodies in it; see `with_bodies`."""

    def __init__(
        self, static: trimesh.Trimesh | None, *, body_mesh: BodyMesh | None = None, engine: str | None = None
    ) -> None:
        """Prepare the static world.

        Args:
            static: triangles in the world frame with `face_attributes["material"]`, asphalt where missing; None for
                bodies alone.
            body_mesh: meshes of actors; `sim.bodies.choice.body_mesh` when left out.

        Raises:
            DataError: not a mesh, no faces, NaN, or faces of unknown vertices or materials.
            SettingsError: unknown engine, or one that cannot run.
        """
        self.engine = open_engine(engine)
        self.bodies: Bodies = _NO_BODIES
        self._world = StaticWorld(*(_NO_MESH if static is None else mesh_arrays(static, "static world")))
        self._body_mesh = body_mesh
        self._solids: dict[tuple[str, tuple[float, ...]], Solid] = {}
        self._fleet: tuple[tuple[str, ...], NDArray[np.float64], tuple[Solid, ...]] = ((), np.zeros((0, 3)), ())

    def with_bodies(
        self, now: Actors, before: Actors | None = None, after: Actors | None = None, reach_s: float = 0.05
    ) -> "RayScene":
        """Return the scene with the actors of one instant; it shares everything that was built.

        Args:
            now: the actors at the reference time of the sweeps.
            before: the actors at least half a sweep earlier; left out: extrapolated at constant velocity.
            after: the actors at least half a sweep later; likewise.
            reach_s: half the longest sweep, s; longer sweeps are refused.

        Raises:
            DataError: ids not in ascending order.
            SettingsError: `reach_s` is not positive.
        """
        if reach_s <= 0.0:
            raise SettingsError(complaint("bodies", "reach_s", "a positive time", reach_s))
        if (np.diff(now.boxes.object_id) <= 0).any():
            raise DataError(complaint("bodies", "object_id", "ids in ascending order", now.boxes.object_id.tolist()))
        scene = object.__new__(RayScene)
        scene.__dict__.update(self.__dict__)
        scene.bodies = Bodies(
            object_id=now.boxes.object_id,
            size=now.boxes.size,
            solids=self._solids_of(now),
            path=actor_paths(now, before, after, reach_s),
            span_s=(now.time_s - reach_s, now.time_s + reach_s),
        )
        return scene

    def sweep(self, requests: Sequence[SweepRequest], threads: int = 1) -> list[Returns]:
        """Return the sweeps of one instant, in order; see `sensors.raycast.Engine`.

        Raises:
            SettingsError: a sweep lasts longer than the known motion of the bodies, see `with_bodies`.
        """
        for request in requests:
            self._check_time(request)
        made: dict[int, Returns] = {}
        for rows in together(np.array([request.pose[:2, 3] for request in requests]).reshape(-1, 2)):
            some = [requests[row] for row in rows]
            reach = max(float(request.beams.reach[:, 1].max()) for request in some)
            places = np.concatenate([request.knots[:, :2, 3] for request in some])
            returns = self.engine.sweep(self._world.around(places, reach), self.bodies, some, threads)
            made |= dict(zip(rows.tolist(), returns, strict=True))
        return [made[row] for row in range(len(requests))]

    def around(self, request: SweepRequest) -> Solid:
        """Return the static world within reach of one sweep, in a frame at its `origin`."""
        return self._world.around(request.knots[:, :2, 3], float(request.beams.reach[:, 1].max()))

    def cast(self, origins: NDArray[np.float64], directions: NDArray[np.float64], reach_m: float) -> Hits:
        """Cast single rays of (N, 3) origins and unit directions in the world frame against the static world.

        `Hits.face` counts the triangles around the ray's origin, in a world of tiles not those of the mesh.
        """
        origins = np.asarray(origins, np.float64).reshape(-1, 3)
        rays = np.asarray(directions, np.float32).reshape(-1, 3)
        reach = np.full(len(origins), reach_m, np.float32)
        hits = Hits(reach.copy(), np.full(len(origins), -1, np.int32), np.zeros(len(origins), np.float32))
        for rows in together(origins[:, :2]):
            solid = self._world.around(origins[rows, :2], reach_m)
            some = self.engine.cast(solid, (origins[rows] - solid.origin).astype(np.float32), rays[rows], reach[rows])
            hits.distance[rows], hits.face[rows], hits.cosine[rows] = some.distance, some.face, some.cosine
        return hits

    def ground_height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N,) height of the lowest static surface at (N, 2) places in the world; 0 where missing."""
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        bottom, top = self._world.height
        # From below the first surface is the lowest one, whatever trees and roofs stand above it.
        low = np.column_stack([xy, np.full(len(xy), bottom - 1.0)])
        hits = self.cast(low, np.tile([0.0, 0.0, 1.0], (len(xy), 1)), top - bottom + 2.0)
        return np.where(hits.face >= 0, hits.distance + bottom - 1.0, 0.0)

    def _check_time(self, request: SweepRequest) -> None:
        half = 0.5 * request.spec.period_s if request.spec.rolling_shutter else 0.0
        start, end = self.bodies.span_s
        if len(self.bodies) and (request.time_s - half < start - 1e-6 or request.time_s + half > end + 1e-6):
            expected = f"within the {start:g} to {end:g} s over which bodies move (with_bodies, reach_s)"
            found = f"{request.time_s - half:g} to {request.time_s + half:g} s"
            raise SettingsError(complaint(f"sweep of '{request.spec.name}'", "time", expected, found))

    def _solids_of(self, actors: Actors) -> tuple[Solid, ...]:
        """Return the solid of each actor, cached while the actors stay the same."""
        model, size, solids = self._fleet
        if actors.model != model or not np.array_equal(actors.boxes.size, size):
            sizes = actors.boxes.size.round(3).tolist()
            solids = tuple(self._body(name, tuple(lwh)) for name, lwh in zip(actors.model, sizes, strict=True))
            self._fleet = actors.model, actors.boxes.size, solids
        return solids

    def _body(self, model: str, size: tuple[float, ...]) -> Solid:
        key = (model, size)
        if key not in self._solids:
            if self._body_mesh is None:
                from sim.bodies.choice import body_mesh

                self._body_mesh = body_mesh
            if len(self._solids) >= _BODIES_KEPT:
                self._solids.pop(next(iter(self._solids)))
            mesh = self._body_mesh(model, (size[0], size[1], size[2]))
            vertices, faces, material = mesh_arrays(mesh, f"body '{model}'")
            self._solids[key] = Solid(vertices.astype(np.float32), faces, material)
        return self._solids[key]


def mesh_arrays(mesh: trimesh.Trimesh, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.uint8]]:
    """Return (V, 3) vertices, (F, 3) faces and (F,) materials of a mesh, asphalt where missing.

    Raises:
        DataError: not a mesh, such as the scene that trimesh makes of a GLB file; no faces; NaN or infinity; faces of
            unknown vertices or materials.
    """
    if not isinstance(mesh, trimesh.Trimesh):
        raise DataError(complaint(name, "mesh", "a trimesh.Trimesh", type(mesh).__name__))
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
    faces = np.asarray(mesh.faces).reshape(-1, 3)
    if len(faces) == 0:
        raise DataError(complaint(name, "faces", "at least one triangle", 0))
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        found = f"{vertices[bad[0]].tolist()} in row {bad[0]}"
        raise DataError(complaint(name, "vertices", "finite coordinates", found))
    if faces.min() < 0 or faces.max() >= len(vertices):
        found = f"{faces.min()} to {faces.max()}"
        raise DataError(complaint(name, "faces", f"rows of the {len(vertices)} vertices", found))
    material = mesh.face_attributes.get("material")
    material = np.zeros(len(faces), np.uint8) if material is None else np.asarray(material)
    if material.shape != (len(faces),):
        raise DataError(complaint(name, "material", f"one for each of the {len(faces)} faces", material.shape))
    unknown = np.flatnonzero(~((material >= 0) & (material < len(MATERIALS))))
    if len(unknown):
        found = f"{material[unknown[0]]} of face {unknown[0]}"
        raise DataError(complaint(name, "material", f"an index below {len(MATERIALS)}", found))
    return vertices, faces.astype(np.int32), material.astype(np.uint8)
