"""Kernel of the fused engine: one compiled loop that generates, traces, measures and packs the rays of a sweep.

Packets hold the rays of `width` columns of one ring. A packet stays in the first-level cache: it is filled, traced
through the moving bodies, then with its shortened reach through the static world, and read, before the next one.

Shapes: R rings, B blocks of 16 columns, S sub-rays, N bodies, T instants of their motion, M materials.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from sensors.compiled import compiled
from sensors.optics.beams import BLOCK
from sensors.optics.noise import ACROSS, LOST_AFTER, LOST_BEFORE, RANGE, SECOND_RANGE, UP
from sensors.optics.reflectance import COSINE_BINS, RANGE_BINS
from sensors.raycast.fused.embree import ANY_RAY, FORMAT_FLOAT3X4_ROW_MAJOR, INVALID, RAY_ROWS
from sensors.sweep import STATIC

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_loop = compiled(fastmath=_FAST)
_part = compiled(fastmath=_FAST, forceinline=True)
"""For the parts of a loop: passing dozens of arrays by value would cost more than the work itself."""
_word = compiled(fastmath=_FAST, inline="always")
"""For expressions: separate compilation for each mixture of integers would take longer than all else."""

_DIRECTION, _TIME, _REACH, _MASK = 4, 7, 8, 9
_NORMAL, _PRIMITIVE, _GEOMETRY, _INSTANCE = 12, 17, 18, 19
"""Rows of a packet; the ray's origin is row 0 and its nearest distance, always 0, row 3."""

_MOST_SUBRAYS = 8
_LAST, _DUAL = 1, 2
_LERP_ERROR_M = 2e-5
_NO_AXIS = (np.float32(0.0), np.float32(0.0), np.float32(0.0))

# Where the rows of 16 words of `Scratch.room` start, after the packets.
_LANE = RAY_ROWS * BLOCK
_AIM = _LANE + BLOCK
_DISTANCE = _AIM + 3 * BLOCK
_COSINE = _DISTANCE + _MOST_SUBRAYS * BLOCK
_POWER = _COSINE + _MOST_SUBRAYS * BLOCK
_OBJECT = _POWER + _MOST_SUBRAYS * BLOCK
_MEASURED = _OBJECT + _MOST_SUBRAYS * BLOCK
_INTENSITY = _MEASURED + 2 * BLOCK
_POINT = _INTENSITY + 2 * BLOCK
_COLUMN = _POINT + 2 * 3 * BLOCK
_SCALE = _COLUMN + BLOCK
_KEEP = _SCALE + BLOCK
_KEEP_AXES = _KEEP + 2 * BLOCK
_PLACE = _KEEP_AXES + 3 * BLOCK
_DRAW = _PLACE + 3 * BLOCK
_AXIS = _DRAW + 2 * BLOCK
ROOM_WORDS = _AXIS + 3 * BLOCK


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


class PointColumns(NamedTuple):
    """Output rows for the points of a sweep: two per beam when both returns are reported, else one."""

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    column: NDArray[np.int32]
    time_offset: NDArray[np.float32]
    object_id: NDArray[np.int32]
    return_number: NDArray[np.uint8]
    material: NDArray[np.uint8]
    cosine: NDArray[np.float32]


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


def _typed_call(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call the C function at an address with a tuple of integers or pointers; its result is dropped.

    numba's own ctypes support bakes addresses into the code, which then cannot be cached on disk.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = ir.IntType(64)
        count = len(signature.args[1])
        function = ir.FunctionType(ir.VoidType(), [word] * count)
        target = builder.inttoptr(values[0], function.as_pointer())
        builder.call(target, [builder.extract_value(values[1], i) for i in range(count)])
        return context.get_dummy_value()

    return types.void(types.int64, types.UniTuple(types.int64, len(arguments))), generate


call: Any = intrinsic(_typed_call)


def _typed_bits(typing_context: Any, address: Any) -> Any:
    """Return 16 bits: which of 16 words at an address are not zero."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row = ir.VectorType(ir.IntType(32), BLOCK)
        flags = builder.load(builder.inttoptr(values[0], row.as_pointer()), align=1)
        return builder.bitcast(builder.icmp_unsigned("!=", flags, ir.Constant(row, None)), ir.IntType(BLOCK))

    return types.uint16(types.int64), generate


bits_of: Any = intrinsic(_typed_bits)


def _typed_copy(typing_context: Any, source: Any, target: Any) -> Any:
    """Copy 16 words from one address to another, as one vector."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row = ir.VectorType(ir.IntType(32), BLOCK).as_pointer()
        lanes = builder.load(builder.inttoptr(values[0], row), align=4)
        builder.store(lanes, builder.inttoptr(values[1], row), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


copy_row: Any = intrinsic(_typed_copy)


def _typed_interleave(typing_context: Any, x: Any, y: Any, z: Any, target: Any) -> Any:
    """Write three rows of 16 words at three addresses as 16 triples to a fourth."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = ir.IntType(32)
        row = ir.VectorType(word, BLOCK)
        first, second, third = (
            builder.load(builder.inttoptr(value, row.as_pointer()), align=4) for value in values[:3]
        )
        pairs = builder.shuffle_vector(
            first, second, ir.Constant(ir.VectorType(word, 2 * BLOCK), list(range(2 * BLOCK)))
        )
        padded = builder.shuffle_vector(
            third, third, ir.Constant(ir.VectorType(word, 2 * BLOCK), list(range(2 * BLOCK)))
        )
        for part in range(3):
            places = [divmod(part * BLOCK + lane, 3) for lane in range(BLOCK)]
            order = [lane + axis * BLOCK for lane, axis in places]
            mixed = builder.shuffle_vector(pairs, padded, ir.Constant(row, order))
            address = builder.add(values[3], ir.Constant(ir.IntType(64), 4 * BLOCK * part))
            builder.store(mixed, builder.inttoptr(address, row.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64, types.int64), generate


interleave: Any = intrinsic(_typed_interleave)


def _typed_count(typing_context: Any, bits: Any) -> Any:
    """Return the number of set bits among 16."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.zext(builder.ctpop(values[0]), ir.IntType(64))

    return types.int64(types.uint16), generate


count: Any = intrinsic(_typed_count)


def _typed_squeeze(typing_context: Any, bits: Any, source: Any, target: Any, size: Any) -> Any:
    """Copy those of 16 values at an address whose bit is set, packed, to another address.

    LLVM's compress-store, which numba does not expose: with AVX-512 one instruction instead of sixteen branches.
    """
    word = ir.IntType(8 * size.literal_value)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row, chosen = ir.VectorType(word, BLOCK), ir.VectorType(ir.IntType(1), BLOCK)
        kind = ir.FunctionType(ir.VoidType(), [row, word.as_pointer(), chosen])
        name = f"llvm.masked.compressstore.v{BLOCK}i{word.width}"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        lanes = builder.load(builder.inttoptr(values[1], row.as_pointer()), align=1)
        target = builder.inttoptr(values[2], word.as_pointer())
        builder.call(function, [lanes, target, builder.bitcast(values[0], chosen)])
        return context.get_dummy_value()

    return types.void(types.uint16, types.int64, types.int64, size), generate


squeeze: Any = intrinsic(prefer_literal=True)(_typed_squeeze)


@_word
def _look_up(table: Any, place: Any) -> Any:
    """Return the value of a range table at a place in [0, 1], the last value beyond."""
    at = min(place, np.float32(1.0)) * np.float32(RANGE_BINS)
    low = min(np.uint32(np.int32(at)), np.uint32(RANGE_BINS - 1))
    value = table[low]
    return value + (at - np.float32(low)) * (table[low + np.uint32(1)] - value)


@_word
def _at(start: Any, row: Any, lane: Any) -> Any:
    """Return the place of a lane of a row; unsigned, because numba tests signed indices for negative ones."""
    return np.uint64(start) + np.uint64(row) * np.uint64(BLOCK) + np.uint64(lane)


@_word
def _in_packet(width: Any, part: Any, row: Any, lane: Any) -> Any:
    """Return the place of a lane of a row of a packet."""
    return (np.uint64(part) * np.uint64(RAY_ROWS) + np.uint64(row)) * np.uint64(width) + np.uint64(lane)


@_part
def _aim(tables: Any, scratch: Any, ring: Any, block: Any, subray: Any) -> None:
    """Point the rays of a block in the sensor frame, jitter included."""
    room = scratch.room
    place = ((subray * tables.subray.shape[1] + ring) * tables.subray.shape[2] + block) * 3
    for axis in range(3):
        source = tables.subray.ctypes.data + 4 * BLOCK * (place + axis)
        copy_row(source, scratch.address + 4 * (_AIM + BLOCK * axis))
    sigma = tables.law[3]
    if sigma > np.float32(0.0):
        across = tables.start[ACROSS, ring] + np.uint64(block * BLOCK)
        up = tables.start[UP, ring] + np.uint64(block * BLOCK)
        for lane in range(BLOCK):
            x, y, z = room[_at(_AIM, 0, lane)], room[_at(_AIM, 1, lane)], room[_at(_AIM, 2, lane)]
            level = max(np.sqrt(x * x + y * y), np.float32(1e-6))
            a = sigma * tables.normal[across + np.uint64(lane)] / level
            e = sigma * tables.normal[up + np.uint64(lane)] / level
            # Embree measures in units of the direction's length.
            unit = np.float32(1.0) / np.sqrt(np.float32(1.0) + (a * a + e * e) * level * level)
            room[_at(_AIM, 0, lane)] = (x - a * y - e * x * z) * unit
            room[_at(_AIM, 1, lane)] = (y + a * x - e * y * z) * unit
            room[_at(_AIM, 2, lane)] = (z + e * level * level) * unit


@_part
def _load(tables: Any, scratch: Any, ring: Any, block: Any, moving: Any) -> None:
    """Fill the packets with the aimed rays, from the sensor's place at each firing."""
    width = len(scratch.lanes)
    room, word = scratch.room, scratch.word
    for axis in range(3):
        m0, m1, m2, m3 = (
            tables.ray_pose[block, axis, 0],
            tables.ray_pose[block, axis, 1],
            tables.ray_pose[block, axis, 2],
            tables.ray_pose[block, axis, 3],
        )
        d0, d1, d2, d3 = (
            tables.ray_step[block, axis, 0],
            tables.ray_step[block, axis, 1],
            tables.ray_step[block, axis, 2],
            tables.ray_step[block, axis, 3],
        )
        for part in range(BLOCK // width):
            for lane in range(width):
                at = part * width + lane
                f = room[_at(_LANE, 0, at)]
                x, y, z = room[_at(_AIM, 0, at)], room[_at(_AIM, 1, at)], room[_at(_AIM, 2, at)]
                room[_in_packet(width, part, axis, lane)] = m3 + f * d3
                room[_in_packet(width, part, _DIRECTION + axis, lane)] = (
                    (m0 + f * d0) * x + (m1 + f * d1) * y + (m2 + f * d2) * z
                )
    reach = tables.reach[ring, 1]
    for part in range(BLOCK // width):
        for lane in range(width):
            room[_in_packet(width, part, _REACH, lane)] = reach
        for lane in range(width):
            word[_in_packet(width, part, _GEOMETRY, lane)] = np.uint32(INVALID)
            word[_in_packet(width, part, _INSTANCE, lane)] = np.uint32(INVALID)
    if moving:
        start, change = tables.clock[0] + tables.clock[1] * np.float32(block), tables.clock[1]
        for part in range(BLOCK // width):
            for lane in range(width):
                time = start + change * room[_at(_LANE, 0, part * width + lane)]
                room[_in_packet(width, part, _TIME, lane)] = min(max(time, np.float32(0.0)), np.float32(1.0))


@_part
def _trace(world: Any, scratch: Any, moving: Any) -> None:
    """Trace the packets: the bodies first, which shortens the rays for the static world."""
    width = len(scratch.lanes)
    for part in range(BLOCK // width):
        packet = scratch.address + part * RAY_ROWS * width * 4
        if moving:
            call(world.intersect, (scratch.valid_address, world.moving, packet, world.arguments))
        call(world.intersect, (scratch.valid_address, world.static, packet, world.arguments))


@_part
def _turn_of(world: Any, slot: Any, time: Any, axis: Any) -> Any:
    """Return one axis of a body in the static solid's frame at a time of the span."""
    pose = world.body_pose
    last = world.body_steps[slot] - 1
    at = time * np.float32(last)
    low = min(np.int64(at), last - 1)
    f = at - np.float32(low)
    return (
        pose[slot, low, 0, axis] + f * (pose[slot, low + 1, 0, axis] - pose[slot, low, 0, axis]),
        pose[slot, low, 1, axis] + f * (pose[slot, low + 1, 1, axis] - pose[slot, low, 1, axis]),
        pose[slot, low, 2, axis] + f * (pose[slot, low + 1, 2, axis] - pose[slot, low, 2, axis]),
    )


@_part
def _read(world: Any, tables: Any, scratch: Any, subray: Any) -> Any:
    """Read the hits of the packets; return the number of rays that hit."""
    width = len(scratch.lanes)
    room, word, number = scratch.room, scratch.word, scratch.number
    hits = np.int32(0)
    for part in range(BLOCK // width):
        for lane in range(width):
            nx = room[_in_packet(width, part, _NORMAL, lane)]
            ny = room[_in_packet(width, part, _NORMAL + 1, lane)]
            nz = room[_in_packet(width, part, _NORMAL + 2, lane)]
            along = (
                nx * room[_in_packet(width, part, _DIRECTION, lane)]
                + ny * room[_in_packet(width, part, _DIRECTION + 1, lane)]
                + nz * room[_in_packet(width, part, _DIRECTION + 2, lane)]
            )
            length = max(nx * nx + ny * ny + nz * nz, np.float32(1e-30))
            level = np.abs(along) / np.sqrt(length)
            room[_at(_COSINE, subray, part * width + lane)] = min(level, np.float32(1.0))
        for lane in range(width):
            # Embree's number for no geometry is NaN when read as float32; indices are not.
            geometry = room[_in_packet(width, part, _GEOMETRY, lane)]
            hit = geometry == geometry
            hits += np.int32(hit)
            reached = room[_in_packet(width, part, _REACH, lane)]
            room[_at(_DISTANCE, subray, part * width + lane)] = reached if hit else np.float32(np.inf)
        for lane in range(width):
            number[_at(_OBJECT, subray, part * width + lane)] = STATIC
    # Neighbouring rays meet the same body, which hardly turns while 16 columns fire.
    turned = np.uint64(INVALID)
    ahead, left, up = _NO_AXIS, _NO_AXIS, _NO_AXIS
    for part in range(BLOCK // width):
        for lane in range(width):
            at = part * width + lane
            if word[_in_packet(width, part, _GEOMETRY, lane)] == np.uint32(INVALID):
                continue
            face = np.uint64(word[_in_packet(width, part, _PRIMITIVE, lane)])
            slot = np.uint64(word[_in_packet(width, part, _INSTANCE, lane)])
            if slot == np.uint64(INVALID):
                material = world.static_material[face]
            else:
                number[_at(_OBJECT, subray, at)] = world.body_id[slot]
                material = world.body_material[np.uint64(world.body_offset[slot]) + face]
                if slot != turned:
                    turned = slot
                    time = room[_in_packet(width, part, _TIME, lane)]
                    ahead = _turn_of(world, slot, time, np.int64(0))
                    left = _turn_of(world, slot, time, np.int64(1))
                    up = _turn_of(world, slot, time, np.int64(2))
                # Embree gives the normal in the body's own frame.
                nx = room[_in_packet(width, part, _NORMAL, lane)]
                ny = room[_in_packet(width, part, _NORMAL + 1, lane)]
                nz = room[_in_packet(width, part, _NORMAL + 2, lane)]
                along = (
                    (nx * ahead[0] + ny * left[0] + nz * up[0]) * room[_in_packet(width, part, _DIRECTION, lane)]
                    + (nx * ahead[1] + ny * left[1] + nz * up[1]) * room[_in_packet(width, part, _DIRECTION + 1, lane)]
                    + (nx * ahead[2] + ny * left[2] + nz * up[2]) * room[_in_packet(width, part, _DIRECTION + 2, lane)]
                )
                length = max(nx * nx + ny * ny + nz * nz, np.float32(1e-30))
                room[_at(_COSINE, subray, at)] = min(np.abs(along) / np.sqrt(length), np.float32(1.0))
            scratch.material[subray, at] = material
            place = room[_at(_COSINE, subray, at)] * np.float32(COSINE_BINS)
            low = min(np.uint32(place), np.uint32(COSINE_BINS - 1))
            kind = np.uint64(material) * np.uint64(COSINE_BINS + 1) + np.uint64(low)
            weak, strong = tables.power[kind], tables.power[kind + np.uint64(1)]
            room[_at(_POWER, subray, at)] = weak + (place - np.float32(low)) * (strong - weak)
    return hits


@_part
def _detect(tables: Any, scratch: Any) -> None:
    """Make the one ray of each beam its echo, if it is strong enough."""
    room = scratch.room
    for lane in range(BLOCK):
        distance = room[_at(_DISTANCE, 0, lane)]
        if room[_at(_POWER, 0, lane)] < _look_up(tables.need, distance * tables.law[0]):
            room[_at(_DISTANCE, 0, lane)] = np.float32(np.inf)


@_loop
def _merge(tables: Any, scratch: Any, subrays: int, order: Any, margins: Any, found: Any) -> None:
    """Merge the sub-rays of each beam into echoes and choose those that are reported.

    Args:
        scratch: hits of the sub-rays; its echoes are written.
        order: (8,) int64 buffer.
        margins: (8,) float32 buffer.
        found: (8, 4) float32 buffer: distance, power, margin and strongest ray of each echo.
    """
    part = np.float32(1.0) / np.float32(subrays)
    room, number = scratch.room, scratch.number
    for lane in range(BLOCK):
        found[0, 3] = np.float32(0.0)
        hits = 0
        for subray in range(subrays):
            reached = room[_at(_DISTANCE, subray, lane)]
            if reached == np.float32(np.inf) or room[_at(_POWER, subray, lane)] == np.float32(0.0):
                continue
            margins[subray] = part * room[_at(_POWER, subray, lane)] / _look_up(tables.need, reached * tables.law[0])
            place = hits
            while place > 0 and room[_at(_DISTANCE, order[place - 1], lane)] > reached:
                order[place] = order[place - 1]
                place -= 1
            order[place] = subray
            hits += 1
        echoes = 0
        first = 0
        while first < hits:
            nearest = room[_at(_DISTANCE, order[first], lane)]
            best = order[first]
            margin = np.float32(0.0)
            power = np.float32(0.0)
            beyond = np.float32(0.0)
            after = first
            while after < hits:
                subray = order[after]
                if (
                    after > first
                    and room[_at(_DISTANCE, subray, lane)] - room[_at(_DISTANCE, order[after - 1], lane)]
                    > tables.law[1]
                ):
                    break
                margin += margins[subray]
                power += part * room[_at(_POWER, subray, lane)]
                beyond += margins[subray] * (room[_at(_DISTANCE, subray, lane)] - nearest)
                if margins[subray] > margins[best]:
                    best = subray
                after += 1
            if margin >= np.float32(1.0):
                found[echoes, 0] = nearest + beyond / margin
                found[echoes, 1] = power
                found[echoes, 2] = margin
                found[echoes, 3] = np.float32(best)
                echoes += 1
            first = after
        near = 0
        for index in range(1, echoes):
            if found[index, 2] > found[near, 2]:
                near = index
        far = -1
        if tables.returns == _LAST:
            near = echoes - 1
        elif tables.returns == _DUAL and echoes > 1:
            far = echoes - 1
            if far == near:
                far = 0
                for index in range(1, echoes - 1):
                    if found[index, 2] > found[far, 2]:
                        far = index
            near, far = min(near, far), max(near, far)
        near_ray, far_ray = np.int64(found[near, 3]), np.int64(found[max(far, 0), 3])
        hit = number[_at(_OBJECT, near_ray, lane)], scratch.material[near_ray, lane], room[_at(_COSINE, near_ray, lane)]
        other = number[_at(_OBJECT, far_ray, lane)], scratch.material[far_ray, lane], room[_at(_COSINE, far_ray, lane)]
        scratch.room[_at(_DISTANCE, 0, lane)] = found[near, 0] if echoes > 0 else np.float32(np.inf)
        scratch.room[_at(_DISTANCE, 1, lane)] = found[far, 0] if far >= 0 else np.float32(np.inf)
        room[_at(_POWER, 0, lane)], room[_at(_POWER, 1, lane)] = found[near, 1], found[max(far, 0), 1]
        number[_at(_OBJECT, 0, lane)], scratch.material[0, lane], room[_at(_COSINE, 0, lane)] = hit
        number[_at(_OBJECT, 1, lane)], scratch.material[1, lane], room[_at(_COSINE, 1, lane)] = other


@_part
def _locate(tables: Any, scratch: Any, ring: Any, block: Any, echo: Any, noise: Any) -> None:
    """Measure the echoes of a block and place their points in the frame of the sweep."""
    room = scratch.room
    start = np.int64(tables.start[noise, ring]) + block * BLOCK
    copy_row(tables.normal.ctypes.data + 4 * start, scratch.address + 4 * _DRAW)
    place = (ring * tables.axis.shape[1] + block) * 3
    for axis in range(3):
        source = tables.axis.ctypes.data + 4 * BLOCK * (place + axis)
        copy_row(source, scratch.address + 4 * (_AXIS + BLOCK * axis))
    sigma = tables.law[2]
    for lane in range(BLOCK):
        room[_at(_MEASURED, echo, lane)] = room[_at(_DISTANCE, echo, lane)] + sigma * room[_at(_DRAW, 0, lane)]
    for axis in range(3):
        m0, m1, m2, m3 = (
            tables.point_pose[block, axis, 0],
            tables.point_pose[block, axis, 1],
            tables.point_pose[block, axis, 2],
            tables.point_pose[block, axis, 3],
        )
        d0, d1, d2, d3 = (
            tables.point_step[block, axis, 0],
            tables.point_step[block, axis, 1],
            tables.point_step[block, axis, 2],
            tables.point_step[block, axis, 3],
        )
        for lane in range(BLOCK):
            f = room[_at(_LANE, 0, lane)]
            along = (
                (m0 + f * d0) * room[_at(_AXIS, 0, lane)]
                + (m1 + f * d1) * room[_at(_AXIS, 1, lane)]
                + (m2 + f * d2) * room[_at(_AXIS, 2, lane)]
            )
            room[_at(_PLACE, axis, lane)] = along * room[_at(_MEASURED, echo, lane)] + (m3 + f * d3)
    places = scratch.address + 4 * _PLACE
    interleave(places, places + 4 * BLOCK, places + 8 * BLOCK, scratch.address + 4 * (_POINT + 3 * BLOCK * echo))


@_part
def _keep_returns(tables: Any, scratch: Any, ring: Any, block: Any, echo: Any) -> None:
    """Compute the intensity of the echoes of a block and which returns are kept."""
    room = scratch.room
    before = np.int64(tables.start[LOST_BEFORE, ring]) + block * BLOCK
    after = np.int64(tables.start[LOST_AFTER, ring]) + block * BLOCK
    copy_row(tables.uniform.ctypes.data + 4 * before, scratch.address + 4 * _DRAW)
    copy_row(tables.uniform.ctypes.data + 4 * after, scratch.address + 4 * (_DRAW + BLOCK))
    plain = np.float32(0.0) if tables.of_material else np.float32(1.0)
    full = np.float32(1.0) - plain
    near, far = tables.reach[ring, 0], tables.reach[ring, 1]
    limit, most, dropoff = tables.law[4], tables.law[5], tables.law[6]
    for lane in range(BLOCK):
        place = room[_at(_DISTANCE, echo, lane)] * tables.law[0]
        room[_at(_SCALE, 0, lane)] = _look_up(tables.scale, place)
    for lane in range(BLOCK):
        power = full * room[_at(_POWER, echo, lane)] + plain
        room[_at(_INTENSITY, echo, lane)] = min(room[_at(_SCALE, 0, lane)] * power, np.float32(1.0))
    for lane in range(BLOCK):
        distance, measured = room[_at(_DISTANCE, echo, lane)], room[_at(_MEASURED, echo, lane)]
        chance = most * max(np.float32(1.0) - room[_at(_INTENSITY, echo, lane)] * limit, np.float32(0.0))
        kept = (
            (room[_at(_DRAW, 0, lane)] >= dropoff)
            & (room[_at(_DRAW, 1, lane)] >= chance)
            & (distance >= near)
            & (measured >= near)
            & (measured <= far)
        )
        room[_at(_KEEP, echo, lane)] = np.float32(1.0) if kept else np.float32(0.0)
    # The last block is padded with beams beyond the last column.
    for lane in range(min(BLOCK, tables.columns - block * BLOCK), BLOCK):
        room[_at(_KEEP, echo, lane)] = np.float32(0.0)


@_part
def _pack(scratch: Any, columns: Any, row: Any, block: Any) -> Any:
    """Write the kept returns of a block of beams with one return each; return the next free row."""
    first = np.int32(block * BLOCK)
    for lane in range(BLOCK):
        scratch.number[_at(_COLUMN, 0, lane)] = first + np.int32(lane)
    keep = scratch.address + 4 * _KEEP
    bits = bits_of(keep)
    interleave(keep, keep, keep, scratch.address + 4 * _KEEP_AXES)
    at = np.int64(row)
    squeeze(bits, scratch.address + 4 * _INTENSITY, columns.intensity.ctypes.data + 4 * at, 4)
    squeeze(bits, scratch.address + 4 * _COLUMN, columns.column.ctypes.data + 4 * at, 4)
    squeeze(bits, scratch.address + 4 * _OBJECT, columns.object_id.ctypes.data + 4 * at, 4)
    squeeze(bits, scratch.address + 4 * _COSINE, columns.cosine.ctypes.data + 4 * at, 4)
    squeeze(bits, scratch.material.ctypes.data, columns.material.ctypes.data + at, 1)
    target = columns.points.ctypes.data + 12 * at
    for third in range(3):
        kept = bits_of(scratch.address + 4 * (_KEEP_AXES + BLOCK * third))
        squeeze(kept, scratch.address + 4 * (_POINT + BLOCK * third), target, 4)
        target += 4 * count(kept)
    return row + np.uint64(count(bits))


@_loop
def _pack_pairs(scratch: Any, columns: Any, row: Any, block: int) -> Any:
    """Write the kept returns of a block of beams with up to two returns each; return the next free row."""
    room = scratch.room
    for lane in range(BLOCK):
        for echo in range(2):
            if room[_at(_KEEP, echo, lane)] > np.float32(0.0):
                for axis in range(3):
                    columns.points[row, axis] = room[_POINT + 3 * BLOCK * echo + 3 * lane + axis]
                columns.intensity[row] = room[_at(_INTENSITY, echo, lane)]
                columns.column[row] = block * BLOCK + lane
                columns.object_id[row] = scratch.number[_at(_OBJECT, echo, lane)]
                columns.return_number[row] = echo + 1
                columns.material[row] = scratch.material[echo, lane]
                columns.cosine[row] = room[_at(_COSINE, echo, lane)]
                row += np.uint64(1)
    return row


@_loop
def sweep_rings(
    tables: Any, world: Any, visible: Any, scratch: Any, columns: Any, start: int, first: int, last: int
) -> int:
    """Write the points of rings `first` to `last` (exclusive) from row `start` on; return the row after.

    Args:
        visible: (last - first, B) bool: whether the rays of a block may meet a body.
        columns: written.
        start: row of the first point.
    """
    row = np.uint64(start)
    subrays = tables.subray.shape[0]
    pairs = tables.returns == _DUAL and subrays > 1
    order, margins = np.zeros(_MOST_SUBRAYS, np.int64), np.zeros(_MOST_SUBRAYS, np.float32)
    found = np.zeros((_MOST_SUBRAYS, 4), np.float32)
    width = len(scratch.lanes)
    scratch.room[:] = np.float32(0.0)
    for part in range(BLOCK // width):
        for lane in range(width):
            scratch.word[_in_packet(width, part, _MASK, lane)] = np.uint32(tables.mask)
    for ring in range(first, last):
        begun = row
        for lane in range(BLOCK):
            scratch.room[_at(_LANE, 0, lane)] = tables.lane[ring, lane]
        for block in range(tables.ray_pose.shape[0]):
            moving = world.moving != 0 and visible[ring - first, block]
            if subrays == 1:
                # A branch of its own: the constant lets the compiler place every row.
                _aim(tables, scratch, ring, block, np.int64(0))
                _load(tables, scratch, ring, block, moving)
                _trace(world, scratch, moving)
                if _read(world, tables, scratch, np.int64(0)) == 0:
                    continue
                _detect(tables, scratch)
            else:
                for subray in range(subrays):
                    _aim(tables, scratch, ring, block, subray)
                    _load(tables, scratch, ring, block, moving)
                    _trace(world, scratch, moving)
                    _read(world, tables, scratch, subray)
                _merge(tables, scratch, subrays, order, margins, found)
            _locate(tables, scratch, ring, block, np.int64(0), np.int64(RANGE))
            _keep_returns(tables, scratch, ring, block, np.int64(0))
            if pairs:
                _locate(tables, scratch, ring, block, np.int64(1), np.int64(SECOND_RANGE))
                _keep_returns(tables, scratch, ring, block, np.int64(1))
                row = _pack_pairs(scratch, columns, row, block)
            else:
                row = _pack(scratch, columns, row, block)
        columns.ring[begun:row] = ring
        if not pairs:
            columns.return_number[begun:row] = 1
        early = np.float32(0.5) * np.float32(tables.columns) - tables.share[ring]
        for done in range(begun, row):
            columns.time_offset[done] = (np.float32(columns.column[done]) - early) * tables.column_s
    return int(row)


class Calls(NamedTuple):
    """Addresses of the Embree functions that move instances."""

    set_steps: int
    set_transform: int
    set_mask: int
    commit_geometry: int
    commit_scene: int


class BodyPaths(NamedTuple):
    """Paths of N bodies over a span.

    Attributes:
        span: (2,) float64 first and last instant, s.
        times: (K,) float64 instants of the path.
        xyz: (N, K, 3) float64 positions, m.
        angles: (N, K, 3) float64 yaw, pitch and roll, rad.
        origin: (3,) float64 of the scene.
        size: (N, 3) float64 length, width and height, m.
    """

    span: NDArray[np.float64]
    times: NDArray[np.float64]
    xyz: NDArray[np.float64]
    angles: NDArray[np.float64]
    origin: NDArray[np.float64]
    size: NDArray[np.float64]


@_part
def _segments(motion: Any, slot: Any, most: Any) -> Any:
    """Return the number of straight segments of a body's motion, a power of two.

    Embree interpolates matrices linearly between instants. A chord is off its arc by angle^2 / 8 of the radius,
    here half of the body's length, and off a bend in the middle of the span by a quarter of the change of velocity
    times the span.
    """
    times, xyz, angles = motion.times, motion.xyz, motion.angles
    span = motion.span[1] - motion.span[0]
    fastest, bend = 0.0, 0.0
    for knot in range(times.shape[0] - 1):
        interval = times[knot + 1] - times[knot]
        turn, change = 0.0, 0.0
        for axis in range(3):
            turn += np.abs(angles[slot, knot + 1, axis] - angles[slot, knot, axis])
            if knot > 0:
                speed = (xyz[slot, knot + 1, axis] - xyz[slot, knot, axis]) / interval
                before = (xyz[slot, knot, axis] - xyz[slot, knot - 1, axis]) / (times[knot] - times[knot - 1])
                change += np.abs(speed - before)
        fastest = max(fastest, turn / interval)
        bend = max(bend, 0.25 * change * span)
    needed = fastest * span * np.sqrt(0.5 * motion.size[slot, 0] / (8.0 * _LERP_ERROR_M))
    segments = 2 if bend > _LERP_ERROR_M else 1
    while segments < needed and segments < most:
        segments *= 2
    return segments


@_loop
def place_bodies(
    calls: Any, scene: int, geometry: Any, shown: Any, hidden: Any, object_id: Any, motion: Any, steps: Any, pose: Any
) -> None:
    """Move the instances of a scene and commit it.

    Args:
        calls: see `Calls`.
        geometry: (N,) int64 handles of the slots.
        shown: (N,) int64 number of instants of each slot before; written.
        hidden: (H,) int64 ids of the bodies that rays of mask bit 0, 1, ... do not see.
        object_id: (N,) int64.
        motion: see `BodyPaths`.
        steps: (N,) int64, written: instants of each slot, equally spaced over the span.
        pose: (N, T, 3, 4) float32, written: the poses at those instants.
    """
    span, times, xyz, angles = motion.span, motion.times, motion.xyz, motion.angles
    for slot in range(geometry.shape[0]):
        steps[slot] = _segments(motion, slot, pose.shape[1] - 1) + 1
        if shown[slot] != steps[slot]:
            shown[slot] = steps[slot]
            call(calls.set_steps, (geometry[slot], steps[slot]))
        mask = np.int64(ANY_RAY)
        for bit in range(hidden.shape[0]):
            if hidden[bit] == object_id[slot]:
                mask &= ~(np.int64(1) << bit)
        for instant in range(steps[slot]):
            time = span[0] + (span[1] - span[0]) * instant / (steps[slot] - 1)
            knot = 0
            while knot < times.shape[0] - 2 and times[knot + 1] <= time:
                knot += 1
            f = min(max((time - times[knot]) / (times[knot + 1] - times[knot]), 0.0), 1.0)
            a, b = angles[slot, knot], angles[slot, knot + 1]
            yaw, pitch, roll = a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2])
            cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
            matrix = pose[slot, instant]
            matrix[0, 0], matrix[0, 1], matrix[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
            matrix[1, 0], matrix[1, 1], matrix[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
            matrix[2, 0], matrix[2, 1], matrix[2, 2] = -sp, cp * sr, cp * cr
            for axis in range(3):
                start = xyz[slot, knot, axis]
                moved = start + f * (xyz[slot, knot + 1, axis] - start)
                matrix[axis, 3] = moved - motion.origin[axis]
            call(calls.set_transform, (geometry[slot], instant, FORMAT_FLOAT3X4_ROW_MAJOR, matrix.ctypes.data))
        call(calls.set_mask, (geometry[slot], mask))
        call(calls.commit_geometry, (geometry[slot],))
    call(calls.commit_scene, (scene,))


@_loop
def see_bodies(
    visible: Any, azimuth: Any, elevation: Any, spread: float, moments: Any, instants: Any, unseen: int, world: Any
) -> None:
    """Mark the packets that may meet a body.

    Args:
        visible: (R, B) bool, written.
        azimuth: (16 B,) float64 of the columns, ascending or descending, rad.
        elevation: (R,) float64 rad.
        spread: largest angle of a ray to its column's azimuth and its ring's elevation, rad.
        moments: (J, 3, 4) float32 poses of the sensor at some moments from the first to the last of the sweep.
        instants: (J,) float32 those moments in body time, 0 to 1.
        unseen: slot of the body hidden from the sensor, or -1.
    """
    rings, blocks = visible.shape
    size, pose, steps = world.body_size, world.body_pose, world.body_steps
    margin = spread + 0.004
    for slot in range(size.shape[0]):
        if slot == unseen:
            continue
        middle, left, right = 0.0, 0.0, 0.0
        bottom, top = np.inf, -np.inf
        near, far = np.inf, 0.0
        around = False
        for moment in range(moments.shape[0]):
            last = steps[slot] - 1
            at = min(max(np.float64(instants[moment]), 0.0), 1.0) * last
            step = min(np.int64(at), last - 1)
            f = at - step
            centre_x, centre_y = 0.0, 0.0
            for corner in range(9):
                # First the middle of the box, which gives the direction that its corners are measured by.
                index = corner - 1
                bx = 0.0 if corner == 0 else (size[slot, 0] * 0.5 + 0.05) * (1.0 if index & 1 else -1.0)
                by = 0.0 if corner == 0 else (size[slot, 1] * 0.5 + 0.05) * (1.0 if index & 2 else -1.0)
                bz = size[slot, 2] * 0.5 if corner == 0 else (size[slot, 2] + 0.05 if index & 4 else -0.05)
                x, y, z = _in_sensor(pose[slot, step], pose[slot, step + 1], f, moments[moment], bx, by, bz)
                if corner == 0:
                    centre_x, centre_y = x, y
                    bearing = np.arctan2(y, x)
                    if moment == 0:
                        middle = bearing
                    shift = _wrap(bearing - middle)
                    closest = np.inf
                    continue
                length = np.sqrt(centre_x * centre_x + centre_y * centre_y) + 1e-9
                ahead = (x * centre_x + y * centre_y) / length
                aside = (y * centre_x - x * centre_y) / length
                closest = min(closest, ahead)
                far = max(far, np.sqrt(x * x + y * y))
                bottom, top = min(bottom, z), max(top, z)
                angle = shift + np.arctan2(aside, ahead)
                left, right = max(left, angle), min(right, angle)
            # Between the moments the body may come a little nearer.
            near = min(near, 0.95 * closest - 0.3)
            around = around or near <= 0.0
        if around:
            near, left, right = 0.0, np.pi, -np.pi
        low = np.arctan2(bottom, near if bottom < 0.0 else far) - margin
        high = np.arctan2(top, near if top > 0.0 else far) + margin
        centre, half = middle + 0.5 * (left + right), 0.5 * (left - right) + margin
        for block in range(blocks):
            first, end = azimuth[block * BLOCK], azimuth[block * BLOCK + BLOCK - 1]
            if np.abs(_wrap(0.5 * (first + end) - centre)) > half + 0.5 * np.abs(end - first):
                continue
            for ring in range(rings):
                if low <= elevation[ring] <= high:
                    visible[ring, block] = True


@_loop
def _wrap(angle: float) -> float:
    return angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5)


@_loop
def _in_sensor(a: Any, b: Any, f: float, sensor: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of a body in the frame of a sensor; the body's pose runs from `a` to `b`."""
    wx = (a[0, 0] + f * (b[0, 0] - a[0, 0])) * x + (a[0, 1] + f * (b[0, 1] - a[0, 1])) * y
    wy = (a[1, 0] + f * (b[1, 0] - a[1, 0])) * x + (a[1, 1] + f * (b[1, 1] - a[1, 1])) * y
    wz = (a[2, 0] + f * (b[2, 0] - a[2, 0])) * x + (a[2, 1] + f * (b[2, 1] - a[2, 1])) * y
    wx += (a[0, 2] + f * (b[0, 2] - a[0, 2])) * z + a[0, 3] + f * (b[0, 3] - a[0, 3]) - sensor[0, 3]
    wy += (a[1, 2] + f * (b[1, 2] - a[1, 2])) * z + a[1, 3] + f * (b[1, 3] - a[1, 3]) - sensor[1, 3]
    wz += (a[2, 2] + f * (b[2, 2] - a[2, 2])) * z + a[2, 3] + f * (b[2, 3] - a[2, 3]) - sensor[2, 3]
    return (
        sensor[0, 0] * wx + sensor[1, 0] * wy + sensor[2, 0] * wz,
        sensor[0, 1] * wx + sensor[1, 1] * wy + sensor[2, 1] * wz,
        sensor[0, 2] * wx + sensor[1, 2] * wy + sensor[2, 2] * wz,
    )


@_loop
def close_gap(columns: Any, row: int, start: int, end: int) -> None:
    """Move the rows from `start` to `end` (exclusive) down to `row`."""
    shift = start - row
    for old in range(start, end):
        new = old - shift
        columns.points[new] = columns.points[old]
        columns.intensity[new] = columns.intensity[old]
        columns.ring[new] = columns.ring[old]
        columns.column[new] = columns.column[old]
        columns.time_offset[new] = columns.time_offset[old]
        columns.object_id[new] = columns.object_id[old]
        columns.return_number[new] = columns.return_number[old]
        columns.material[new] = columns.material[old]
        columns.cosine[new] = columns.cosine[old]


@_loop
def cast_rays(
    world: Any,
    scratch: Any,
    scenes: Any,
    counts: Any,
    origins: Any,
    directions: Any,
    distance: Any,
    face: Any,
    cosine: Any,
) -> None:
    """Cast (N, 3) single rays, the first `counts[0]` at `scenes[0]` and so on, and write their hits.

    A hit lies within the ray's `distance`, which it shortens.
    """
    width = len(scratch.lanes)
    room, word = scratch.room, scratch.word
    stop = 0
    for part in range(len(scenes)):
        start = stop
        stop = start + counts[part]
        for base in range(start, stop, width):
            for lane in range(width):
                # The last packet is padded with its last ray.
                at = min(base + lane, stop - 1)
                for axis in range(3):
                    room[_in_packet(width, 0, axis, lane)] = origins[at, axis]
                    room[_in_packet(width, 0, 4 + axis, lane)] = directions[at, axis]
                room[_in_packet(width, 0, 3, lane)] = np.float32(0.0)
                room[_in_packet(width, 0, 7, lane)] = np.float32(0.0)
                room[_in_packet(width, 0, 8, lane)] = distance[at]
                word[_in_packet(width, 0, 9, lane)] = np.uint32(INVALID)
                word[_in_packet(width, 0, 11, lane)] = 0
                word[_in_packet(width, 0, 18, lane)] = np.uint32(INVALID)
            call(world.intersect, (scratch.valid_address, scenes[part], scratch.address, world.arguments))
            for lane in range(min(width, stop - base)):
                if word[_in_packet(width, 0, 18, lane)] == np.uint32(INVALID):
                    continue
                at = base + lane
                nx, ny, nz = (
                    room[_in_packet(width, 0, 12, lane)],
                    room[_in_packet(width, 0, 13, lane)],
                    room[_in_packet(width, 0, 14, lane)],
                )
                along = (
                    nx * room[_in_packet(width, 0, 4, lane)]
                    + ny * room[_in_packet(width, 0, 5, lane)]
                    + nz * room[_in_packet(width, 0, 6, lane)]
                )
                length = np.sqrt(max(nx * nx + ny * ny + nz * nz, np.float32(1e-30)))
                distance[at] = room[_in_packet(width, 0, 8, lane)]
                face[at] = word[_in_packet(width, 0, 17, lane)]
                cosine[at] = min(np.abs(along) / length, np.float32(1.0))
