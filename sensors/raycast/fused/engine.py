"""Fused engine: Embree's widest coherent packets inside one compiled loop.

A hierarchy is built once per solid; per frame only the poses of instances change. The work of a frame is cut into
sweeps, the last ones into blocks of rings, which threads take in turn. Each block writes its own rows, so that the
number of threads changes no byte.
"""

import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from weakref import WeakKeyDictionary, WeakSet

import numpy as np
from numpy.typing import NDArray

from sensors.optics.beams import BLOCK, Beams
from sensors.raycast.base import Bodies, Hits, Returns, Solid, SweepRequest
from sensors.raycast.fused.bodies import BodyPaths, Calls, place_bodies, see_bodies
from sensors.raycast.fused.embree import Hierarchy, InstanceScene, library
from sensors.raycast.fused.kernel import ROOM_WORDS, cast_rays, close_gap, sweep_rings
from sensors.raycast.fused.memory import Scratch, Tables, World

_FREE_BIT = 31
"""Ray-mask bit of sensors that hide no body; each bit below hides one body from the sensor that it carries."""
_MOST_SEGMENTS = 16
_RETURNS = {"strongest": 0, "last": 1, "dual": 2}


@dataclass(frozen=True, slots=True, eq=False)
class _Fleet:
    """Hierarchies of all bodies, one per slot, with the materials of all faces in one table."""

    solids: tuple[Solid, ...]
    hierarchies: list[Hierarchy]
    material: NDArray[np.uint8]
    offset: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """State of the instance scene: bodies and their poses."""

    bodies: Bodies
    origin: NDArray[np.float64]
    hidden: tuple[int, ...]
    fleet: _Fleet
    pose: NDArray[np.float32]
    steps: NDArray[np.int64]

    def shows(self, bodies: Bodies, origin: NDArray[np.float64], hidden: tuple[int, ...]) -> bool:
        return self.bodies is bodies and self.hidden == hidden and bool((self.origin == origin).all())


class FusedEngine:
    """Implementation of `sensors.raycast.Engine`, see the module."""

    name = "fused"

    def __init__(self) -> None:
        """Load Embree; `EngineUnavailable` when embreex's wheel has no known version."""
        self._library = library()
        # One instance scene serves all callers of the process.
        self._lock = threading.Lock()
        _engines.add(self)
        self._hierarchies: WeakKeyDictionary[Solid, Hierarchy] = WeakKeyDictionary()
        self._moving = InstanceScene()
        self._placed: _Placed | None = None
        self._single = _scratch(self._library.width)
        address = self._library.address
        self._calls = Calls(
            set_steps=address("rtcSetGeometryTimeStepCount"),
            set_transform=address("rtcSetGeometryTransform"),
            set_mask=address("rtcSetGeometryMask"),
            commit_geometry=address("rtcCommitGeometry"),
            commit_scene=address("rtcCommitScene"),
        )

    def cast(
        self,
        solid: Solid,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        reach: NDArray[np.float32],
    ) -> Hits:
        """Cast single rays; see `sensors.raycast.Engine`."""
        return self.cast_each([solid], [len(reach)], origins, directions, reach)

    def cast_each(
        self,
        solids: Sequence[Solid],
        counts: Sequence[int],
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        reach: NDArray[np.float32],
    ) -> Hits:
        """Cast single rays at several solids; see `sensors.raycast.Engine`."""
        distance = np.array(reach, np.float32)
        hits = Hits(distance, np.full(len(distance), -1, np.int32), np.zeros(len(distance), np.float32))
        rays = (np.ascontiguousarray(rows, np.float32).reshape(-1, 3) for rows in (origins, directions))
        with self._lock:
            hierarchies = [self._hierarchy(solid) for solid in solids]
            if not hierarchies:
                return hits
            scenes = np.array([hierarchy.handle for hierarchy in hierarchies], np.int64)
            world = self._world(hierarchies[0], None)
            parts = scenes, np.array(counts, np.int64)
            cast_rays(world, self._single, *parts, *rays, distance, hits.face, hits.cosine)
        return hits

    def place(self, bodies: Bodies, origin: NDArray[np.float64], hidden: tuple[int, ...] = ()) -> None:
        """Move the instances to the bodies' poses relative to an origin; `sweep` calls it where needed.

        Args:
            origin: (3,) world frame.
            hidden: ids of bodies hidden from some sensor, at most 31.
        """
        placed = self._placed
        if placed is not None and placed.shows(bodies, origin, hidden):
            return
        fleet = self._fleet(bodies.solids)
        # Interrupted half-way, the scene is in no valid state.
        self._placed = None
        self._moving.show(fleet.hierarchies)
        path, count = bodies.path, len(bodies)
        steps, pose = np.zeros(count, np.int64), np.zeros((count, _MOST_SEGMENTS + 1, 3, 4), np.float32)
        place_bodies(
            self._calls,
            self._moving.handle,
            self._moving.geometry[:count],
            self._moving.steps[:count],
            np.array(hidden, np.int64),
            bodies.object_id,
            BodyPaths(np.array(bodies.span_s), path.time_s, path.xyz, path.angles, origin, bodies.size),
            steps,
            pose,
        )
        self._library.check()
        self._placed = _Placed(bodies, origin, hidden, fleet, pose, steps)

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        """Make sweeps; see `sensors.raycast.Engine`."""
        made: list[Returns] = []
        with self._lock:
            for group in _groups(requests):
                hidden = _hidden(group)
                self.place(bodies, static.origin, hidden)
                world = self._world(self._hierarchy(static), self._placed)
                jobs = [_SweepTask(request, static.origin, bodies, hidden) for request in group]
                _run(jobs, world, self._library.width, threads)
                made.extend(job.returns() for job in jobs)
        return made

    def _hierarchy(self, solid: Solid) -> Hierarchy:
        """Return the hierarchy of a solid, built at first use and kept as long as the solid."""
        known = self._hierarchies.get(solid)
        if known is None:
            known = self._hierarchies[solid] = Hierarchy(solid)
        return known

    def _fleet(self, solids: tuple[Solid, ...]) -> _Fleet:
        if self._placed is not None and self._placed.fleet.solids == solids:
            return self._placed.fleet
        hierarchies = [self._hierarchy(solid) for solid in solids]
        first = {id(hierarchy): hierarchy for hierarchy in hierarchies}
        sizes = np.cumsum([0, *(len(hierarchy.material) for hierarchy in first.values())])
        start = dict(zip(first, sizes.tolist(), strict=False))
        material = [hierarchy.material for hierarchy in first.values()]
        return _Fleet(
            solids=solids,
            hierarchies=hierarchies,
            material=np.concatenate(material) if material else np.zeros(1, np.uint8),
            offset=np.array([start[id(hierarchy)] for hierarchy in hierarchies], np.int64),
        )

    def _world(self, static: Hierarchy, placed: _Placed | None) -> World:
        moving = placed is not None and len(placed.bodies) > 0
        return World(
            intersect=self._library.intersect,
            arguments=self._library.arguments,
            static=static.handle,
            moving=self._moving.handle if moving else 0,
            static_material=static.material,
            body_material=placed.fleet.material if placed is not None else np.zeros(1, np.uint8),
            body_offset=placed.fleet.offset if placed is not None else np.zeros(0, np.int64),
            body_id=placed.bodies.object_id.astype(np.int32) if placed is not None else np.zeros(0, np.int32),
            body_size=placed.bodies.size if placed is not None else np.zeros((0, 3)),
            body_pose=placed.pose if placed is not None else np.zeros((0, 2, 3, 4), np.float32),
            body_steps=placed.steps if placed is not None else np.zeros(0, np.int64),
        )


class _SweepTask:
    """One sweep in progress: its tables and the rows of its points."""

    def __init__(
        self, request: SweepRequest, origin: NDArray[np.float64], bodies: Bodies, hidden: tuple[int, ...]
    ) -> None:
        self.beams = request.beams
        self.tables = _tables(request, origin, bodies.span_s, hidden)
        self.columns = _room(request)
        self.unseen = -1
        if request.hidden_id is not None and request.hidden_id in hidden:
            self.unseen = int(np.searchsorted(bodies.object_id, request.hidden_id))
        self._rows: dict[int, int] = {}

    def make(self, world: World, scratch: Scratch, first: int, last: int) -> None:
        """Write the points of rings `first` to `last` from the row on that they have when no point is missing."""
        start = first * self._rows_per_ring
        visible = np.ones((last - first, self.beams.blocks), np.bool_)
        if (fan := self.beams.fan) is not None and world.moving:
            visible[:] = False
            see_bodies(
                visible,
                fan.azimuth,
                fan.elevation[first:last],
                fan.spread,
                self.tables.ray_pose[self._moments],
                self.tables.clock[0] + self.tables.clock[1] * self._moments.astype(np.float32),
                self.unseen,
                world,
            )
        end = sweep_rings(self.tables, world, visible, scratch, self.columns, start, first, last)
        self._rows[start] = end

    def returns(self) -> Returns:
        """Close the gaps between the blocks of rings and return the points."""
        filled = 0
        for start, end in sorted(self._rows.items()):
            if start != filled:
                close_gap(self.columns, filled, start, end)
            filled += end - start
        return Returns(**{name: rows[:filled] for name, rows in self.columns._asdict().items()})

    @property
    def _rows_per_ring(self) -> int:
        return len(self.columns.ring) // self.beams.rings

    @property
    def _moments(self) -> NDArray[np.int64]:
        return np.array([0, self.beams.blocks // 2, self.beams.blocks - 1])


def _run(jobs: Sequence[_SweepTask], world: World, width: int, threads: int) -> None:
    """Run all sweeps: whole ones first, the last in parts so that all threads end together."""
    whole = max(len(jobs) - threads, 0) if threads > 1 else len(jobs)
    tasks = [(job, 0, job.beams.rings) for job in jobs[:whole]]
    for job in jobs[whole:]:
        edges = np.linspace(0, job.beams.rings, min(2 * threads, job.beams.rings) + 1).astype(int).tolist()
        tasks.extend((job, first, last) for first, last in pairwise(edges))
    if threads <= 1 or len(tasks) == 1:
        scratch = _scratch(width)
        for job, first, last in tasks:
            job.make(world, scratch, first, last)
        return
    waiting = iter(tasks)
    turn = threading.Lock()
    futures: list[Future[None]] = []

    def work() -> None:
        scratch = _scratch(width)
        while True:
            with turn:
                task = next(waiting, None)
            if task is None:
                return
            job, first, last = task
            job.make(world, scratch, first, last)

    try:
        for _ in range(threads):
            futures.append(_pool(threads).submit(work))
        for future in futures:
            future.result()
    finally:
        # An interrupt too must wait for the workers: the caller's lock guards the scene that they still read.
        waiting = iter(())
        _join(futures)


def _join(futures: Sequence[Future[None]]) -> None:
    """Wait until all are done, through repeated interrupts: the first one is raised already."""
    while True:
        try:
            wait(futures)
        except KeyboardInterrupt:
            continue
        return


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="lidar")


_engines: "WeakSet[FusedEngine]" = WeakSet()


def _after_fork() -> None:
    """Renew threads and locks in a forked child, which inherits locks but no threads."""
    _pool.cache_clear()
    for engine in _engines:
        engine._lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _tables(
    request: SweepRequest, origin: NDArray[np.float64], span_s: tuple[float, float], hidden: tuple[int, ...]
) -> Tables:
    spec, beams, optics = request.spec, request.beams, request.optics
    start, end = span_s
    first_s = request.time_s - 0.5 * beams.columns * spec.column_s
    clock = ((first_s - start) / (end - start), BLOCK * spec.column_s / (end - start))
    law = (
        1.0 / optics.reach_m,
        optics.gate_m,
        spec.range_noise_m,
        np.radians(spec.angle_noise_deg),
        1.0 / max(spec.dropoff_intensity_limit, 1e-9),
        spec.dropoff_zero_intensity,
        spec.dropoff_rate,
    )
    packed = _packed(beams)
    ray_pose, ray_step = _blocks(request.knots, origin)
    point_pose, point_step = _blocks(request.knots, request.pose[:3, 3], request.pose[:3, :3].T)
    bit = hidden.index(request.hidden_id) if request.hidden_id in hidden else _FREE_BIT
    return Tables(
        axis=packed.axis,
        subray=packed.subray,
        lane=packed.lane,
        reach=beams.reach,
        ray_pose=ray_pose,
        ray_step=ray_step,
        point_pose=point_pose,
        point_step=point_step,
        clock=np.array(clock, np.float32),
        power=optics.power.reshape(-1),
        need=optics.need,
        scale=optics.scale,
        of_material=optics.of_material,
        law=np.array(law, np.float32),
        returns=_RETURNS[spec.returns],
        start=request.noise.start.astype(np.uint64),
        normal=request.noise.normal,
        uniform=request.noise.uniform,
        share=beams.firing_share,
        column_s=np.float32(spec.column_s),
        columns=beams.columns,
        mask=1 << bit,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Packed:
    """Directions of a sweep's rays in packet order; see `kernel.Tables`."""

    axis: NDArray[np.float32]
    subray: NDArray[np.float32]
    lane: NDArray[np.float32]


_packed_beams: WeakKeyDictionary[Beams, _Packed] = WeakKeyDictionary()


def _packed(beams: Beams) -> _Packed:
    """Return the packed tables of beams, cached: spinning sensors reuse their beams."""
    known = _packed_beams.get(beams)
    if known is None:
        lane = (np.arange(BLOCK, dtype=np.float32) + beams.firing_share[:, None]) / np.float32(BLOCK)
        known = _packed_beams[beams] = _Packed(_by_block(beams.axis), _by_block(beams.subray), lane)
    return known


def _by_block(directions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn (..., 3, R, 16 B) into (..., R, B, 3, 16)."""
    *outer, axes, rings, columns = directions.shape
    split = directions.reshape(*outer, axes, rings, columns // BLOCK, BLOCK)
    return np.ascontiguousarray(np.moveaxis(split, -4, -2))


def _blocks(
    knots: NDArray[np.float64], origin: NDArray[np.float64], turn: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (B, 3, 4) poses at the starts of the blocks, in a frame at `origin`, and their change until the next."""
    placed = knots.copy()
    placed[:, :, 3] -= origin
    if turn is not None:
        placed = turn @ placed
    return placed[:-1].astype(np.float32), np.diff(placed, axis=0).astype(np.float32)


def _room(request: SweepRequest) -> Returns:
    """Return rows for all that a sweep can report: two per beam when both returns are reported, else one."""
    rows = request.beams.rings * request.beams.columns * (2 if request.spec.returns == "dual" else 1)
    # Zeroing the room would cost a tenth of the sweep; every row that is handed out is written before.
    room = np.empty  # noqa: TID251
    return Returns(
        points=room((rows, 3), np.float32),
        intensity=room(rows, np.float32),
        ring=room(rows, np.int16),
        column=room(rows, np.int32),
        time_offset=room(rows, np.float32),
        object_id=room(rows, np.int32),
        return_number=room(rows, np.uint8),
        material=room(rows, np.uint8),
        cosine=room(rows, np.float32),
    )


def _scratch(width: int) -> Scratch:
    # Embree reads packets and the row of valid rays with aligned instructions.
    owner = np.zeros(4 * (ROOM_WORDS + BLOCK) + 64, np.uint8)
    skip = -owner.ctypes.data % 64
    room = owner[skip : skip + 4 * ROOM_WORDS].view(np.float32)
    valid = owner[skip + 4 * ROOM_WORDS : skip + 4 * (ROOM_WORDS + BLOCK)].view(np.int32)
    valid[:] = -1
    return Scratch(
        lanes=(0,) * width,
        room=room,
        word=room.view(np.uint32),
        number=room.view(np.int32),
        address=room.ctypes.data,
        valid_address=valid.ctypes.data,
        material=np.zeros((8, BLOCK), np.uint8),
        owner=owner,
    )


def _groups(requests: Sequence[SweepRequest]) -> list[list[SweepRequest]]:
    """Split the requests into groups whose hidden bodies fit into the bits of a ray mask."""
    groups: list[list[SweepRequest]] = [[]]
    for request in requests:
        if len(_hidden([*groups[-1], request])) > _FREE_BIT:
            groups.append([])
        groups[-1].append(request)
    return groups


def _hidden(requests: Sequence[SweepRequest]) -> tuple[int, ...]:
    return tuple(sorted({request.hidden_id for request in requests if request.hidden_id is not None}))
