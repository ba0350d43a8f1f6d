"""The public engine: embreex's own interface and numpy.

Each solid is one committed hierarchy in its own frame, built once. Bodies never move in it: the rays that may meet one
are brought into its frame, where it is when they fire, nearest body first. Rays reach the static world as short as the
near bodies left them, and the far bodies as short as the static world left them.
"""

import threading
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import islice, pairwise
from operator import attrgetter
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from sensors.optics.beams import Beams
from sensors.optics.noise import ACROSS, LOST_BEFORE, UP
from sensors.raycast.base import Bodies, Hits, Returns, Shot, Solid
from sensors.raycast.public.measure import Aim, Met, measure
from sensors.raycast.public.shutter import Motion, Shutter, axes_of
from sensors.raycast.public.views import View, views_of
from sensors.sweep import STATIC

_BAND_RAYS = 65_536
"""Rays that are traced together: few enough for the cache and for threads to share a sweep, many for the same body."""

_NEAR_M = 20.0
"""Bodies nearer than this are traced before the static world, which shortens its rays, the others after it."""

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
        return Hits(distance=distance, face=face, cosine=_cosine(normal, directions.T) * (face >= 0))

    def cast_each(
        self, solids: Sequence[Solid], counts: Sequence[int], origins: Floats, directions: Floats, reach: Floats
    ) -> Hits:
        """Cast single rays at several solids; see `sensors.raycast.Engine`."""
        ends = np.cumsum([0, *counts])
        parts = [slice(start, end) for start, end in pairwise(ends.tolist())]
        nothing = Hits(np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32))
        made = [nothing]
        for solid, rows in zip(solids, parts, strict=True):
            made.append(self.cast(solid, origins[rows], directions[rows], reach[rows]))
        return Hits(
            *(np.concatenate([getattr(hits, name) for hits in made]) for name in ("distance", "face", "cosine"))
        )

    def sweep(self, static: Solid, bodies: Bodies, shots: Sequence[Shot], threads: int) -> list[Returns]:
        """Make sweeps; see `sensors.raycast.Engine`."""
        world = _World(self._hierarchy(static), [self._hierarchy(solid) for solid in bodies.solids], bodies.object_id)

        def plan(shot: Shot) -> _Plan:
            return _plan(shot, bodies, static.origin)

        def band(task: tuple[_Plan, slice]) -> Returns:
            return _measure_band(*task, world)

        with _Workers(threads) as workers:
            bands = [_bands(shot.beams) for shot in shots]
            tasks = (
                (plan, rings) for plan, rows in zip(workers.map(plan, shots), bands, strict=True) for rings in rows
            )
            made = workers.map(band, tasks)
            return [_joined(list(islice(made, len(rows)))) for rows in bands]

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
        material: (F + 1,) uint8; the last row, 0, is for rays that miss: their face is -1.
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
    """Return (N,) |cos| between (N, 3) normals of any length and (3, N) unit directions; finite for any normals."""
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
class _World:
    """The static world, and the N bodies with their ids."""

    static: _Hierarchy
    bodies: Sequence[_Hierarchy]
    object_id: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """One sweep.

    Attributes:
        shot: what is asked.
        axes: (3, S, R, 1 or C) of the rays, see `axes_of`.
        beam_axes: (3, 1, R, 1 or C) of the beams.
        motion: the sensor's in the frame of the static solid.
        home: (3,) float64 the sensor's place in that frame at the reference time.
        views: of the bodies, nearest first.
        view_motion: the sensor's in the frames of the views' bodies.
    """

    shot: Shot
    axes: Floats
    beam_axes: Floats
    motion: Motion
    home: NDArray[np.float64]
    views: list[View]
    view_motion: Motion


def _plan(shot: Shot, bodies: Bodies, origin: NDArray[np.float64]) -> _Plan:
    shutter = Shutter(shot, bodies.path.time_s)
    poses = shutter.sensor(shutter.border)
    poses[:, :, 3] -= origin
    motion = shutter.motion(poses, shutter.segment)
    return _Plan(shot, *axes_of(shot.beams), motion, shot.pose[:3, 3] - origin, *views_of(shot, shutter, bodies))


def _bands(beams: Beams) -> list[slice]:
    """Cut the rings into bands; the number of threads has no say."""
    bands = min(beams.rings, -(-beams.rings * beams.columns * len(beams.subray) // _BAND_RAYS))
    border = np.linspace(0, beams.rings, bands + 1).round().astype(int).tolist()
    return [slice(first, after) for first, after in pairwise(border)]


def _measure_band(plan: _Plan, rings: slice, world: _World) -> Returns:
    """Return the points of some rings."""
    shot, share = plan.shot, plan.shot.beams.firing_share[rings]
    axes = _tilted(plan.axes[:, :, rings], shot, rings)
    direction, place = plan.motion.directions(axes, share), plan.motion.places(share)
    met = _untraced(shot, rings)
    # Near bodies hide much of the world, which hides most of the far ones.
    far = bisect_left(plan.views, _NEAR_M, key=attrgetter("near"))
    _trace_bodies(met, plan, rings, plan.views[:far], axes, world)
    _trace_static(met, direction, place, world.static)
    _trace_bodies(met, plan, rings, plan.views[far:], axes, world)
    if len(shot.beams.subray) > 1 or shot.spec.angle_noise_deg > 0.0:
        direction = plan.motion.directions(plan.beam_axes[:, :, rings], share)
    aim = Aim(direction.reshape(3, -1), (place - plan.home[:, None, None]).astype(np.float32))
    return measure(met, aim, shot, rings)


def _untraced(shot: Shot, rings: slice) -> Met:
    """Return what the rays of some rings have met before they are cast: nothing within their reach."""
    shape = len(shot.beams.subray), (rings.stop - rings.start) * shot.beams.columns
    reach = np.repeat(shot.beams.reach[rings, 1], shot.beams.columns)
    if shot.spec.dropoff_rate > 0.0:
        # What is lost before need not be cast: Embree leaves out rays that end before they start.
        number = shot.noise.grid(LOST_BEFORE, shot.beams.columns, rings).reshape(-1)
        np.copysign(reach, number - np.float32(shot.spec.dropoff_rate), out=reach)
    return Met(
        hit=np.zeros(shape, bool),
        distance=np.tile(reach, (shape[0], 1)),
        cosine=np.zeros(shape, np.float32),
        material=np.zeros(shape, np.uint8),
        object_id=np.full(shape, STATIC, np.int32),
    )


def _trace_bodies(met: Met, plan: _Plan, rings: slice, views: Sequence[View], axes: Floats, world: _World) -> None:
    """Cast the rays of some rings at bodies, nearest body first.

    Args:
        met: what they have met, updated.
        plan: the sweep.
        rings: which.
        views: of the bodies.
        axes: of the rays, see `axes_of`.
        world: the bodies.
    """
    share, columns = plan.shot.beams.firing_share[rings], plan.shot.beams.columns
    distance = met.distance.reshape(len(met.distance), -1, columns)
    number = np.arange(distance.size).reshape(distance.shape)
    hits: list[_BodyHits] = []
    for view in views:
        rows = slice(max(view.top - rings.start, 0), min(view.bottom, rings.stop) - rings.start)
        if rows.start >= rows.stop:
            continue
        where = slice(None), rows, view.columns
        reach = distance[where].copy()
        # Rays that have already met something nearer need no second look.
        if reach.max() <= view.near:
            continue
        its_axes = axes[:, :, rows] if axes.shape[3] == 1 else axes[:, :, rows, view.columns]
        direction = plan.view_motion.directions(its_axes, share[rows], view.span).reshape(3, -1)
        origin = _spread(plan.view_motion.places(share[rows], view.span), reach.shape)
        solid = world.bodies[view.body]
        face, normal = solid.trace(origin, direction, reach.reshape(-1))
        hit = np.flatnonzero(face >= 0)
        if len(hit):
            distance[where] = reach
            ray, material = number[where].reshape(-1).take(hit), solid.material.take(face.take(hit))
            hits.append((view.body, ray, material, normal.take(hit, axis=0), direction.take(hit, axis=1)))
    if hits:
        _hit(met, hits, world.object_id)


_BodyHits = tuple[int, NDArray[np.intp], NDArray[np.uint8], Floats, Floats]
"""A body and its h hits: numbers of the rays, materials, normals (h, 3) and directions (3, h) in the body's frame."""


def _hit(met: Met, hits: Sequence[_BodyHits], object_id: NDArray[np.int64]) -> None:
    """Enter hits on bodies, nearer ones later: where a ray met several, what numpy assigns last stays."""
    body, *columns = zip(*hits, strict=True)
    ray = np.concatenate(columns[0])
    met.hit.reshape(-1)[ray] = True
    met.material.reshape(-1)[ray] = np.concatenate(columns[1])
    met.cosine.reshape(-1)[ray] = _cosine(np.concatenate(columns[2]), np.concatenate(columns[3], axis=1))
    met.object_id.reshape(-1)[ray] = np.repeat(object_id[list(body)], [len(rays) for rays in columns[0]])


def _trace_static(met: Met, direction: Floats, place: Floats, static: _Hierarchy) -> None:
    """Cast rays that have met near bodies at the static world too.

    Args:
        met: what they have met, updated.
        direction: (3, S, r, C).
        place: (3, 1 or r, C) where they start.
        static: the static world.
    """
    of_body, distance, cosine, material, object_id = (getattr(met, field.name).reshape(-1) for field in fields(met))
    shape, direction = direction.shape[1:], direction.reshape(3, -1)
    face, normal = static.trace(_spread(place, shape), direction, distance)
    hit = face >= 0
    # What hides a body takes its place; elsewhere one of the two met nothing and has only zeros.
    hidden = np.flatnonzero(hit & of_body)
    cosine[hidden], material[hidden], object_id[hidden] = 0.0, 0, STATIC
    cosine += _cosine(normal, direction) * hit
    material += static.material.take(face, mode="wrap")
    of_body |= hit


def _spread(place: Floats, shape: tuple[int, ...]) -> Floats:
    """Return (3, N) origins of rays of shape (S, r, c) from (3, 1 or r, c) places."""
    origin = np.zeros((3, *shape), np.float32)
    origin[:] = place[:, None]
    return origin.reshape(3, -1)


def _tilted(axes: Floats, shot: Shot, rings: slice) -> Floats:
    """Return the axes of the rays of some rings as they truly are, tilted at random."""
    if shot.spec.angle_noise_deg == 0.0:
        return axes
    # Across along the horizon, up along the meridian.
    sigma = np.float32(np.radians(shot.spec.angle_noise_deg))
    across, up = (sigma * shot.noise.grid(row, shot.beams.columns, rings) for row in (ACROSS, UP))
    x, y, z = axes
    level = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
    across, up = across / level, up / level
    tilted = np.stack([x - across * y - up * x * z, y + across * x - up * y * z, z + up * level * level])
    tilted /= np.sqrt((tilted * tilted).sum(axis=0))
    return tilted


def _joined(parts: Sequence[Returns]) -> Returns:
    if len(parts) == 1:
        return parts[0]
    return Returns(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Returns)))
