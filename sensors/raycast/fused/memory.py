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
        point_pose, point_step: (B, 3, 4) float32 pose in the frame of the points at the start of a block, and its
            change until the next block.
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
    """

    axis: NDArray[np.float32]
    subray: NDArray[np.float32]
    lane: NDArray[np.float32]
    reach: NDArray[np.float32]
    point_pose: NDArray[np.float32]
    point_step: NDArray[np.float32]
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


class World(NamedTuple):
    """Solids that the rays are traced through: N bodies, each in its own frame, and the static world, the last.

    Attributes:
        intersect, arguments: addresses of Embree's packet function and its arguments.
        scene: (N + 1,) int64 handles.
        object_id: (N + 1,) int32.
        material: (G,) uint8 of the faces, one solid after another.
        offset: (N + 1,) int64 where the faces of each solid start.
    """

    intersect: int
    arguments: int
    scene: NDArray[np.int64]
    object_id: NDArray[np.int32]
    material: NDArray[np.uint8]
    offset: NDArray[np.int64]


class Scratch(NamedTuple):
    """Working memory of one thread: ray packets and the results of their rays.

    All 4-byte values lie in one array at places known at compile time: only then does the compiler know that rows do
    not overlap, and vectorises loops over lanes.

    Attributes:
        lanes: a tuple of `width` zeros: its length is part of the type, so that loops over lanes have a fixed length.
        room: (ROOM_WORDS,) float32, 64-byte aligned for Embree: 16 / width packets of (21, width), then rows of 16,
            one per sub-ray or echo: shares of the block at which columns fire, directions, distances (infinite where
            nothing was hit), cosines, powers, object ids, and for echoes measured ranges, intensities, x, y and z of
            points, and integer 1 for returns that are not lost. After a block is read, the first two rows of the hits
            hold the echoes to report.
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
