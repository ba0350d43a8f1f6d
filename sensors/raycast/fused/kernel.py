"""Kernel of the fused engine: one compiled loop that generates, traces, measures and packs the rays of a sweep.

Packets hold the rays of `width` columns of one ring. A packet stays in the first-level cache: it is filled, traced
through the moving bodies, then with its shortened reach through the static world, and read, before the next one.

Shapes: R rings, B blocks of 16 columns, S sub-rays, N bodies, T instants of their motion, M materials.
"""

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled
from sensors.optics.beams import BLOCK
from sensors.optics.noise import ACROSS, LOST_AFTER, LOST_BEFORE, RANGE, SECOND_RANGE, UP
from sensors.optics.reflectance import COSINE_BINS, RANGE_BINS
from sensors.raycast.base import Returns
from sensors.raycast.fused import words
from sensors.raycast.fused.embree import INVALID, RAY_ROWS
from sensors.raycast.fused.memory import Scratch, Tables, World
from sensors.raycast.fused.words import bits_of, call, copy_row, count, interleave, squeeze
from sensors.sweep import STATIC

Floats = NDArray[np.float32]
Turn = tuple[np.float32, np.float32, np.float32]

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_loop = compiled(words, fastmath=_FAST)
_part = compiled(words, fastmath=_FAST, forceinline=True)
"""For the parts of a loop: passing dozens of arrays by value would cost more than the work itself."""
_word = compiled(words, fastmath=_FAST, inline="always")
"""For expressions: separate compilation for each mixture of integers would take longer than all else."""

_DIRECTION, _TIME, _REACH, _MASK = 4, 7, 8, 9
_NORMAL, _PRIMITIVE, _GEOMETRY, _INSTANCE = 12, 17, 18, 19
"""Rows of a packet; the ray's origin is row 0 and its nearest distance, always 0, row 3."""

_MOST_SUBRAYS = 8
_LAST, _DUAL = 1, 2
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


@_word
def _look_up(table: Floats, place: np.float32) -> np.float32:
    """Return the value of a range table at a place in [0, 1], the last value beyond."""
    at = min(place, np.float32(1.0)) * np.float32(RANGE_BINS)
    low = min(np.uint32(np.int32(at)), np.uint32(RANGE_BINS - 1))
    value = table[low]
    return value + (at - np.float32(low)) * (table[low + np.uint32(1)] - value)


@_word
def _at(start: int, row: int, lane: int) -> np.uint64:
    """Return the place of a lane of a row; unsigned, because numba tests signed indices for negative ones."""
    return np.uint64(start) + np.uint64(row) * np.uint64(BLOCK) + np.uint64(lane)


@_word
def _in_packet(width: int, part: int, row: int, lane: int) -> np.uint64:
    """Return the place of a lane of a row of a packet."""
    return (np.uint64(part) * np.uint64(RAY_ROWS) + np.uint64(row)) * np.uint64(width) + np.uint64(lane)


@_part
def _aim(tables: Tables, scratch: Scratch, ring: int, block: int, subray: int) -> None:
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
def _load(tables: Tables, scratch: Scratch, ring: int, block: int, moving: bool) -> None:
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
def _trace(world: World, scratch: Scratch, moving: bool) -> None:
    """Trace the packets: the bodies first, which shortens the rays for the static world."""
    width = len(scratch.lanes)
    for part in range(BLOCK // width):
        packet = scratch.address + part * RAY_ROWS * width * 4
        if moving:
            call(world.intersect, (scratch.valid_address, world.moving, packet, world.arguments))
        call(world.intersect, (scratch.valid_address, world.static, packet, world.arguments))


@_part
def _turn_of(world: World, slot: int, time: np.float32, axis: int) -> Turn:
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
def _read(world: World, tables: Tables, scratch: Scratch, subray: int) -> np.int32:
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
def _detect(tables: Tables, scratch: Scratch) -> None:
    """Make the one ray of each beam its echo, if it is strong enough."""
    room = scratch.room
    for lane in range(BLOCK):
        distance = room[_at(_DISTANCE, 0, lane)]
        if room[_at(_POWER, 0, lane)] < _look_up(tables.need, distance * tables.law[0]):
            room[_at(_DISTANCE, 0, lane)] = np.float32(np.inf)


@_loop
def _merge(
    tables: Tables, scratch: Scratch, subrays: int, order: NDArray[np.int64], margins: Floats, found: Floats
) -> None:
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
def _locate(tables: Tables, scratch: Scratch, ring: int, block: int, echo: int, noise: int) -> None:
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
def _keep_returns(tables: Tables, scratch: Scratch, ring: int, block: int, echo: int) -> None:
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
def _pack(scratch: Scratch, columns: Returns, row: np.uint64, block: int) -> np.uint64:
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
def _pack_pairs(scratch: Scratch, columns: Returns, row: np.uint64, block: int) -> np.uint64:
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
    tables: Tables,
    world: World,
    visible: NDArray[np.bool_],
    scratch: Scratch,
    columns: Returns,
    start: int,
    first: int,
    last: int,
) -> int:
    """Write the points of rings `first` to `last` (exclusive) from row `start` on; return the row after.

    Args:
        visible: (last - first, B) bool: whether the rays of a block may meet a body.
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


@_loop
def close_gap(columns: Returns, row: int, start: int, end: int) -> None:
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
    world: World,
    scratch: Scratch,
    scenes: tuple[int, ...],
    counts: tuple[int, ...],
    origins: Floats,
    directions: Floats,
    distance: Floats,
    face: NDArray[np.uint32],
    cosine: Floats,
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
