"""The public engine: embreex's own interface and numpy.

Each solid is one committed hierarchy in its own frame, built once. Bodies never move in it: the rays that may meet one
are brought into its frame, where it is when they fire, nearest body first. The static world comes last, with rays that
are as short as the bodies left them.
"""

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import islice, pairwise
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from sensors.beams import Beams
from sensors.noise import ACROSS, LOST_BEFORE, UP
from sensors.raycast.base import Bodies, Hits, Returns, Shot, Solid
from sensors.raycast.measure import Aim, Met, measure
from sensors.raycast.shutter import Motion, Shutter
from sensors.raycast.views import View, views_of
from sensors.sweep import STATIC

_CHUNK_RAYS = 65_536

Floats = NDArray[np.float32]
_T = TypeVar("_T")
_U = TypeVar("_U")


class PublicEngine:
    """See the module; implements `sensors.raycast.Engine`."""

    name = "public"

    def __init__(self, *, robust: bool = True) -> None:
        """Make an engine; with `robust` no ray leaks through the edge that two triangles share."""
        self._robust = robust
        self._building = threading.Lock()
        self._hierarchies: WeakKeyDictionary[Solid, _Hierarchy] = WeakKeyDictionary()

    def cast(self, solid: Solid, origins: Floats, directions: Floats, reach: Floats) -> Hits:
        """Cast single rays; see `sensors.raycast.Engine`."""
        distance = np.array(reach, np.float32)
        face, normal = self._hierarchy(solid).trace(origins.T, directions.T, distance)
        cosine = np.where(face >= 0, _cosine(normal, directions.T), np.float32(0.0))
        return Hits(distance=distance, face=face, cosine=cosine)

    def sweep(self, static: Solid, bodies: Bodies, shots: Sequence[Shot], threads: int) -> list[Returns]:
        """Make sweeps; see `sensors.raycast.Engine`."""
        ground = self._hierarchy(static)
        solids = [self._hierarchy(solid) for solid in bodies.solids]

        def plan(shot: Shot) -> _Plan:
            return _plan(shot, bodies, static.origin)

        def chunk(task: tuple[_Plan, slice]) -> Returns:
            return _sweep_rings(*task, ground, solids, bodies)

        with _Workers(threads) as workers:
            chunks = [_chunks(shot.beams) for shot in shots]
            tasks = (
                (plan, part) for plan, parts in zip(workers.map(plan, shots), chunks, strict=True) for part in parts
            )
            made = workers.map(chunk, tasks)
            return [_joined(list(islice(made, len(parts)))) for parts in chunks]

    def _hierarchy(self, solid: Solid) -> "_Hierarchy":
        with self._building:
            if solid not in self._hierarchies:
                self._hierarchies[solid] = _Hierarchy(solid, self._robust)
            return self._hierarchies[solid]


class _Workers:
    """A map over threads, or without any."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def __enter__(self) -> "_Workers":
        return self

    def __exit__(self, *exc: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, work: Callable[[_T], _U], things: Iterable[_T]) -> Iterator[_U]:
        return map(work, things) if self._pool is None else self._pool.map(work, things)


class _Hierarchy:
    """The committed scene of one solid.

    Attributes:
        material: (F + 1,) uint8; the last row is for rays that miss, whose face is -1.
    """

    def __init__(self, solid: Solid, robust: bool) -> None:
        self.material: NDArray[np.uint8] = np.append(solid.material, np.uint8(0))
        self._scene = EmbreeScene(robust=robust)
        if len(solid.faces):
            TriangleMesh(
                self._scene, np.ascontiguousarray(solid.vertices), np.ascontiguousarray(solid.faces, dtype=np.int32)
            )
        # The first ray commits the scene; cast one here so that later calls are safe from several threads.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32), np.ones(1, np.float32))

    def trace(self, origin: Floats, direction: Floats, distance: Floats) -> tuple[NDArray[np.int32], Floats]:
        """Cast rays of (3, N) origins and directions up to their (N,) distances, which hits shorten in place.

        Returns:
            (N,) face, -1 where missed, and (N, 3) normal, which is left over from the ray before where missed.
        """
        found = self._scene.run(origin.T, direction.T, distance, output=1)
        return found["primID"], found["Ng"]


def _cosine(normal: Floats, direction: Floats) -> Floats:
    """Return (N,) |cos| between (N, 3) normals of any length and (3, N) unit directions."""
    # Normals of rays that missed may be anything.
    with np.errstate(all="ignore"):
        normal = np.ascontiguousarray(normal.T)
        product = normal * direction
        cosine = product[0]
        cosine += product[1]
        cosine += product[2]
        normal *= normal
        length = normal[0]
        length += normal[1]
        length += normal[2]
        cosine /= np.sqrt(length, out=length)
        return np.fmin(np.abs(cosine, out=cosine), np.float32(1.0), out=cosine)


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """One sweep.

    Attributes:
        shot: what is asked.
        motion: the sensor's in the frame of the static solid.
        home: (3,) float64 the sensor's place in that frame at the reference time.
        views: of the bodies, nearest first.
        view_motion: the sensor's in the frames of the views' bodies.
    """

    shot: Shot
    motion: Motion
    home: NDArray[np.float64]
    views: list[View]
    view_motion: Motion


def _plan(shot: Shot, bodies: Bodies, origin: NDArray[np.float64]) -> _Plan:
    shutter = Shutter(shot, bodies.path.time_s)
    poses = shutter.sensor(shutter.border)
    poses[:, :, 3] -= origin
    motion = shutter.motion(poses, shutter.segment)
    return _Plan(shot, motion, shot.pose[:3, 3] - origin, *views_of(shot, shutter, bodies))


def _chunks(beams: Beams) -> list[slice]:
    """Return the rings in parts whose rays fit into the cache; the number of threads has no say."""
    rays = beams.rings * beams.columns * len(beams.subray)
    parts = min(beams.rings, -(-rays // _CHUNK_RAYS))
    border = np.linspace(0, beams.rings, parts + 1).round().astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(border)]


def _sweep_rings(
    plan: _Plan, rings: slice, ground: _Hierarchy, solids: Sequence[_Hierarchy], bodies: Bodies
) -> Returns:
    shot = plan.shot
    axes = _axes(shot, rings)
    pose = plan.motion.at(shot.beams.firing_share[rings])
    direction = _turned(pose, axes)
    met = _trace(plan, rings, axes, pose, direction, ground, solids, bodies.object_id)
    if len(shot.beams.subray) > 1 or shot.spec.angle_noise_deg > 0.0:
        direction = _turned(pose, shot.beams.axis[:, None, rings, : shot.beams.columns])
    place = (pose[:, 3] - plan.home[:, None, None]).astype(np.float32)
    return measure(met, Aim(direction.reshape(3, -1), place), shot, rings)


def _trace(
    plan: _Plan,
    rings: slice,
    axes: Floats,
    pose: Floats,
    direction: Floats,
    ground: _Hierarchy,
    solids: Sequence[_Hierarchy],
    object_id: NDArray[np.int64],
) -> Met:
    """Cast the rays of some rings."""
    shot, shape = plan.shot, axes.shape[1:]
    distance = np.zeros(shape, np.float32)
    distance[:] = shot.beams.reach[rings, 1, None]
    if shot.spec.dropoff_rate > 0.0:
        # What is lost before need not be cast: Embree leaves out rays that end before they start.
        number = shot.noise.grid(LOST_BEFORE, shape[2], rings)
        np.copysign(distance, number - np.float32(shot.spec.dropoff_rate), out=distance)
    touches = _trace_bodies(plan, rings, axes, distance, solids)

    face, normal = ground.trace(_origins(pose, shape), direction.reshape(3, -1), distance.reshape(-1))
    met = Met(
        hit=face >= 0,
        distance=distance.reshape(-1),
        cosine=_cosine(normal, direction.reshape(3, -1)),
        material=ground.material.take(face, mode="wrap"),
        object_id=np.full(len(face), STATIC, np.int32),
    )
    if touches:
        body, *parts = zip(*touches, strict=True)
        owner = np.repeat(object_id[list(body)], [len(ray) for ray in parts[0]])
        ray, normal, towards, material = (np.concatenate(part) for part in parts)
        # Of several bodies that a ray met the last is the nearest, and what numpy assigns last stays.
        first = np.flatnonzero(~met.hit[ray])
        ray = ray[first]
        met.cosine[ray] = _cosine(normal, towards.T)[first]
        met.material[ray] = material[first]
        met.object_id[ray] = owner[first]
        met.hit[ray] = True
    flat = (getattr(met, field.name).reshape(shape[0], -1) for field in fields(met))
    return Met(*flat)


_Touch = tuple[int, NDArray[np.intp], Floats, Floats, NDArray[np.uint8]]
"""A body and its h hits: numbers of the rays, normals (h, 3), directions (h, 3) in the body's frame and materials."""


def _trace_bodies(
    plan: _Plan, rings: slice, axes: Floats, distance: Floats, solids: Sequence[_Hierarchy]
) -> list[_Touch]:
    """Shorten the rays of some rings to the bodies that they meet, nearest body first."""
    number = np.arange(distance.size).reshape(distance.shape)
    share = plan.shot.beams.firing_share[rings]
    touches: list[_Touch] = []
    for view in plan.views:
        rows = slice(max(view.top - rings.start, 0), min(view.bottom, rings.stop) - rings.start)
        if rows.start >= rows.stop:
            continue
        reach = distance[:, rows, view.columns].copy()
        # Rays that have already met something nearer need no second look.
        if reach.max() <= view.near:
            continue
        pose = plan.view_motion.at(share[rows], view.span)
        direction = _turned(pose, axes[:, :, rows, view.columns]).reshape(3, -1)
        face, normal = solids[view.body].trace(_origins(pose, reach.shape), direction, reach.reshape(-1))
        hit = np.flatnonzero(face >= 0)
        if len(hit):
            ray = number[:, rows, view.columns].reshape(-1)[hit]
            distance.reshape(-1)[ray] = reach.reshape(-1)[hit]
            material = solids[view.body].material.take(face.take(hit))
            touches.append((view.body, ray, normal.take(hit, axis=0), direction.take(hit, axis=1).T, material))
    return touches


def _axes(shot: Shot, rings: slice) -> Floats:
    """Return (3, S, r, C) directions of the rays of some rings in the sensor frame."""
    beams = shot.beams
    axes = np.moveaxis(beams.subray[:, :, rings, : beams.columns], 1, 0)
    if shot.spec.angle_noise_deg == 0.0:
        return axes
    # Across along the horizon, up along the meridian.
    sigma = np.float32(np.radians(shot.spec.angle_noise_deg))
    across, up = (sigma * shot.noise.grid(row, beams.columns, rings) for row in (ACROSS, UP))
    x, y, z = axes
    level = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
    across, up = across / level, up / level
    tilted = np.stack([x - across * y - up * x * z, y + across * x - up * y * z, z + up * level * level])
    return tilted / np.sqrt((tilted * tilted).sum(axis=0))


def _turned(pose: Floats, axes: Floats) -> Floats:
    """Return (3, S, r, c) axes turned by (3, 4, 1 or r, c) poses."""
    return np.einsum("ij...,j...->i...", pose[:, :3, None], axes)


def _origins(pose: Floats, shape: tuple[int, ...]) -> Floats:
    """Return (3, N) places of (3, 4, 1 or r, c) poses, for rays of shape (S, r, c)."""
    origin = np.zeros((3, *shape), np.float32)
    origin[:] = pose[:, 3, None]
    return origin.reshape(3, -1)


def _joined(parts: Sequence[Returns]) -> Returns:
    if len(parts) == 1:
        return parts[0]
    return Returns(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Returns)))
