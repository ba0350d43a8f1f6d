"""Kernel of the fused engine: one compiled loop that generates, traces, measures and packs the rays of a sweep.

Packets hold the rays of `width` columns of one ring. They stay in the first-level cache: they are filled, traced and
read in the frame of each solid that they may meet, the nearest body first and the static world last.

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
from sensors.raycast.fused.bodies import Sights
from sensors.raycast.fused.embree import INVALID, RAY_ROWS
from sensors.raycast.fused.memory import Scratch, Tables, World
from sensors.raycast.fused.words import call, copy_row

Floats = NDArray[np.float32]

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_loop = compiled(words, fastmath=_FAST)
_part = compiled(words, fastmath=_FAST, forceinline=True)
"""For the parts of a loop: passing dozens of arrays by value would cost more than the work itself."""
_word = compiled(words, fastmath=_FAST, inline="always")
"""For expressions: separate compilation for each mixture of integers would take longer than all else."""

_DIRECTION, _REACH, _MASK = 4, 8, 9
_NORMAL, _PRIMITIVE, _GEOMETRY = 12, 17, 18
"""Rows of a packet; the ray's origin is row 0 and its nearest distance, always 0, row 3."""

_MOST_SUBRAYS = 8
_LAST, _DUAL = 1, 2

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
_SCALE = _POINT + 2 * 3 * BLOCK
_KEEP = _SCALE + BLOCK
_DRAW = _KEEP + 2 * BLOCK
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


@_word
def _component(value: np.float32) -> np.float32:
    """Return a component of a direction that Embree takes as it is.

    It reads those between -1e-18 and 0 as positive in one place and as negative in another: the rays of the packet
    that run the same way then miss what they should hit.
    """
    return np.float32(0.0) if np.abs(value) <= np.float32(1e-18) else value


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


@_loop
def _turn_each(sights: Sights, scratch: Scratch, bend: int) -> None:
    """Fill the packets with the aimed rays, each by its column's own pose."""
    width = len(scratch.lanes)
    room = scratch.room
    for at in range(BLOCK):
        f = np.float32(BLOCK) * room[_at(_LANE, 0, at)] - np.float32(at)
        x, y, z = room[_at(_AIM, 0, at)], room[_at(_AIM, 1, at)], room[_at(_AIM, 2, at)]
        part, lane = at // width, at % width
        for axis in range(3):
            m, d = sights.bent[bend, at, axis], sights.bent_step[bend, at, axis]
            room[_in_packet(width, part, axis, lane)] = m[3] + f * d[3]
            room[_in_packet(width, part, _DIRECTION + axis, lane)] = _component(
                (m[0] + f * d[0]) * x + (m[1] + f * d[1]) * y + (m[2] + f * d[2]) * z
            )


@_part
def _trace(world: World, sights: Sights, scratch: Scratch, entry: int) -> None:
    """Fill the packets with the aimed rays, from the sensor's place at each firing, and trace them through a solid."""
    width = len(scratch.lanes)
    room, word = scratch.room, scratch.word
    pose, step = sights.pose, sights.step
    for axis in range(3):
        m0, m1, m2, m3 = pose[entry, axis, 0], pose[entry, axis, 1], pose[entry, axis, 2], pose[entry, axis, 3]
        d0, d1, d2, d3 = step[entry, axis, 0], step[entry, axis, 1], step[entry, axis, 2], step[entry, axis, 3]
        for part in range(BLOCK // width):
            for lane in range(width):
                at = part * width + lane
                f = room[_at(_LANE, 0, at)]
                x, y, z = room[_at(_AIM, 0, at)], room[_at(_AIM, 1, at)], room[_at(_AIM, 2, at)]
                room[_in_packet(width, part, axis, lane)] = m3 + f * d3
                room[_in_packet(width, part, _DIRECTION + axis, lane)] = _component(
                    (m0 + f * d0) * x + (m1 + f * d1) * y + (m2 + f * d2) * z
                )
    if sights.bend[entry] >= 0:
        _turn_each(sights, scratch, sights.bend[entry])
    for part in range(BLOCK // width):
        for lane in range(width):
            word[_in_packet(width, part, _GEOMETRY, lane)] = np.uint32(INVALID)
        packet = scratch.address + part * RAY_ROWS * width * 4
        call(world.intersect, (scratch.valid_address, world.scene[sights.slot[entry]], packet, world.arguments))


@_part
def _read(world: World, tables: Tables, scratch: Scratch, slot: int, subray: int) -> np.int32:
    """Read the hits of the packets on a solid; return their number."""
    width = len(scratch.lanes)
    room, word, number = scratch.room, scratch.word, scratch.number
    hits = np.int32(0)
    for part in range(BLOCK // width):
        before = hits
        for lane in range(width):
            # Embree's number for no geometry is NaN when read as float32; indices are not.
            geometry = room[_in_packet(width, part, _GEOMETRY, lane)]
            hits += np.int32(geometry == geometry)
        if hits == before:
            continue
        for lane in range(width):
            at = part * width + lane
            nx = room[_in_packet(width, part, _NORMAL, lane)]
            ny = room[_in_packet(width, part, _NORMAL + 1, lane)]
            nz = room[_in_packet(width, part, _NORMAL + 2, lane)]
            along = (
                nx * room[_in_packet(width, part, _DIRECTION, lane)]
                + ny * room[_in_packet(width, part, _DIRECTION + 1, lane)]
                + nz * room[_in_packet(width, part, _DIRECTION + 2, lane)]
            )
            length = max(nx * nx + ny * ny + nz * nz, np.float32(1e-30))
            level = min(np.abs(along) / np.sqrt(length), np.float32(1.0))
            geometry = room[_in_packet(width, part, _GEOMETRY, lane)]
            hit = geometry == geometry
            room[_at(_COSINE, subray, at)] = level if hit else room[_at(_COSINE, subray, at)]
            reached = room[_in_packet(width, part, _REACH, lane)]
            room[_at(_DISTANCE, subray, at)] = reached if hit else room[_at(_DISTANCE, subray, at)]
        for lane in range(width):
            if word[_in_packet(width, part, _GEOMETRY, lane)] == np.uint32(INVALID):
                continue
            at = part * width + lane
            number[_at(_OBJECT, subray, at)] = world.object_id[slot]
            face = np.uint64(word[_in_packet(width, part, _PRIMITIVE, lane)])
            material = world.material[np.uint64(world.offset[slot]) + face]
            scratch.material[subray, at] = material
            place = room[_at(_COSINE, subray, at)] * np.float32(COSINE_BINS)
            low = min(np.uint32(place), np.uint32(COSINE_BINS - 1))
            kind = np.uint64(material) * np.uint64(COSINE_BINS + 1) + np.uint64(low)
            weak, strong = tables.power[kind], tables.power[kind + np.uint64(1)]
            room[_at(_POWER, subray, at)] = weak + (place - np.float32(low)) * (strong - weak)
    return hits


@_part
def _meet(
    tables: Tables, world: World, sights: Sights, scratch: Scratch, ring: int, block: int, subray: int
) -> np.int32:
    """Trace the aimed rays of a block and read their hits; return their number, 0 when all missed.

    Each solid shortens the rays for those behind it.
    """
    width = len(scratch.lanes)
    room = scratch.room
    for part in range(BLOCK // width):
        for lane in range(width):
            room[_in_packet(width, part, _REACH, lane)] = tables.reach[ring, 1]
    for lane in range(BLOCK):
        room[_at(_DISTANCE, subray, lane)] = np.float32(np.inf)
    hits = np.int32(0)
    for entry in range(sights.start[block], sights.start[block + 1]):
        if sights.top[entry] <= ring < sights.bottom[entry]:
            _trace(world, sights, scratch, entry)
            hits += _read(world, tables, scratch, sights.slot[entry], subray)
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
            room[_at(_POINT, 3 * echo + axis, lane)] = along * room[_at(_MEASURED, echo, lane)] + (m3 + f * d3)


@_part
def _keep_returns(tables: Tables, scratch: Scratch, ring: int, block: int, echo: int) -> None:
    """Compute the intensity of the echoes of a block and which returns are kept."""
    room, word = scratch.room, scratch.word
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
        word[_at(_KEEP, echo, lane)] = np.uint32(1) if kept else np.uint32(0)


@_part
def _pack(tables: Tables, scratch: Scratch, columns: Returns, row: np.uint64, block: int, echoes: int) -> np.uint64:
    """Write the kept returns of a block of beams; return the next free row.

    Every return is written, and the next over those that are not kept: a branch would be mispredicted. There is room,
    as the row is never beyond that of a sweep that keeps all.
    """
    room = scratch.room
    # The last block is padded with beams beyond the last column.
    for lane in range(min(BLOCK, tables.columns - block * BLOCK)):
        for echo in range(echoes):
            for axis in range(3):
                columns.points[row, axis] = room[_at(_POINT, 3 * echo + axis, lane)]
            columns.intensity[row] = room[_at(_INTENSITY, echo, lane)]
            columns.column[row] = block * BLOCK + lane
            columns.object_id[row] = scratch.number[_at(_OBJECT, echo, lane)]
            columns.return_number[row] = echo + 1
            columns.material[row] = scratch.material[echo, lane]
            columns.cosine[row] = room[_at(_COSINE, echo, lane)]
            row += np.uint64(scratch.word[_at(_KEEP, echo, lane)])
    return row


@_loop
def sweep_rings(
    tables: Tables,
    world: World,
    sights: Sights,
    scratch: Scratch,
    columns: Returns,
    start: int,
    first: int,
    last: int,
) -> int:
    """Write the points of rings `first` to `last` (exclusive) from row `start` on; return the row after.

    Args:
        sights: solids that the rays of each block may meet.
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
            scratch.word[_in_packet(width, part, _MASK, lane)] = np.uint32(INVALID)
    for ring in range(first, last):
        begun = row
        for lane in range(BLOCK):
            scratch.room[_at(_LANE, 0, lane)] = tables.lane[ring, lane]
        for block in range(tables.point_pose.shape[0]):
            if subrays == 1:
                # A branch of its own: the constant lets the compiler place every row.
                _aim(tables, scratch, ring, block, np.int64(0))
                if _meet(tables, world, sights, scratch, ring, block, np.int64(0)) == 0:
                    continue
                _detect(tables, scratch)
            else:
                for subray in range(subrays):
                    _aim(tables, scratch, ring, block, subray)
                    _meet(tables, world, sights, scratch, ring, block, subray)
                _merge(tables, scratch, subrays, order, margins, found)
            _locate(tables, scratch, ring, block, np.int64(0), np.int64(RANGE))
            _keep_returns(tables, scratch, ring, block, np.int64(0))
            if pairs:
                _locate(tables, scratch, ring, block, np.int64(1), np.int64(SECOND_RANGE))
                _keep_returns(tables, scratch, ring, block, np.int64(1))
                row = _pack(tables, scratch, columns, row, block, np.int64(2))
            else:
                row = _pack(tables, scratch, columns, row, block, np.int64(1))
        columns.ring[begun:row] = ring
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
    intersect: int,
    arguments: int,
    scratch: Scratch,
    scenes: NDArray[np.int64],
    counts: NDArray[np.int64],
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
                    room[_in_packet(width, 0, 4 + axis, lane)] = _component(directions[at, axis])
                room[_in_packet(width, 0, 3, lane)] = np.float32(0.0)
                room[_in_packet(width, 0, 7, lane)] = np.float32(0.0)
                room[_in_packet(width, 0, 8, lane)] = distance[at]
                word[_in_packet(width, 0, 9, lane)] = np.uint32(INVALID)
                word[_in_packet(width, 0, 11, lane)] = 0
                word[_in_packet(width, 0, 18, lane)] = np.uint32(INVALID)
            call(intersect, (scratch.valid_address, scenes[part], scratch.address, arguments))
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
