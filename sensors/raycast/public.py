"""The public engine: embreex's own interface and numpy.

Each solid is one committed hierarchy in its own frame, built once. Bodies never move in it: the rays that may meet one
are brought into its frame, where it is when they fire, nearest body first. The static world comes last, with rays that
are as short as the bodies left them.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from sensors.beams import BLOCK, Beams, halo
from sensors.motion import Path
from sensors.noise import ACROSS, LOST_BEFORE, UP
from sensors.raycast.base import Bodies, Hits, Returns, Shot, Solid
from sensors.raycast.measure import Met, measure
from sensors.sweep import STATIC
from sensors.windows import windows_of
from sim.geometry import invert, pose_matrix

_GROW_M = 0.05
_CHUNK_RAYS = 65_536
_CONE_MARGIN_RAD = np.radians(0.3)
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])

Floats = NDArray[np.float32]
Columns = slice | NDArray[np.int64]
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
        face, cosine = self._hierarchy(solid).trace(origins, directions, distance)
        return Hits(distance=distance, face=face, cosine=np.where(face >= 0, cosine, np.float32(0.0)))

    def sweep(self, static: Solid, bodies: Bodies, shots: Sequence[Shot], threads: int) -> list[Returns]:
        """Make sweeps; see `sensors.raycast.Engine`."""
        ground = self._hierarchy(static)
        solids = [self._hierarchy(solid) for solid in bodies.solids]

        def plan(shot: Shot) -> _Plan:
            return _plan(shot, bodies, static.origin)

        def chunk(task: tuple[_Plan, slice]) -> Returns:
            return _sweep_rings(*task, ground, solids, bodies)

        with _Workers(threads) as workers:
            plans = workers.map(plan, shots)
            chunks = [_chunks(shot.beams) for shot in shots]
            parts = iter(
                workers.map(chunk, [(plan, rings) for plan, rows in zip(plans, chunks, strict=True) for rings in rows])
            )
        return [_joined([next(parts) for _ in rows]) for rows in chunks]

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

    def map(self, work: Callable[[_T], _U], things: Iterable[_T]) -> list[_U]:
        return list(map(work, things) if self._pool is None else self._pool.map(work, things))


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

    def trace(self, origins: Floats, directions: Floats, distance: Floats) -> tuple[NDArray[np.int32], Floats]:
        """Cast (N, 3) rays up to their (N,) distances, which are shortened to what they hit.

        Returns:
            (N,) face, -1 where missed, and (N,) |cos| of the incidence, of any value where missed.
        """
        # Embree overwrites the reach of each ray that hits; normals of missed rays are left over from the ray before.
        found = self._scene.run(origins, directions, distance, output=1)
        normal, direction = found["Ng"].T, directions.T
        along = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
        squared = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
        np.maximum(squared, np.float32(1e-30), out=squared)
        cosine = np.abs(along) / np.sqrt(squared)
        return found["primID"], np.minimum(cosine, np.float32(1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Where a sensor is when the beams of C columns fire, in some frame.

    Attributes:
        start: (3, 4, C) float32 pose when share 0 of the column has passed.
        step: (3, 4, C) float32 its change over the column; None where all beams fire at `start`.
    """

    start: Floats
    step: Floats | None

    def at(self, share: Floats, columns: Columns = slice(None)) -> Floats:
        """Return (3, 4, 1 or r, c) poses of some columns when (r,) shares of them have passed."""
        start = self.start[:, :, None, columns]
        return start if self.step is None else start + share[:, None] * self.step[:, :, None, columns]


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """Rays that may meet a body.

    Attributes:
        body: its row.
        rings, columns: of the rays.
        near: it is at least so far away, m.
        motion: the sensor's, in the frame of the body, over those columns.
    """

    body: int
    rings: slice
    columns: Columns
    near: float
    motion: _Motion


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """One sweep: the sensor's motion in the frames of the static solid and of the points, and the bodies around it."""

    shot: Shot
    ray_motion: _Motion
    point_motion: _Motion
    patches: list[_Patch]


class _Clock:
    """The time of one sweep in columns since its start: firings, and moments between which poses run straight.

    Attributes:
        share: (R,) float32 when each beam fires within its column; a single 0 where that is part of the column's own
            time because all fire together.
        border: (K,) float64 moments in columns: borders of blocks and knots of the bodies' path.
        segment: (C,) index of the border before each column.
        fired: (C,) float64 how far each column is from that border to the next, at share 0.
        passed: (C,) float64 share of the way that one column makes.
    """

    def __init__(self, shot: Shot, path: Path) -> None:
        share, columns = shot.beams.firing_share, shot.beams.columns
        together = bool((share == share[0]).all())
        self._shot = shot
        self.share: Floats = np.zeros(1, np.float32) if together else share
        self.together = together
        knots = (path.time_s - shot.time_s) / shot.spec.column_s if shot.spec.column_s > 0.0 else np.zeros(0)
        knots = knots + 0.5 * columns
        inside = knots[(knots > 0.0) & (knots < columns)]
        blocks = np.arange(shot.beams.blocks + 1) * float(BLOCK)
        self.border: NDArray[np.float64] = np.union1d(blocks, inside)
        fired = np.arange(columns) + (float(share[0]) if together else 0.0)
        self.segment: NDArray[np.int64] = np.searchsorted(self.border, fired, "right") - 1
        length = np.diff(self.border)[self.segment]
        self.fired: NDArray[np.float64] = (fired - self.border[self.segment]) / length
        self.passed: NDArray[np.float64] = 1.0 / length

    def time_s(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the time of moments given in columns."""
        shot = self._shot
        return shot.time_s + (column - 0.5 * shot.beams.columns) * shot.spec.column_s

    def sensor(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (..., 3, 4) world_from_lidar at moments given in columns."""
        knots = self._shot.knots
        block = np.clip(column // BLOCK, 0, len(knots) - 2).astype(np.int64)
        share = (column / BLOCK - block)[..., None, None]
        return knots[block] + share * (knots[block + 1] - knots[block])

    def motion(self, poses: NDArray[np.float64], row: NDArray[np.int64], columns: Columns = slice(None)) -> _Motion:
        """Return the motion through poses at borders.

        Args:
            poses: (K, 3, 4).
            row: (c,) row of the border before each column.
            columns: which.
        """
        table = np.ascontiguousarray(poses.transpose(1, 2, 0), dtype=np.float32)
        start, change = table[:, :, row], np.diff(table)[:, :, row]
        fired, passed = (share[columns].astype(np.float32) for share in (self.fired, self.passed))
        return _Motion(start + fired * change, None if self.together else passed * change)


def _plan(shot: Shot, bodies: Bodies, origin: NDArray[np.float64]) -> _Plan:
    clock = _Clock(shot, bodies.path)
    poses = clock.sensor(clock.border)
    centred = poses.copy()
    centred[:, :, 3] -= origin
    points = invert(shot.pose)[:3, :3] @ poses
    points[:, :, 3] += invert(shot.pose)[:3, 3]
    return _Plan(
        shot=shot,
        ray_motion=clock.motion(centred, clock.segment),
        point_motion=clock.motion(points, clock.segment),
        patches=_patches(shot, clock, bodies) if len(bodies) else [],
    )


def _patches(shot: Shot, clock: _Clock, bodies: Bodies) -> list[_Patch]:
    """Return the rays that may meet a body, nearest first."""
    rows = _near(shot, clock, bodies)
    views = (_views_of_fan if shot.beams.fan is not None else _views_of_rosette)(shot, clock, bodies, rows)
    views.sort(key=lambda view: view[3])
    if not views:
        return []
    body = np.array([view[0] for view in views])
    # One table of poses at the borders around the columns of each view, one view after another.
    spans = [clock.segment[_ends(columns)] for _, _, columns, _ in views]
    first = np.array([span.min() for span in spans])
    count = np.array([span.max() for span in spans]) - first + 2
    offset = np.cumsum(count) - count
    view_of = np.repeat(np.arange(len(views)), count)
    border = clock.border[np.arange(len(view_of)) + (first - offset)[view_of]]
    poses = _body_from_lidar(clock, bodies, body[view_of], border)
    columns = [np.arange(c.start, c.stop) if isinstance(c, slice) else c for _, _, c, _ in views]
    row = [clock.segment[c] - f + o for c, f, o in zip(columns, first, offset, strict=True)]
    motion = clock.motion(poses, np.concatenate(row), np.concatenate(columns))
    ends = np.cumsum([len(c) for c in columns])
    return [
        _Patch(view[0], view[1], view[2], view[3], _part(motion, slice(end - len(c), end)))
        for view, c, end in zip(views, columns, ends, strict=True)
    ]


def _ends(columns: Columns) -> list[int]:
    return [columns.start, columns.stop - 1] if isinstance(columns, slice) else [columns[0], columns[-1]]


def _part(motion: _Motion, columns: slice) -> _Motion:
    return _Motion(motion.start[:, :, columns], None if motion.step is None else motion.step[:, :, columns])


def _near(shot: Shot, clock: _Clock, bodies: Bodies) -> NDArray[np.int64]:
    """Return the rows that may come within reach and are not hidden."""
    middle = clock.sensor(np.array(0.5 * shot.beams.columns))[:2, 3]
    half = 0.5 * np.linalg.norm(bodies.size[:, :2], axis=1)
    distance = np.linalg.norm(bodies.path.xyz[:, :, :2] - middle, axis=2).min(axis=1)
    # A quarter more than the reach covers any motion within the time of a path.
    seen = distance - half <= 1.25 * float(shot.beams.reach[:, 1].max())
    if shot.hidden_id is not None:
        seen &= bodies.object_id != shot.hidden_id
    return np.flatnonzero(seen)


_View = tuple[int, slice, Columns, float]
"""Row of the body, rings, columns, nearest distance."""


def _views_of_fan(shot: Shot, clock: _Clock, bodies: Bodies, rows: NDArray[np.int64]) -> list[_View]:
    fan = shot.beams.fan
    assert fan is not None
    azimuth = fan.azimuth[: shot.beams.columns]
    whole = windows_of(_corners(shot, clock, bodies, rows, np.array([[0.0, 0.5, 1.0]]) * len(azimuth)))
    of, first, after = whole.columns(azimuth, fan.spread)
    # Only these columns can see it; so it matters only where it is while they fire.
    moments = np.stack([first, 0.5 * (first + after), after], axis=1)
    tight = windows_of(_corners(shot, clock, bodies, rows[of], moments))
    top, bottom = tight.rings(fan.elevation, fan.spread)
    views: list[_View] = []
    again, start, end = tight.columns(azimuth, fan.spread)
    for view, c0, c1 in zip(again, np.maximum(start, first[again]), np.minimum(end, after[again]), strict=True):
        if c1 > c0 and bottom[view] > top[view]:
            rings = slice(int(top[view]), int(bottom[view]))
            views.append((int(rows[of[view]]), rings, slice(int(c0), int(c1)), float(tight.near[view])))
    return views


def _views_of_rosette(shot: Shot, clock: _Clock, bodies: Bodies, rows: NDArray[np.int64]) -> list[_View]:
    columns, rings = shot.beams.columns, slice(0, shot.beams.rings)
    corners = _corners(shot, clock, bodies, rows, np.array([[0.0, 0.5, 1.0]]) * columns)
    near = windows_of(corners).near
    direction = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    middle = direction.sum(axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    angle = np.arccos(np.clip(np.einsum("nki,ni->nk", direction, middle), -1.0, 1.0)).max(axis=1)
    angle += _CONE_MARGIN_RAD + halo(shot.spec)
    views: list[_View] = []
    for row, axis, half, distance in zip(rows, middle.astype(np.float32), angle, near, strict=True):
        seen = np.arange(columns)
        if half < 0.5 * np.pi and distance > 0.0:
            along = np.tensordot(axis, shot.beams.axis[:, :, :columns], axes=1)
            seen = np.flatnonzero((along >= np.float32(np.cos(half))).any(axis=0))
        if len(seen):
            views.append((int(row), rings, seen, float(distance)))
    return views


def _corners(
    shot: Shot, clock: _Clock, bodies: Bodies, rows: NDArray[np.int64], moments: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 8 K, 3) corners of N bodies' boxes in the sensor frame at (N or 1, K) moments in columns."""
    moments = np.broadcast_to(moments, (len(rows), moments.shape[1]))
    body_from_lidar = _body_from_lidar(clock, bodies, np.repeat(rows, moments.shape[1]), moments.reshape(-1))
    rotation, place = body_from_lidar[:, :, :3], body_from_lidar[:, :, 3]
    local = _CORNERS * (bodies.size[rows, None] + _GROW_M) - np.array([0.0, 0.0, 0.5 * _GROW_M])
    local = np.repeat(local, moments.shape[1], axis=0) - place[:, None]
    return (local @ rotation).reshape(len(rows), -1, 3)


def _body_from_lidar(
    clock: _Clock, bodies: Bodies, rows: NDArray[np.int64], column: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 3, 4) body_from_lidar of one body each at one moment each."""
    path, time_s = bodies.path, clock.time_s(column)
    knot = np.clip(np.searchsorted(path.time_s, time_s, side="right") - 1, 0, len(path.time_s) - 2)
    start, end = path.time_s[knot], path.time_s[knot + 1]
    share = np.clip((time_s - start) / (end - start), 0.0, 1.0)[:, None]
    xyz, angles = (
        (1.0 - share) * values[rows, knot] + share * values[rows, knot + 1] for values in (path.xyz, path.angles)
    )
    world_from_body = pose_matrix(xyz, angles[:, 0], angles[:, 1], angles[:, 2])
    sensor = clock.sensor(column)
    sensor[:, :, 3] -= xyz
    return np.swapaxes(world_from_body[:, :3, :3], 1, 2) @ sensor


def _chunks(beams: Beams) -> list[slice]:
    """Return the rings in parts whose rays fit into the cache; the number of threads has no say."""
    rays = beams.rings * beams.columns * len(beams.subray)
    parts = min(beams.rings, -(-rays // _CHUNK_RAYS))
    border = np.linspace(0, beams.rings, parts + 1).round().astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(border)]


def _sweep_rings(
    plan: _Plan, rings: slice, ground: _Hierarchy, solids: Sequence[_Hierarchy], bodies: Bodies
) -> Returns:
    met = _trace(plan, rings, ground, solids, bodies)
    shot = plan.shot
    pose = plan.point_motion.at(shot.beams.firing_share[rings])
    return measure(met, shot, rings, (pose[:, :3], pose[:, 3]))


def _trace(plan: _Plan, rings: slice, ground: _Hierarchy, solids: Sequence[_Hierarchy], bodies: Bodies) -> Met:
    """Cast the rays of some rings."""
    shot = plan.shot
    axes = _axes(shot, rings)
    share = shot.beams.firing_share[rings]
    shape = axes.shape[1:]
    distance = np.zeros(shape, np.float32)
    distance[:] = shot.beams.reach[rings, 1, None]
    if shot.spec.dropoff_rate > 0.0:
        # What is lost before need not be cast: Embree leaves out rays that end before they start.
        lost = shot.noise.grid(LOST_BEFORE, shape[2], rings) < np.float32(shot.spec.dropoff_rate)
        distance[:, lost] = -1.0
    met = Met(
        distance=distance,
        cosine=np.zeros(shape, np.float32),
        material=np.zeros(shape, np.uint8),
        object_id=np.full(shape, STATIC, np.int32),
        hit=np.zeros(shape, bool),
    )
    for patch in plan.patches:
        start, stop = max(patch.rings.start, rings.start), min(patch.rings.stop, rings.stop)
        if start < stop:
            rows = slice(start - rings.start, stop - rings.start)
            _trace_body(met, patch, rows, axes, share[rows], solids[patch.body], int(bodies.object_id[patch.body]))
    face, cosine = ground.trace(*_rays(plan.ray_motion.at(share), axes), distance.reshape(-1))
    nearer = (face >= 0).reshape(shape)
    np.copyto(met.cosine, cosine.reshape(shape), where=nearer)
    np.copyto(met.material, ground.material[face].reshape(shape), where=nearer)
    np.copyto(met.object_id, STATIC, where=nearer)
    met.hit[nearer] = True
    flat = [getattr(met, field.name).reshape(shape[0], -1) for field in fields(met)]
    return Met(*flat)


def _trace_body(
    met: Met, patch: _Patch, rows: slice, axes: Floats, share: Floats, solid: _Hierarchy, object_id: int
) -> None:
    """Cast some rays against one body, in its own frame at each firing, and keep what is nearer."""
    where = (slice(None), rows, patch.columns)
    reach = np.ascontiguousarray(met.distance[where])
    # Rays that have already met something nearer need no second look.
    if reach.max() <= patch.near:
        return
    axes = axes[:, :, rows, patch.columns]
    face, cosine = solid.trace(*_rays(patch.motion.at(share), axes), reach.reshape(-1))
    hit = (face >= 0).reshape(reach.shape)
    met.distance[where] = reach
    met.cosine[where] = np.where(hit, cosine.reshape(reach.shape), met.cosine[where])
    met.material[where] = np.where(hit, solid.material[face].reshape(reach.shape), met.material[where])
    met.object_id[where] = np.where(hit, np.int32(object_id), met.object_id[where])
    met.hit[where] |= hit


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


def _rays(pose: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Return (N, 3) origins and directions of rays, from (3, 4, 1 or r, c) poses and (3, S, r, c) axes."""
    direction = pose[:, 0, None] * axes[0]
    for j in (1, 2):
        direction += pose[:, j, None] * axes[j]
    origin = np.zeros_like(direction)
    origin[:] = pose[:, 3, None]
    return origin.reshape(3, -1).T, direction.reshape(3, -1).T


def _joined(parts: Sequence[Returns]) -> Returns:
    if len(parts) == 1:
        return parts[0]
    return Returns(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Returns)))
