"""Moving bodies of the fused engine: their instances in Embree's scene, and the packets that may meet them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled
from sensors.optics.beams import BLOCK
from sensors.raycast.fused import words
from sensors.raycast.fused.embree import ANY_RAY, FORMAT_FLOAT3X4_ROW_MAJOR
from sensors.raycast.fused.memory import World
from sensors.raycast.fused.words import call

Floats = NDArray[np.float32]

_FAST = {"contract", "nsz", "reassoc", "arcp"}
_loop = compiled(words, fastmath=_FAST)
_part = compiled(words, fastmath=_FAST, forceinline=True)

_LERP_ERROR_M = 2e-5


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
def _segments(motion: BodyPaths, slot: int, most: int) -> int:
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
    calls: Calls,
    scene: int,
    geometry: NDArray[np.int64],
    shown: NDArray[np.int64],
    hidden: NDArray[np.int64],
    object_id: NDArray[np.int64],
    motion: BodyPaths,
    steps: NDArray[np.int64],
    pose: Floats,
) -> None:
    """Move the instances of a scene and commit it.

    Args:
        geometry: (N,) int64 handles of the slots.
        shown: (N,) int64 number of instants of each slot before; written.
        hidden: (H,) int64 ids of the bodies that rays of mask bit 0, 1, ... do not see.
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
    visible: NDArray[np.bool_],
    azimuth: NDArray[np.float64],
    elevation: NDArray[np.float64],
    spread: float,
    moments: Floats,
    instants: Floats,
    unseen: int,
    world: World,
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
def _in_sensor(
    a: Floats, b: Floats, f: float, sensor: Floats, x: float, y: float, z: float
) -> tuple[float, float, float]:
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
