"""Public engine: embreex's own interface and numpy, the portable fallback and the reference of the fused engine.

Each solid is one committed hierarchy in its own frame, built once. Bodies never move in it: the rays that pass through
the sphere around one are brought into its frame, where it is when they fire.
"""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from sensors.optics.beams import BLOCK
from sensors.optics.noise import ACROSS, LOST_BEFORE, UP
from sensors.raycast.base import Bodies, Hits, Returns, Solid, SweepRequest
from sensors.raycast.public.measure import RayHits, measure
from sensors.sweep import STATIC

_GROW_M = 0.05
"""Margin of the sphere around a body, m."""

Floats = NDArray[np.float32]


class PublicEngine:
    """Implementation of `sensors.raycast.Engine`, see the module."""

    name = "public"

    def __init__(self) -> None:
        """Make an engine."""
        self._building = threading.Lock()
        self._hierarchies: WeakKeyDictionary[Solid, _Hierarchy] = WeakKeyDictionary()

    def cast(self, solid: Solid, origins: Floats, directions: Floats, reach: Floats) -> Hits:
        """Cast single rays; see `sensors.raycast.Engine`."""
        distance = np.array(reach, np.float32)
        face, normal = self._hierarchy(solid).trace(origins, directions, distance)
        return Hits(distance=distance, face=face, cosine=_cosine(normal, directions) * (face >= 0))

    def cast_each(
        self, solids: Sequence[Solid], counts: Sequence[int], origins: Floats, directions: Floats, reach: Floats
    ) -> Hits:
        """Cast single rays at several solids; see `sensors.raycast.Engine`."""
        parts = [slice(start, end) for start, end in pairwise(np.cumsum([0, *counts]).tolist())]
        hits = [Hits(np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32))]
        hits += [self.cast(s, origins[p], directions[p], reach[p]) for s, p in zip(solids, parts, strict=True)]
        return Hits(
            *(np.concatenate([getattr(part, name) for part in hits]) for name in ("distance", "face", "cosine"))
        )

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        """Make sweeps, one per thread at a time; see `sensors.raycast.Engine`."""
        with ThreadPoolExecutor(max(threads, 1)) as pool:
            return list(pool.map(partial(self._sweep, static, bodies), requests))

    def _sweep(self, static: Solid, bodies: Bodies, request: SweepRequest) -> Returns:
        """Return the points of one sweep: S sub-rays for each of n = R C beams, ring by ring."""
        beams, n = request.beams, request.beams.rings * request.beams.columns
        ring, column = np.divmod(np.arange(n), beams.columns)
        pose = _sensor_poses(request, column + beams.firing_share[ring].astype(np.float64))
        place = pose[:, :, 3]
        direction = np.einsum("nij,sjn->sni", pose[:, :, :3], _ray_axes(request)).astype(np.float32)
        hits = RayHits.none(len(direction), np.repeat(beams.reach[:, 1], beams.columns))

        rays = np.arange(direction.shape[0] * n)
        self._trace(hits, rays, static, STATIC, place - static.origin, direction.reshape(-1, 3))
        time_s = request.time_s + request.spec.time_offset.ravel()
        for row, object_id in enumerate(bodies.object_id.tolist()):
            if object_id == request.hidden_id:
                continue
            rays = _rays_towards(bodies, row, place, direction, hits.distance)
            beam = rays % n
            world_from_body = bodies.path[row].at(time_s[beam])
            rotation = world_from_body[:, :3, :3]
            origin = np.einsum("kji,kj->ki", rotation, place[beam] - world_from_body[:, :3, 3])
            towards = np.einsum("kji,kj->ki", rotation, direction.reshape(-1, 3)[rays])
            self._trace(hits, rays, bodies.solids[row], object_id, origin, towards)

        number = request.noise.grid(LOST_BEFORE, beams.columns).ravel()
        hits.hit[:, number < np.float32(request.spec.dropoff_rate)] = False
        axis = np.einsum("nij,jn->in", pose[:, :, :3], beams.axis[:, :, : beams.columns].reshape(3, n))
        return measure(hits, axis, place.T - request.pose[:3, 3, None], request)

    def _trace(
        self,
        hits: RayHits,
        rays: NDArray[np.int64],
        solid: Solid,
        object_id: int,
        origin: NDArray[np.floating],
        direction: NDArray[np.floating],
    ) -> None:
        """Cast K rays at a solid, as short as what they have hit before, and enter what is nearer.

        Args:
            rays: (K,) flat rows in `hits`.
            origin: (K, 3) in the solid's frame, or (n, 3) repeated for each sub-ray.
            direction: (K, 3) in the solid's frame.
        """
        if len(rays) == 0:
            return
        start = np.tile(origin.astype(np.float32), (len(rays) // len(origin), 1))
        towards = np.ascontiguousarray(direction, np.float32)
        hierarchy, distance = self._hierarchy(solid), hits.distance.reshape(-1)[rays]
        face, normal = hierarchy.trace(start, towards, distance)
        found = np.flatnonzero(face >= 0)
        row = rays[found]
        hits.hit.reshape(-1)[row] = True
        hits.distance.reshape(-1)[row] = distance[found]
        hits.cosine.reshape(-1)[row] = _cosine(normal[found], towards[found])
        hits.material.reshape(-1)[row] = solid.material[face[found]]
        hits.object_id.reshape(-1)[row] = object_id

    def _hierarchy(self, solid: Solid) -> "_Hierarchy":
        with self._building:
            if solid not in self._hierarchies:
                self._hierarchies[solid] = _Hierarchy(solid)
            return self._hierarchies[solid]


class _Hierarchy:
    """The committed Embree scene of one solid."""

    def __init__(self, solid: Solid) -> None:
        # Robust: no ray leaks through the edge that two triangles share.
        self._scene = EmbreeScene(robust=True)
        if len(solid.faces):
            TriangleMesh(
                self._scene, np.ascontiguousarray(solid.vertices), np.ascontiguousarray(solid.faces, dtype=np.int32)
            )
        # The first ray commits the scene; cast one here so that later calls are safe from several threads.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32), np.ones(1, np.float32))

    def trace(self, origin: Floats, direction: Floats, distance: Floats) -> tuple[NDArray[np.int32], Floats]:
        """Cast rays of (N, 3) origins and directions up to their (N,) distances, which hits shorten in place.

        Returns:
            (N,) face, -1 where missed, and (N, 3) normal, undefined where missed.
        """
        found = self._scene.run(origin, direction, distance, output=1)
        return found["primID"], found["Ng"]


def _cosine(normal: Floats, direction: Floats) -> Floats:
    """Return (N,) |cos| between (N, 3) normals of any length and unit directions; finite for any normals."""
    with np.errstate(all="ignore"):
        along = np.abs(np.einsum("ni,ni->n", normal, direction)) / np.linalg.norm(normal, axis=1)
    return np.fmin(along, np.float32(1.0)).astype(np.float32)


def _sensor_poses(request: SweepRequest, column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3, 4) world_from_lidar at (N,) moments in columns since the start of the sweep."""
    block = np.minimum(column // BLOCK, len(request.knots) - 2).astype(np.int64)
    share = (column / BLOCK - block)[:, None, None]
    return request.knots[block] + share * (request.knots[block + 1] - request.knots[block])


def _ray_axes(request: SweepRequest) -> NDArray[np.float64]:
    """Return (S, 3, n) unit directions of the rays in the sensor frame, tilted by the angle noise."""
    beams, sigma = request.beams, np.radians(request.spec.angle_noise_deg)
    axes = beams.subray[..., : beams.columns].reshape(len(beams.subray), 3, -1).astype(np.float64)
    if sigma == 0.0:
        return axes
    # Across along the horizon, up along the meridian.
    across, up = (sigma * request.noise.grid(row, beams.columns).ravel() for row in (ACROSS, UP))
    x, y, z = np.moveaxis(axes, 1, 0)
    level = np.maximum(np.hypot(x, y), 1e-6)
    across, up = across / level, up / level
    tilted = np.stack([x - across * y - up * x * z, y + across * x - up * y * z, z + up * level * level], axis=1)
    return tilted / np.linalg.norm(tilted, axis=1, keepdims=True)


def _rays_towards(
    bodies: Bodies, row: int, place: NDArray[np.float64], direction: Floats, distance: Floats
) -> NDArray[np.int64]:
    """Return flat rows of the rays that pass through the sphere around a body's box and all its path.

    Args:
        place: (n, 3) origins of the beams, world frame.
        direction: (S, n, 3) of the rays.
        distance: (S, n) where they end, m.
    """
    length, width, height = bodies.size[row]
    knots = bodies.path.xyz[row]
    middle = 0.5 * (knots.min(axis=0) + knots.max(axis=0))
    # The sphere stands on the middle of the footprint, so that it holds the box however it leans.
    radius = np.sqrt(0.25 * (length**2 + width**2) + height**2) + np.linalg.norm(knots - middle, axis=1).max() + _GROW_M
    offset = (middle - place).astype(np.float32)
    along = np.einsum("sni,ni->sn", direction, offset)
    aside = np.einsum("ni,ni->n", offset, offset) - along**2
    return np.flatnonzero((aside <= radius**2) & (along >= -radius) & (along - radius <= distance))
