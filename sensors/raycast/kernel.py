"""The compiled part of the fused engine: one loop that generates, traces, measures and packs the rays of a sweep.

Packets hold the rays of `width` columns of one ring. A packet lives in the first-level cache: it is filled, traced
through the moving bodies and, with what is left of its reach, through the static world, and read, before the next one.

Shapes: R rings, B blocks of 16 columns, S sub-rays, N bodies, T instants of their motion, M materials.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from sensors.beams import BLOCK
from sensors.noise import ACROSS, LOST_AFTER, LOST_BEFORE, RANGE, SECOND_RANGE, UP
from sensors.optics import COSINE_BINS, RANGE_BINS
from sensors.raycast.embree import FORMAT_FLOAT3X4_ROW_MAJOR, INVALID, RAY_ROWS
from sensors.sweep import STATIC

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy", "fastmath": _FAST}

(_ORIGIN, _NEAR, _DIRECTION, _TIME, _REACH, _MASK) = (0, 3, 4, 7, 8, 9)
(_NORMAL, _PRIMITIVE, _GEOMETRY, _INSTANCE) = (12, 17, 18, 19)
_MOST_SUBRAYS = 8
_STRONGEST, _LAST, _DUAL = range(3)


class Tables(NamedTuple):
    """Everything about one sweep that the loop reads; see `sensors.raycast.base.Shot`.

    Attributes:
        axis: (3, R, 16 B) float32.
        subray: (S, 3, R, 16 B) float32.
        share: (R,) float32 when a beam fires within its column, in columns.
        reach: (R, 2) float32.
        ray_pose, ray_step: (B, 3, 4) float32 pose in the static solid's frame at the start of a block, and its change
            until the next block.
        point_pose, point_step: the same in the frame of the points.
        clock: (3,) float32 body time of column 0 and its change per column; seconds per column.
        power, need, scale: see `sensors.optics.Optics`.
        of_material: intensity depends on what was hit.
        law: (7,) float32 reach of the tables, echo gate, range noise, angle noise, intensity limit and zero-intensity
            chance of the drop-off, general drop-off.
        returns: 0 strongest, 1 last, 2 dual.
        start: (6, R) int64 starts in the tables of random numbers.
        normal, uniform: those tables.
        mask: ray mask.
        columns: C.
    """

    axis: NDArray[np.float32]
    subray: NDArray[np.float32]
    share: NDArray[np.float32]
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
    start: NDArray[np.int64]
    normal: NDArray[np.float32]
    uniform: NDArray[np.float32]
    mask: int
    columns: int


class World(NamedTuple):
    """What the rays meet.

    Attributes:
        intersect, arguments: addresses of Embree's packet function and its arguments.
        static, moving: scene handles; `moving` is 0 without bodies.
        static_material: (F,) uint8.
        body_material: (G,) uint8 of all bodies' faces, one solid after another.
        body_offset: (N,) int64 where the faces of each slot's solid start.
        body_id: (N,) int32 object ids.
        body_size: (N, 3) float64 boxes that hold the bodies.
        body_pose: (N, T, 3, 4) float32 poses of each slot.
        body_steps: (N,) int64 how many of the T instants a slot has.
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


class Columns(NamedTuple):
    """Room for the points of a sweep: two rows per beam when both returns are reported, else one."""

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
    """The packet of one thread and what its rays hit.

    Attributes:
        lanes: a tuple of `width` zeros: its length is part of the type, so that loops over lanes have a fixed length.
        packet: (16 / width, 21, width) float32, 64-byte aligned as Embree asks.
        packet_word: the same memory as uint32.
        valid: (width,) int32 of -1, aligned.
        packet_address, valid_address: where they lie.
        distance, cosine, margin, power: (S, 16) float32 of each sub-ray; distance is infinite where it missed.
        object_id: (S, 16) int32.
        material: (S, 16) uint8.
    """

    lanes: tuple[int, ...]
    packet: NDArray[np.float32]
    packet_word: NDArray[np.uint32]
    valid: NDArray[np.int32]
    packet_address: int
    valid_address: int
    distance: NDArray[np.float32]
    cosine: NDArray[np.float32]
    margin: NDArray[np.float32]
    power: NDArray[np.float32]
    object_id: NDArray[np.int32]
    material: NDArray[np.uint8]


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


@njit(inline="always")
def _read(table: Any, place: Any, bins: Any) -> Any:
    """Return the value of a table at a place in [0, 1]."""
    at = place * np.float32(bins)
    low = min(np.uint32(at), np.uint32(bins - 1))
    share = at - np.float32(low)
    return table[low] + share * (table[low + np.uint32(1)] - table[low])


@njit(**_OPTIONS)
def _fill(tables: Any, scratch: Any, ring: int, block: int, subray: int) -> None:
    """Fill the packets of one block of one ring with the rays of one sub-ray."""
    width = len(scratch.lanes)
    pose, step = tables.ray_pose[block], tables.ray_step[block]
    reach = tables.reach[ring, 1]
    share = tables.share[ring]
    first = np.float32(block * BLOCK)
    sigma = tables.law[3]
    for part in range(BLOCK // width):
        ray = scratch.packet[part]
        word = scratch.packet_word[part]
        base = block * BLOCK + part * width
        x = tables.subray[subray, 0, ring, base : base + width]
        y = tables.subray[subray, 1, ring, base : base + width]
        z = tables.subray[subray, 2, ring, base : base + width]
        if sigma > np.float32(0.0):
            across = tables.normal[tables.start[ACROSS, ring] + base :]
            up = tables.normal[tables.start[UP, ring] + base :]
            for lane in range(width):
                level = max(np.sqrt(x[lane] * x[lane] + y[lane] * y[lane]), np.float32(1e-6))
                a = sigma * across[lane] / level
                e = sigma * up[lane] / level
                ray[4, lane] = x[lane] - a * y[lane] - e * x[lane] * z[lane]
                ray[5, lane] = y[lane] + a * x[lane] - e * y[lane] * z[lane]
                ray[6, lane] = z[lane] + e * level * level
        else:
            for lane in range(width):
                ray[4, lane] = x[lane]
                ray[5, lane] = y[lane]
                ray[6, lane] = z[lane]
        for lane in range(width):
            column = np.float32(lane + part * width) + share
            f = column * np.float32(1.0 / BLOCK)
            dx = ray[4, lane]
            dy = ray[5, lane]
            dz = ray[6, lane]
            ray[0, lane] = pose[0, 3] + f * step[0, 3]
            ray[1, lane] = pose[1, 3] + f * step[1, 3]
            ray[2, lane] = pose[2, 3] + f * step[2, 3]
            ray[3, lane] = np.float32(0.0)
            ray[4, lane] = (
                (pose[0, 0] + f * step[0, 0]) * dx
                + (pose[0, 1] + f * step[0, 1]) * dy
                + (pose[0, 2] + f * step[0, 2]) * dz
            )
            ray[5, lane] = (
                (pose[1, 0] + f * step[1, 0]) * dx
                + (pose[1, 1] + f * step[1, 1]) * dy
                + (pose[1, 2] + f * step[1, 2]) * dz
            )
            ray[6, lane] = (
                (pose[2, 0] + f * step[2, 0]) * dx
                + (pose[2, 1] + f * step[2, 1]) * dy
                + (pose[2, 2] + f * step[2, 2]) * dz
            )
            time = tables.clock[0] + tables.clock[1] * (first + column)
            ray[7, lane] = min(max(time, np.float32(0.0)), np.float32(1.0))
            ray[8, lane] = reach
        for lane in range(width):
            word[9, lane] = np.uint32(tables.mask)
            word[11, lane] = 0
            word[18, lane] = INVALID
            word[19, lane] = INVALID


@njit(**_OPTIONS)
def _trace(world: Any, scratch: Any, moving: bool) -> None:
    """Find what the packets hit: the bodies first, which shortens the rays for the static world."""
    width = len(scratch.lanes)
    for part in range(BLOCK // width):
        packet = scratch.packet_address + part * RAY_ROWS * width * 4
        if moving:
            call(world.intersect, (scratch.valid_address, world.moving, packet, world.arguments))
        call(world.intersect, (scratch.valid_address, world.static, packet, world.arguments))


@njit(**_OPTIONS)
def _incidence_on_body(world: Any, ray: Any, lane: int, slot: int) -> np.float32:
    """Return the cosine between a ray and a normal that Embree gives in the body's own frame."""
    last = world.body_steps[slot] - 1
    at = ray[7, lane] * np.float32(last)
    low = min(np.int64(at), last - 1)
    f = at - np.float32(low)
    a, b = world.body_pose[slot, low], world.body_pose[slot, low + 1]
    total = np.float32(0.0)
    length = np.float32(0.0)
    for axis in range(3):
        normal = ray[12 + axis, lane]
        along = np.float32(0.0)
        for row in range(3):
            along += (a[row, axis] + f * (b[row, axis] - a[row, axis])) * ray[4 + row, lane]
        total += along * normal
        length += normal * normal
    return np.abs(total) / np.sqrt(max(length, np.float32(1e-30)))


@njit(**_OPTIONS)
def _read_hits(world: Any, tables: Any, scratch: Any, subray: int) -> int:
    """Take what was hit out of the packets; return how many rays hit."""
    width = len(scratch.lanes)
    distance, cosine = scratch.distance[subray], scratch.cosine[subray]
    object_id, material = scratch.object_id[subray], scratch.material[subray]
    power = scratch.power[subray]
    count = 0
    for part in range(BLOCK // width):
        ray = scratch.packet[part]
        word = scratch.packet_word[part]
        base = part * width
        for lane in range(width):
            nx, ny, nz = ray[12, lane], ray[13, lane], ray[14, lane]
            along = nx * ray[4, lane] + ny * ray[5, lane] + nz * ray[6, lane]
            length = max(nx * nx + ny * ny + nz * nz, np.float32(1e-30))
            cosine[base + lane] = min(np.abs(along) / np.sqrt(length), np.float32(1.0))
        for lane in range(width):
            at = base + lane
            if word[18, lane] == np.uint32(INVALID):
                distance[at] = np.float32(np.inf)
                continue
            count += 1
            distance[at] = ray[8, lane]
            slot = word[19, lane]
            face = np.uint64(word[17, lane])
            if slot == np.uint32(INVALID):
                object_id[at] = STATIC
                kind = world.static_material[face]
            else:
                object_id[at] = world.body_id[slot]
                kind = world.body_material[np.uint64(world.body_offset[slot]) + face]
                cosine[at] = min(_incidence_on_body(world, ray, lane, np.int64(slot)), np.float32(1.0))
            material[at] = kind
            power[at] = _read(tables.power[kind], cosine[at], COSINE_BINS)
    return count


@njit(**_OPTIONS)
def _report(
    tables: Any,
    columns: Any,
    row: int,
    ring: int,
    column: int,
    distance: np.float32,
    power: np.float32,
    object_id: int,
    material: int,
    cosine: np.float32,
    number: int,
    noise: int,
) -> int:
    """Write one return unless it is lost; return the next free row."""
    place = min(distance / tables.law[0], np.float32(1.0))
    scale = _read(tables.scale, place, RANGE_BINS)
    intensity = min(power * scale if tables.of_material else scale, np.float32(1.0))
    limit, most = tables.law[4], tables.law[5]
    if most > np.float32(0.0) and intensity < limit:
        chance = most * (np.float32(1.0) - intensity / limit)
        if tables.uniform[tables.start[LOST_AFTER, ring] + column] < chance:
            return row
    measured = distance + tables.law[2] * tables.normal[tables.start[noise, ring] + column]
    near, far = tables.reach[ring, 0], tables.reach[ring, 1]
    if distance < near or measured < near or measured > far:
        return row
    block = column // BLOCK
    pose, step = tables.point_pose[block], tables.point_step[block]
    fired = np.float32(column) + tables.share[ring]
    f = (fired - np.float32(block * BLOCK)) * np.float32(1.0 / BLOCK)
    x = tables.axis[0, ring, column] * measured
    y = tables.axis[1, ring, column] * measured
    z = tables.axis[2, ring, column] * measured
    for axis in range(3):
        columns.points[row, axis] = (
            (pose[axis, 0] + f * step[axis, 0]) * x
            + (pose[axis, 1] + f * step[axis, 1]) * y
            + (pose[axis, 2] + f * step[axis, 2]) * z
            + (pose[axis, 3] + f * step[axis, 3])
        )
    columns.intensity[row] = intensity
    columns.ring[row] = ring
    columns.column[row] = column
    columns.time_offset[row] = (fired - np.float32(0.5) * np.float32(tables.columns)) * tables.clock[2]
    columns.object_id[row] = object_id
    columns.return_number[row] = number
    columns.material[row] = material
    columns.cosine[row] = cosine
    return row + 1


@njit(**_OPTIONS)
def _report_single(tables: Any, scratch: Any, columns: Any, row: int, ring: int, block: int) -> int:
    """Report a block of beams of one ray each."""
    lost = tables.uniform[tables.start[LOST_BEFORE, ring] + block * BLOCK :]
    lanes = min(BLOCK, tables.columns - block * BLOCK)
    for lane in range(lanes):
        distance = scratch.distance[0, lane]
        if distance == np.float32(np.inf) or lost[lane] < tables.law[6]:
            continue
        power = scratch.power[0, lane]
        if power < _read(tables.need, min(distance / tables.law[0], np.float32(1.0)), RANGE_BINS):
            continue
        row = _report(
            tables,
            columns,
            row,
            ring,
            block * BLOCK + lane,
            distance,
            power,
            scratch.object_id[0, lane],
            scratch.material[0, lane],
            scratch.cosine[0, lane],
            1,
            RANGE,
        )
    return row


@njit(**_OPTIONS)
def _report_many(tables: Any, scratch: Any, columns: Any, row: int, ring: int, block: int, echo: Any) -> int:
    """Merge the sub-rays of a block of beams into echoes and report those that are asked for."""
    subrays = scratch.distance.shape[0]
    part = np.float32(1.0) / np.float32(subrays)
    lost = tables.uniform[tables.start[LOST_BEFORE, ring] + block * BLOCK :]
    order = np.zeros(_MOST_SUBRAYS, np.int64)
    for lane in range(min(BLOCK, tables.columns - block * BLOCK)):
        if lost[lane] < tables.law[6]:
            continue
        hits = 0
        for subray in range(subrays):
            distance = scratch.distance[subray, lane]
            if distance == np.float32(np.inf):
                continue
            need = _read(tables.need, min(distance / tables.law[0], np.float32(1.0)), RANGE_BINS)
            scratch.margin[subray, lane] = part * scratch.power[subray, lane] / need
            place = hits
            while place > 0 and scratch.distance[order[place - 1], lane] > distance:
                order[place] = order[place - 1]
                place -= 1
            order[place] = subray
            hits += 1
        echoes = 0
        first = 0
        while first < hits:
            after = first + 1
            while (
                after < hits
                and scratch.distance[order[after], lane] - scratch.distance[order[after - 1], lane] <= tables.law[1]
            ):
                after += 1
            margin = np.float32(0.0)
            power = np.float32(0.0)
            mean = np.float32(0.0)
            best = order[first]
            for index in range(first, after):
                subray = order[index]
                margin += scratch.margin[subray, lane]
                power += scratch.power[subray, lane] * part
                mean += scratch.margin[subray, lane] * (scratch.distance[subray, lane] - scratch.distance[best, lane])
            best_distance = scratch.distance[best, lane]
            for index in range(first, after):
                if scratch.margin[order[index], lane] > scratch.margin[best, lane]:
                    best = order[index]
            if margin >= np.float32(1.0):
                echo[echoes, 0] = best_distance + mean / margin
                echo[echoes, 1] = power
                echo[echoes, 2] = margin
                echo[echoes, 3] = np.float32(best)
                echoes += 1
            first = after
        if echoes == 0:
            continue
        strongest = 0
        for index in range(1, echoes):
            if echo[index, 2] > echo[strongest, 2]:
                strongest = index
        chosen = strongest if tables.returns != _LAST else echoes - 1
        other = -1
        if tables.returns == _DUAL and echoes > 1:
            other = echoes - 1
            if other == strongest:
                other = 0
                for index in range(1, echoes - 1):
                    if echo[index, 2] > echo[other, 2]:
                        other = index
            if other < chosen:
                chosen, other = other, chosen
        number = 0
        for index in (chosen, other):
            if index < 0:
                continue
            best = np.int64(echo[index, 3])
            number += 1
            row = _report(
                tables,
                columns,
                row,
                ring,
                block * BLOCK + lane,
                echo[index, 0],
                echo[index, 1],
                scratch.object_id[best, lane],
                scratch.material[best, lane],
                scratch.cosine[best, lane],
                number,
                RANGE if number == 1 else SECOND_RANGE,
            )
    return row


@njit(**_OPTIONS)
def sweep_rings(
    tables: Any, world: Any, visible: Any, scratch: Any, columns: Any, first_row: int, first: int, last: int
) -> int:
    """Make the points of rings `first` to `last` (exclusive) from row `first_row` on; return the row after."""
    row = first_row
    subrays = tables.subray.shape[0]
    echo = np.zeros((_MOST_SUBRAYS, 4), np.float32)
    for ring in range(first, last):
        for block in range(tables.ray_pose.shape[0]):
            moving = world.moving != 0 and visible[ring - first, block]
            hits = 0
            for subray in range(subrays):
                _fill(tables, scratch, ring, block, subray)
                _trace(world, scratch, moving)
                hits += _read_hits(world, tables, scratch, subray)
            if hits == 0:
                continue
            if subrays == 1:
                row = _report_single(tables, scratch, columns, row, ring, block)
            else:
                row = _report_many(tables, scratch, columns, row, ring, block, echo)
    return row


class Calls(NamedTuple):
    """Addresses of the Embree functions that move instances."""

    set_transform: int
    commit_geometry: int
    set_mask: int
    commit_scene: int


@njit(**_OPTIONS)
def place_bodies(
    calls: Any,
    scene: int,
    geometry: Any,
    steps: Any,
    masks: Any,
    span: Any,
    times: Any,
    xyz: Any,
    angles: Any,
    pose: Any,
) -> None:
    """Move the instances of a scene and commit it.

    Args:
        calls: see `Calls`.
        scene: handle.
        geometry: (N,) int64 handles of the slots.
        steps: (N,) int64 instants of each slot, equally spaced over the span.
        masks: (N,) int64 ray masks.
        span: (2,) float64 first and last instant, s.
        times: (K,) float64 instants of the path.
        xyz: (N, K, 3) float64 positions of the path relative to the scene's origin, m.
        angles: (N, K, 3) float64 its yaw, pitch and roll, rad.
        pose: (N, T, 3, 4) float32, written: the poses at the slots' instants.
    """
    for slot in range(geometry.shape[0]):
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
                matrix[axis, 3] = start + f * (xyz[slot, knot + 1, axis] - start)
            call(calls.set_transform, (geometry[slot], instant, FORMAT_FLOAT3X4_ROW_MAJOR, matrix.ctypes.data))
        call(calls.set_mask, (geometry[slot], masks[slot]))
        call(calls.commit_geometry, (geometry[slot],))
    call(calls.commit_scene, (scene,))


@njit(**_OPTIONS)
def see_bodies(
    visible: Any, azimuth: Any, elevation: Any, spread: float, moments: Any, instants: Any, unseen: int, world: Any
) -> None:
    """Mark the packets that may meet a body.

    Args:
        visible: (R, B) bool, written.
        azimuth: (16 B,) float64 of the columns, ascending or descending, rad.
        elevation: (R,) float64 rad.
        spread: most that a ray leaves its column's azimuth and its ring's elevation, rad.
        moments: (J, 3, 4) float32 poses of the sensor at some moments from the first to the last of the sweep.
        instants: (J,) float32 those moments in body time, 0 to 1.
        unseen: slot of the body that the sensor does not see, or -1.
        world: the bodies.
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
            # Between the moments it may come a little nearer.
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


@njit(**_OPTIONS)
def _wrap(angle: float) -> float:
    return angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5)


@njit(**_OPTIONS)
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


@njit(**_OPTIONS)
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


@njit(**_OPTIONS)
def cast_rays(world: Any, scratch: Any, origins: Any, directions: Any, distance: Any, face: Any, cosine: Any) -> None:
    """Cast (N, 3) single rays against the static scene, each up to its `distance`, and write what they hit."""
    width = len(scratch.lanes)
    ray, word = scratch.packet[0], scratch.packet_word[0]
    total = distance.shape[0]
    for base in range(0, total, width):
        for lane in range(width):
            # The last packet is filled up with its last ray.
            at = min(base + lane, total - 1)
            for axis in range(3):
                ray[axis, lane] = origins[at, axis]
                ray[4 + axis, lane] = directions[at, axis]
            ray[3, lane] = np.float32(0.0)
            ray[7, lane] = np.float32(0.0)
            ray[8, lane] = distance[at]
            word[9, lane] = np.uint32(INVALID)
            word[11, lane] = 0
            word[18, lane] = np.uint32(INVALID)
        call(world.intersect, (scratch.valid_address, world.static, scratch.packet_address, world.arguments))
        for lane in range(min(width, total - base)):
            if word[18, lane] == np.uint32(INVALID):
                continue
            at = base + lane
            nx, ny, nz = ray[12, lane], ray[13, lane], ray[14, lane]
            along = nx * ray[4, lane] + ny * ray[5, lane] + nz * ray[6, lane]
            length = np.sqrt(max(nx * nx + ny * ny + nz * nz, np.float32(1e-30)))
            distance[at] = ray[8, lane]
            face[at] = word[17, lane]
            cosine[at] = min(np.abs(along) / length, np.float32(1.0))
