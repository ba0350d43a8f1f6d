"""Solids that the rays of a sweep may meet, and the sensor's poses in their frames.

A body's triangles stay in its own frame: its rays are turned into it. Instances of Embree would do the same, but they
interpolate and invert a matrix per packet and body, for a quarter of the time of tracing them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled
from sensors.optics.beams import BLOCK
from sensors.raycast.fused import words

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_loop = compiled(words, fastmath=_FAST)

_STRAIGHT_M = 2e-5


class BodyPaths(NamedTuple):
    """Paths of N bodies.

    Attributes:
        times: (K,) float64 instants of the path, s.
        xyz: (N, K, 3) float64 positions, m.
        angles: (N, K, 3) float64 yaw, pitch and roll, rad.
        size: (N, 3) float64 length, width and height, m.
    """

    times: Doubles
    xyz: Doubles
    angles: Doubles
    size: Doubles


class View(NamedTuple):
    """What a sensor looks at during a sweep, in B blocks of columns.

    Attributes:
        knots: (B + 1, 3, 4) float64 world_from_lidar at the borders of the blocks.
        origin: (3,) float64 of the static world's frame.
        first_s, block_s: time of the first border and from one to the next, s.
        azimuth: (16 B,) float64 of the columns, ascending or descending, rad; empty for a rosette.
        elevation: (R,) float64 of the rings, descending, rad.
        spread: largest angle of a ray to its column's azimuth and its ring's elevation, rad.
        cone: (B, 4) float64 axis and half angle of the cone around the rays of each block of a rosette.
        unseen: slot of the body hidden from the sensor, or -1.
    """

    knots: Doubles
    origin: Doubles
    first_s: float
    block_s: float
    azimuth: Doubles
    elevation: Doubles
    spread: float
    cone: Doubles
    unseen: int


class Sights(NamedTuple):
    """Solids that the rays of each block may meet: bodies, the nearest first, and the static world; E in all.

    Attributes:
        start: (B + 1,) int64 where each block starts.
        slot: (E,) int64 number of the solid, see `World`.
        top, bottom: (E,) int64 first ring that may meet it, and the one after the last.
        pose, step: (E, 3, 4) float32 pose of the sensor in the solid's frame at the start of the block, and its change
            until the next block.
        bend: (E,) int64 row of `bent` where the sensor moves on no straight line during the block, else -1.
        bent, bent_step: (K, 16, 3, 4) float32 pose at the start of each column, and its change until the next column.
    """

    start: Ints
    slot: Ints
    top: Ints
    bottom: Ints
    pose: NDArray[np.float32]
    step: NDArray[np.float32]
    bend: Ints
    bent: NDArray[np.float32]
    bent_step: NDArray[np.float32]


@_loop
def _pose(paths: BodyPaths, view: View, slot: int, at: float, matrix: Doubles) -> None:
    """Write the (3, 4) pose of the sensor in a solid's frame, `at` blocks after the first border."""
    block = min(int(at), view.knots.shape[0] - 2)
    share = at - block
    start, end = view.knots[block], view.knots[block + 1]
    if slot == paths.size.shape[0]:
        for axis in range(3):
            for side in range(4):
                matrix[axis, side] = start[axis, side] + share * (end[axis, side] - start[axis, side])
            matrix[axis, 3] -= view.origin[axis]
        return
    times, xyz, angles, knot = paths.times, paths.xyz[slot], paths.angles[slot], 0
    time = view.first_s + view.block_s * at
    while knot < times.shape[0] - 2 and times[knot + 1] <= time:
        knot += 1
    f = min(max((time - times[knot]) / (times[knot + 1] - times[knot]), 0.0), 1.0)
    yaw, pitch, roll = (
        angles[knot, 0] + f * (angles[knot + 1, 0] - angles[knot, 0]),
        angles[knot, 1] + f * (angles[knot + 1, 1] - angles[knot, 1]),
        angles[knot, 2] + f * (angles[knot + 1, 2] - angles[knot, 2]),
    )
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    # The axes of the body in the world are the rows of the inverse rotation.
    ahead = cy * cp, sy * cp, -sp
    left = cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr
    up = cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr
    for side in range(4):
        x = start[0, side] + share * (end[0, side] - start[0, side])
        y = start[1, side] + share * (end[1, side] - start[1, side])
        z = start[2, side] + share * (end[2, side] - start[2, side])
        if side == 3:
            x -= xyz[knot, 0] + f * (xyz[knot + 1, 0] - xyz[knot, 0])
            y -= xyz[knot, 1] + f * (xyz[knot + 1, 1] - xyz[knot, 1])
            z -= xyz[knot, 2] + f * (xyz[knot + 1, 2] - xyz[knot, 2])
        matrix[0, side] = ahead[0] * x + ahead[1] * y + ahead[2] * z
        matrix[1, side] = left[0] * x + left[1] * y + left[2] * z
        matrix[2, side] = up[0] * x + up[1] * y + up[2] * z


@_loop
def _in_sensor(matrix: Doubles, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of a body in the frame of the sensor."""
    x, y, z = x - matrix[0, 3], y - matrix[1, 3], z - matrix[2, 3]
    return (
        matrix[0, 0] * x + matrix[1, 0] * y + matrix[2, 0] * z,
        matrix[0, 1] * x + matrix[1, 1] * y + matrix[2, 1] * z,
        matrix[0, 2] * x + matrix[1, 2] * y + matrix[2, 2] * z,
    )


@_loop
def _wrap(angle: float) -> float:
    return angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5)


@_loop
def _window(
    paths: BodyPaths, view: View, slot: int, begin: int, end: int, matrix: Doubles
) -> tuple[float, float, float, float, float]:
    """Return the angles that a body's box spans between two borders, never too small.

    Returns:
        Middle and half width of the azimuths, lowest and highest elevation, rad, and a lower bound of the distance, m.
    """
    middle, left, right = 0.0, 0.0, 0.0
    bottom, top = np.inf, -np.inf
    near, far = np.inf, 0.0
    length, width, height = paths.size[slot, 0], paths.size[slot, 1], paths.size[slot, 2]
    for moment in range(3):
        _pose(paths, view, slot, begin + 0.5 * (end - begin) * moment, matrix)
        centre_x, centre_y, _ = _in_sensor(matrix, 0.0, 0.0, 0.5 * height)
        bearing = np.arctan2(centre_y, centre_x)
        if moment == 0:
            middle = bearing
        shift = _wrap(bearing - middle)
        distance = np.sqrt(centre_x * centre_x + centre_y * centre_y) + 1e-9
        for corner in range(8):
            x, y, z = _in_sensor(
                matrix,
                (0.5 * length + 0.05) * (1.0 if corner & 1 else -1.0),
                (0.5 * width + 0.05) * (1.0 if corner & 2 else -1.0),
                height + 0.05 if corner & 4 else -0.05,
            )
            ahead = (x * centre_x + y * centre_y) / distance
            aside = (y * centre_x - x * centre_y) / distance
            # Between the moments the body may come a little nearer.
            near, far = min(near, 0.95 * ahead - 0.3), max(far, np.sqrt(x * x + y * y))
            bottom, top = min(bottom, z), max(top, z)
            angle = shift + np.arctan2(aside, ahead)
            left, right = max(left, angle), min(right, angle)
    if near <= 0.0:
        near, left, right = 0.0, np.pi, -np.pi
    margin = view.spread + 0.004
    low = np.arctan2(bottom, near if bottom < 0.0 else far) - margin
    high = np.arctan2(top, near if top > 0.0 else far) + margin
    return middle + 0.5 * (left + right), 0.5 * (left - right) + margin, low, high, near


@_loop
def _in_window(view: View, block: int, centre: float, half: float) -> bool:
    """Return whether a block of a spinning sensor looks into a window."""
    first, end = view.azimuth[block * BLOCK], view.azimuth[block * BLOCK + BLOCK - 1]
    return np.abs(_wrap(0.5 * (first + end) - centre)) <= half + 0.5 * np.abs(end - first)


@_loop
def _sphere(paths: BodyPaths, view: View, slot: int, matrix: Doubles) -> tuple[float, float, float, float]:
    """Return x, y, z and radius of a sphere in the frame of the sensor that holds a body during the whole sweep."""
    blocks = view.knots.shape[0] - 1
    length, width, height = paths.size[slot, 0], paths.size[slot, 1], paths.size[slot, 2]
    moved = 0.0
    _pose(paths, view, slot, 0.5 * blocks, matrix)
    x, y, z = _in_sensor(matrix, 0.0, 0.0, 0.5 * height)
    for at in (0.0, float(blocks)):
        _pose(paths, view, slot, at, matrix)
        end_x, end_y, end_z = _in_sensor(matrix, 0.0, 0.0, 0.5 * height)
        moved = max(moved, np.sqrt((end_x - x) ** 2 + (end_y - y) ** 2 + (end_z - z) ** 2))
    return x, y, z, 0.5 * np.sqrt(length * length + width * width + height * height) + 1.1 * moved + 0.1


@_loop
def _in_cone(view: View, block: int, x: float, y: float, z: float, radius: float) -> bool:
    """Return whether a block of a rosette looks into a sphere."""
    distance = np.sqrt(x * x + y * y + z * z)
    if distance <= radius:
        return True
    along = view.cone[block, 0] * x + view.cone[block, 1] * y + view.cone[block, 2] * z
    return along >= distance * np.cos(min(view.cone[block, 3] + np.arcsin(radius / distance), np.pi))


@_loop
def _straight(paths: BodyPaths, view: View, slot: int, block: int, motion: Doubles) -> bool:
    """Return whether the sensor moves on a straight line in a solid's frame during a block; write its poses then.

    The deviation in the middle is at least half the largest one, also where a path has a knot within the block.

    Args:
        motion: (3, 3, 4) written: at the start, in the middle and at the end of the block.
    """
    for part in range(3):
        _pose(paths, view, slot, block + 0.5 * part, motion[part])
    x, y, z = motion[1, 0, 3], motion[1, 1, 3], motion[1, 2, 3]
    distance = np.sqrt(x * x + y * y + z * z)
    for axis in range(3):
        for side in range(4):
            off = motion[1, axis, side] - 0.5 * (motion[0, axis, side] + motion[2, axis, side])
            if np.abs(off) * (1.0 if side == 3 else distance) > _STRAIGHT_M:
                return False
    return True


@_loop
def sight_bodies(paths: BodyPaths, view: View) -> Sights:
    """Return the solids that the rays of each block may meet."""
    blocks, bodies = view.knots.shape[0] - 1, paths.size.shape[0]
    seen, near = np.zeros((bodies + 1, blocks), np.bool_), np.zeros(bodies + 1)
    order, start = np.zeros(bodies + 1, np.int64), np.zeros(blocks + 1, np.int64)
    top, bottom = np.zeros(bodies + 1, np.int64), np.zeros(bodies + 1, np.int64)
    motion = np.zeros((3, 3, 4))
    near[bodies], bottom[bodies] = np.inf, view.elevation.shape[0]
    for block in range(blocks):
        seen[bodies, block] = True
    for slot in range(bodies):
        if slot == view.unseen:
            continue
        if view.cone.shape[0] > 0:
            x, y, z, radius = _sphere(paths, view, slot, motion[0])
            near[slot] = np.sqrt(x * x + y * y + z * z) - radius
            for block in range(blocks):
                seen[slot, block] = _in_cone(view, block, x, y, z, radius)
            bottom[slot] = view.elevation.shape[0]
        else:
            begin, end = 0, blocks
            # Only blocks that can meet the body in the whole sweep matter, so only its window while they fire.
            for _ in range(2):
                centre, half, low, high, near[slot] = _window(paths, view, slot, begin, end, motion[0])
                first, last = end, begin
                for block in range(begin, end):
                    seen[slot, block] = _in_window(view, block, centre, half)
                    if seen[slot, block]:
                        first, last = min(first, block), block + 1
                begin, end = first, max(first, last)
            for elevation in view.elevation:
                top[slot] += elevation > high
                bottom[slot] += elevation >= low
    for slot in range(bodies + 1):
        place = slot
        while place > 0 and near[order[place - 1]] > near[slot]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = slot
        for block in range(blocks):
            start[block + 1] += seen[slot, block]
    for block in range(blocks):
        start[block + 1] += start[block]
    count = start[blocks]
    slots, tops, bottoms = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    pose, step = np.zeros((count, 3, 4), np.float32), np.zeros((count, 3, 4), np.float32)
    bend, bends = np.zeros(count, np.int64), 0
    free = start.copy()
    for slot in order:
        for block in range(blocks):
            if not seen[slot, block]:
                continue
            entry = free[block]
            free[block] += 1
            slots[entry], tops[entry], bottoms[entry], bend[entry] = slot, top[slot], bottom[slot], -1
            if not _straight(paths, view, slot, block, motion):
                bend[entry] = bends
                bends += 1
            for axis in range(3):
                for side in range(4):
                    pose[entry, axis, side] = motion[0, axis, side]
                    step[entry, axis, side] = motion[2, axis, side] - motion[0, axis, side]
    bent, bent_step = np.zeros((bends, BLOCK, 3, 4), np.float32), np.zeros((bends, BLOCK, 3, 4), np.float32)
    for block in range(blocks):
        for entry in range(start[block], start[block + 1]):
            for column in range(BLOCK if bend[entry] >= 0 else 0):
                _pose(paths, view, slots[entry], block + column / BLOCK, motion[0])
                _pose(paths, view, slots[entry], block + (column + 1) / BLOCK, motion[1])
                for axis in range(3):
                    for side in range(4):
                        bent[bend[entry], column, axis, side] = motion[0, axis, side]
                        bent_step[bend[entry], column, axis, side] = motion[1, axis, side] - motion[0, axis, side]
    return Sights(start, slots, tops, bottoms, pose, step, bend, bent, bent_step)
