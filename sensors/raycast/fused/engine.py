"""Fused engine: Embree's widest coherent packets inside one compiled loop.

A hierarchy is built once per solid; per sweep only the sensor's poses in the frames of the bodies change. The work of a
frame is cut into sweeps, the last ones into blocks of rings, which threads take in turn. Each block writes its own
rows, so that the number of threads changes no byte.
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

from sensors.optics.beams import BLOCK, Beams, halo
from sensors.raycast.base import Bodies, Hits, Returns, Solid, SweepRequest
from sensors.raycast.fused.bodies import BodyPaths, View, sight_bodies
from sensors.raycast.fused.embree import Hierarchy, library
from sensors.raycast.fused.kernel import ROOM_WORDS, cast_rays, close_gap, sweep_rings
from sensors.raycast.fused.memory import Scratch, Tables, World
from sensors.sweep import STATIC

_RETURNS = {"strongest": 0, "last": 1, "dual": 2}


@dataclass(frozen=True, slots=True, eq=False)
class _Hierarchies:
    """Hierarchies of the bodies and the static world, with the materials of all faces in one table; see `World`."""

    solids: tuple[Solid, ...]
    kept: list[Hierarchy]
    scene: NDArray[np.int64]
    material: NDArray[np.uint8]
    offset: NDArray[np.int64]


class FusedEngine:
    """Implementation of `sensors.raycast.Engine`, see the module."""

    name = "fused"

    def __init__(self) -> None:
        """Load Embree; `EngineUnavailable` when embreex's wheel has no known version."""
        self._library = library()
        self._lock = threading.Lock()
        _engines.add(self)
        self._hierarchies: WeakKeyDictionary[Solid, Hierarchy] = WeakKeyDictionary()
        self._last = self._of(())
        self._single = _scratch(self._library.width)

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
            scenes = np.array([hierarchy.handle for hierarchy in hierarchies], np.int64)
            address, parts = (self._library.intersect, self._library.arguments), (scenes, np.array(counts, np.int64))
            cast_rays(*address, self._single, *parts, *rays, distance, hits.face, hits.cosine)
        return hits

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        """Make sweeps; see `sensors.raycast.Engine`."""
        with self._lock:
            if self._last.solids != (*bodies.solids, static):
                self._last = self._of((*bodies.solids, static))
            world = World(
                intersect=self._library.intersect,
                arguments=self._library.arguments,
                scene=self._last.scene,
                object_id=np.append(bodies.object_id, STATIC).astype(np.int32),
                material=self._last.material,
                offset=self._last.offset,
            )
            jobs = [_SweepTask(request, static.origin, bodies) for request in requests]
            _run(jobs, world, self._library.width, threads)
        return [job.returns() for job in jobs]

    def _hierarchy(self, solid: Solid) -> Hierarchy:
        """Return the hierarchy of a solid, built at first use and kept as long as the solid."""
        known = self._hierarchies.get(solid)
        if known is None:
            known = self._hierarchies[solid] = Hierarchy(solid)
        return known

    def _of(self, solids: tuple[Solid, ...]) -> _Hierarchies:
        hierarchies = [self._hierarchy(solid) for solid in solids]
        first = {id(hierarchy): hierarchy for hierarchy in hierarchies}
        sizes = np.cumsum([0, *(len(hierarchy.material) for hierarchy in first.values())])
        start = dict(zip(first, sizes.tolist(), strict=False))
        return _Hierarchies(
            solids=solids,
            kept=hierarchies,
            scene=np.array([hierarchy.handle for hierarchy in hierarchies], np.int64),
            material=np.concatenate([np.zeros(0, np.uint8), *(hierarchy.material for hierarchy in first.values())]),
            offset=np.array([start[id(hierarchy)] for hierarchy in hierarchies], np.int64),
        )


class _SweepTask:
    """One sweep in progress: its tables and the rows of its points."""

    def __init__(self, request: SweepRequest, origin: NDArray[np.float64], bodies: Bodies) -> None:
        self.beams = request.beams
        self.tables = _tables(request)
        self.columns = _room(request)
        path = bodies.path
        self._paths = BodyPaths(path.time_s, path.xyz, path.angles, bodies.size)
        self._view = _view(request, origin, bodies.object_id)
        self._rows: dict[int, int] = {}

    def make(self, world: World, scratch: Scratch, first: int, last: int) -> None:
        """Write the points of rings `first` to `last` from the row on that they have when no point is missing."""
        start = first * self._rows_per_ring
        sights = sight_bodies(self._paths, self._view)
        end = sweep_rings(self.tables, world, sights, scratch, self.columns, start, first, last)
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


def _view(request: SweepRequest, origin: NDArray[np.float64], object_id: NDArray[np.int64]) -> View:
    beams, column_s = request.beams, request.spec.column_s
    fan, nothing = beams.fan, np.zeros(0)
    hidden = np.flatnonzero(object_id == request.hidden_id).tolist()
    return View(
        knots=request.knots,
        origin=origin,
        first_s=float(request.time_s - 0.5 * beams.columns * column_s),
        block_s=float(BLOCK * column_s),
        azimuth=nothing if fan is None else fan.azimuth,
        elevation=np.zeros(beams.rings) if fan is None else fan.elevation,
        spread=0.0 if fan is None else fan.spread,
        cone=_cones(request) if fan is None else np.zeros((0, 4)),
        unseen=hidden[0] if hidden else -1,
    )


def _cones(request: SweepRequest) -> NDArray[np.float64]:
    """Return (B, 4) axis and half angle, rad, of the cone around the rays of each block."""
    rays = request.beams.axis.reshape(3, request.beams.rings, -1, BLOCK).astype(np.float64)
    axis = rays.mean(axis=(1, 3))
    axis /= np.maximum(np.linalg.norm(axis, axis=0), 1e-9)
    along = (rays * axis[:, None, :, None]).sum(axis=0).min(axis=(0, 2))
    return np.ascontiguousarray(np.column_stack([axis.T, np.arccos(np.clip(along, -1.0, 1.0)) + halo(request.spec)]))


def _tables(request: SweepRequest) -> Tables:
    spec, beams, optics = request.spec, request.beams, request.optics
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
    knots = request.knots.copy()
    knots[:, :, 3] -= request.pose[:3, 3]
    knots = request.pose[:3, :3].T @ knots
    return Tables(
        axis=packed.axis,
        subray=packed.subray,
        lane=packed.lane,
        reach=beams.reach,
        point_pose=knots[:-1].astype(np.float32),
        point_step=np.diff(knots, axis=0).astype(np.float32),
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
