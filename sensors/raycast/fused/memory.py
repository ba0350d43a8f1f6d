"""Memory of the fused engine's loops: inputs, scenes, output rows and the scratch of a thread.

Shapes: R rings, B blocks of 16 columns, S sub-rays, N bodies, T instants of their motion, M materials.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Tables(NamedTuple):
    """Inputs of the loop for one sweep; see `sensors.raycast.base.SweepRequest`.

    Attributes:
        axis: (R, B, 3, 16) float32 directions of the beams.
        subray: (S, R, B, 3, 16) float32 directions of the rays.
        lane: (R, 16) float32 firing time of each column of a block, as a share of the block.
        reach: (R, 2) float32.
        ray_pose, ray_step: (B, 3, 4) float32 pose in the static solid's frame at the start of a block, and its change
            until the next block.
        point_pose, point_step: the same in the frame of the points.
        clock: (2,) float32 body time at the start of the sweep and its change per block.
        power: (M * (COSINE_BINS + 1),) float32, need, scale: see `sensors.optics.reflectance.Optics`.
        of_material: intensity depends on the surface.
        law: (7,) float32: 1 / reach of the tables, echo gate, range noise, angle noise, 1 / intensity limit and
            zero-intensity chance of the drop-off, general drop-off.
        returns: 0 strongest, 1 last, 2 dual.
        start: (6, R) uint64 starts in the tables of random numbers.
        normal, uniform: those tables.
        share: (R,) float32 firing time of each beam, as a share of its column.
        column_s: float32 time from one column to the next, s.
        columns: C.
        mask: ray mask.
    """

    axis: NDArray[np.float32]
    subray: NDArray[np.float32]
    lane: NDArray[np.float32]
    reach: NDArray[np.float32]
    ray_pose: NDArray[np.float32]
    ray_step: NDArray[np.float32]
    point_pose: NDArray[np.float32]
    point_step: NDArray[np.float32]
    clock: NDArray[np.float32]
    power: NDArray[np.float32]
    need: NDArray[np.float32]
    scale: NDArray[np.float32]
    of_material: bool
    law: NDArray[np.float32]
    returns: int
    start: NDArray[np.uint64]
    normal: NDArray[np.float32]
    uniform: NDArray[np.float32]
    share: NDArray[np.float32]
    column_s: np.float32
    columns: int
    mask: int


class World(NamedTuple):
    """Scenes that the rays are traced through, with the materials and poses of their parts.

    Attributes:
        intersect, arguments: addresses of Embree's packet function and its arguments.
        static, moving: scene handles; `moving` is 0 without bodies.
        static_material: (F,) uint8.
        body_material: (G,) uint8 of all bodies' faces, one solid after another.
        body_offset: (N,) int64 where the faces of each slot's solid start.
        body_id: (N,) int32 object ids.
        body_size: (N, 3) float64 boxes that hold the bodies.
        body_pose: (N, T, 3, 4) float32 poses of each slot.
        body_steps: (N,) int64 number of instants of each slot, at most T.
    """

    intersect: int
    arguments: int
    static: int
    moving: int
    static_material: NDArray[np.uint8]
    body_material: NDArray[np.uint8]
    body_offset: NDArray[np.int64]
    body_id: NDArray[np.int32]
    body_size: NDArray[np.float64]
    body_pose: NDArray[np.float32]
    body_steps: NDArray[np.int64]


class Scratch(NamedTuple):
    """Working memory of one thread: ray packets and the results of their rays.

    All 4-byte values lie in one array at places known at compile time: only then does the compiler know that rows do
    not overlap, and vectorises loops over lanes.

    Attributes:
        lanes: a tuple of `width` zeros: its length is part of the type, so that loops over lanes have a fixed length.
        room: (ROOM_WORDS,) float32, 64-byte aligned for Embree: 16 / width packets of (21, width), then rows of 16,
            one per sub-ray or echo: shares of the block at which columns fire, directions, distances (infinite where
            nothing was hit), cosines, powers, object ids, and for echoes measured ranges, intensities, (16, 3) points,
            columns, and 1 for returns that are not lost. After a block is read, the first two rows of the hits hold the
            echoes to report.
        word, number: the same memory as uint32 and int32.
        address: of the memory.
        valid_address: of an aligned row of int32 of -1: all rays of a packet are cast.
        material: (8, 16) uint8 of sub-rays, then of echoes.
        owner: keeps the memory alive.
    """

    lanes: tuple[int, ...]
    room: NDArray[np.float32]
    word: NDArray[np.uint32]
    number: NDArray[np.int32]
    address: int
    valid_address: int
    material: NDArray[np.uint8]
    owner: NDArray[np.uint8]
