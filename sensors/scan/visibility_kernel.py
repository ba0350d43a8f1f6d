"""Compiled loops of the visible fraction: windows of bodies; rays at them chosen, aimed and counted.

Shapes: R rings, C columns, V windows, c columns of all windows, K rays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled
from sensors.optics import beams
from sensors.optics.beams import BLOCK
from sensors.scan import angular_windows
from sensors.scan.angular_windows import angles_of, arc_of, between, runs_of

_GOLDEN = 0.6180339887
_GROW_M = 0.05
_loop = compiled(angular_windows, beams)

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Windows(NamedTuple):
    """Rays of a sweep that may meet a body, V times: the rings of a window with its columns.

    Attributes:
        body: (V,) rows of the bodies.
        top, bottom: (V,) first ring, and the one after the last.
        start, end: (V,) first of the window's rows in `column`, and the one after the last.
        column: (c,) columns, ascending in each window.
    """

    body: Ints
    top: Ints
    bottom: Ints
    start: Ints
    end: Ints
    column: Ints


class Motion(NamedTuple):
    """Motion of a sensor among N bodies during a sweep.

    Attributes:
        knots: (B + 1, 3, 4) see `sensors.raycast.SweepRequest`.
        columns: C.
        time_s, column_s: middle of the sweep, and from a column to the next, s.
        times, xyz, angles: (K,), (N, K, 3) and (N, K, 3) path of the bodies, see `sensors.motion.Path`.
        size: (N, 3) of the bodies, m.
    """

    knots: Doubles
    columns: int
    time_s: float
    column_s: float
    times: Doubles
    xyz: Doubles
    angles: Doubles
    size: Doubles


@_loop
def _sensor_at(motion: Motion, column: float, pose: Doubles) -> None:
    """Write the (3, 4) world_from_lidar at a moment, in columns since the start."""
    block = min(max(int(column // BLOCK), 0), len(motion.knots) - 2)
    start, end = motion.knots[block], motion.knots[block + 1]
    pose[:] = start + (column / BLOCK - block) * (end - start)


@_loop
def _knot_at(motion: Motion, column: float) -> tuple[int, float]:
    """Return the knot of the bodies' path before a moment, and the share of the way to the next."""
    time_s = motion.time_s + (column - 0.5 * motion.columns) * motion.column_s
    times, knot = motion.times, 0
    while knot < len(times) - 2 and times[knot + 1] <= time_s:
        knot += 1
    return knot, min(max((time_s - times[knot]) / (times[knot + 1] - times[knot]), 0.0), 1.0)


@_loop
def body_from_lidar(motion: Motion, body: int, column: float, pose: Doubles) -> None:
    """Write the (3, 4) body_from_lidar at a moment, in columns since the start."""
    knot, share = _knot_at(motion, column)
    xyz = (1.0 - share) * motion.xyz[body, knot] + share * motion.xyz[body, knot + 1]
    yaw, pitch, roll = (1.0 - share) * motion.angles[body, knot] + share * motion.angles[body, knot + 1]
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    _sensor_at(motion, column, pose)
    pose[:, 3] -= xyz
    for side in range(4):
        x, y, z = pose[0, side], pose[1, side], pose[2, side]
        # The axes of the body in the world are the rows of the inverse rotation.
        pose[0, side] = cy * cp * x + sy * cp * y - sp * z
        pose[1, side] = (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z
        pose[2, side] = (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z


@_loop
def _arc_of_body(motion: Motion, body: int, pose: Doubles, place: Doubles) -> tuple[float, float]:
    """Return start and width of the azimuths that hold a body during the whole sweep."""
    length, width, height = motion.size[body]
    for moment in range(3):
        column = 0.5 * moment * motion.columns
        knot, share = _knot_at(motion, column)
        _sensor_at(motion, column, pose)
        away = (1.0 - share) * motion.xyz[body, knot] + share * motion.xyz[body, knot + 1] - pose[:, 3]
        for axis in range(2):
            place[axis, moment] = pose[0, axis] * away[0] + pose[1, axis] * away[1] + pose[2, axis] * away[2]
    # A sphere around the middle of the footprint that holds the box however it leans.
    radius = np.sqrt(0.25 * (length * length + width * width) + height * height) + _GROW_M
    return arc_of(place[0], place[1], radius)


@_loop
def corners_of(motion: Motion, body: int, first: float, after: float) -> Doubles:
    """Return (24, 3) corners of a body's box in the sensor frame, at three moments of some columns."""
    pose, corners = np.zeros((3, 4)), np.zeros((24, 3))
    for row in range(24):
        if row % 8 == 0:
            body_from_lidar(motion, body, first + (after - first) * 0.5 * (row // 8), pose)
        x = (motion.size[body, 0] + _GROW_M) * (0.5 if row & 4 else -0.5) - pose[0, 3]
        y = (motion.size[body, 1] + _GROW_M) * (0.5 if row & 2 else -0.5) - pose[1, 3]
        z = (motion.size[body, 2] + _GROW_M if row & 1 else 0.0) - 0.5 * _GROW_M - pose[2, 3]
        for axis in range(3):
            corners[row, axis] = x * pose[0, axis] + y * pose[1, axis] + z * pose[2, axis]
    return corners


@_loop
def fan_windows(motion: Motion, bodies: Ints, azimuth: Doubles, elevation: Doubles, spread: float) -> Windows:
    """Return the windows of (N,) bodies in a sweep of columns and rings; see `sensors.optics.beams.Fan`."""
    pose, place = np.zeros((3, 4)), np.zeros((2, 3))
    found = [(0, 0, 0, 0, 0) for _ in range(0)]
    for body in bodies:
        start, width = _arc_of_body(motion, body, pose, place)
        for first, after in runs_of(azimuth, start, width, spread):
            # Only these columns can meet the body, so only its poses while they fire matter.
            angles = angles_of(corners_of(motion, body, first, after))
            top, bottom = between(elevation, angles.low - spread, angles.high + spread)
            for left, right in runs_of(azimuth, angles.start, angles.width, spread):
                if min(right, after) > max(left, first) and bottom > top:
                    found.append((body, top, bottom, max(left, first), min(right, after)))
    rows = np.array([row for window in found for row in window], np.int64).reshape(-1, 5).T.copy()
    end = np.cumsum(rows[4] - rows[3])
    column = np.array([column for window in found for column in range(window[3], window[4])], np.int64)
    return Windows(rows[0], rows[1], rows[2], end - (rows[4] - rows[3]), end, column)


@_loop
def body_poses(motion: Motion, border: Doubles, segment: Ints, windows: Windows) -> tuple[Floats, Ints]:
    """Return the sensor's poses in the frames of the bodies.

    Args:
        border, segment: see `sensors.scan.shutter.Shutter`.

    Returns:
        (N, 3, 4) float32 poses at the borders around each window's columns, window by window; (c,) row in them of the
        border before each column.
    """
    before, count = segment[windows.column], 0
    for window in range(len(windows.body)):
        inside = before[windows.start[window] : windows.end[window]]
        count += inside.max() - inside.min() + 2
    poses, pose, row = np.zeros((count, 3, 4), np.float32), np.zeros((3, 4)), 0
    for window in range(len(windows.body)):
        inside = before[windows.start[window] : windows.end[window]]
        first, last = inside.min(), inside.max() + 1
        inside += row - first
        for at in range(first, last + 1):
            body_from_lidar(motion, windows.body[window], border[at], pose)
            poses[row] = pose
            row += 1
    return poses, before


@_loop
def choose_rays(
    windows: Windows, stride: Ints, lead: NDArray[np.float64], widest: float, columns: int
) -> tuple[Ints, Ints, Flags, Ints]:
    """Choose the rays that are cast at bodies.

    Args:
        stride: (V,) n of every n-th column that is taken of each ring.
        lead: (R,) lead of each ring's azimuth in columns.
        widest: the largest lead; the columns of a window cover the rings that have it.
        columns: C.

    Returns:
        (K,) rings, window by window; (K,) rows of their columns in `windows.column`; (K,) whether they are of their
        body's own sample; (V,) rays per window.
    """
    wanted = np.zeros((len(lead), columns), np.bool_)
    most = ((windows.bottom - windows.top) * (windows.end - windows.start)).sum()
    rings, rows, own = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.bool_)
    count = np.zeros(len(stride), np.int64)
    found = 0
    # Rays sampled for one body are cast at those before it too, or they could not hide it.
    for marking in (True, False):
        for window in range(len(stride)):
            start, end, step = windows.start[window], windows.end[window], stride[window]
            left, right, before = windows.column[start], windows.column[end - 1], found
            for ring in range(windows.top[window], windows.bottom[window]):
                # Each ring needs its own part of the columns, others are sampled in each.
                low = left + widest + lead[ring] - 1.0 if left > 0 else 0.0
                high = right - widest + lead[ring] + 1.0 if right < columns - 1 else np.float64(columns)
                first = start + int(np.floor(step * ((_GOLDEN * ring) % 1.0)))
                begin, by = (first, step) if marking else (start, 1)
                for row in range(begin, end, by):
                    column = windows.column[row]
                    if not low <= column <= high:
                        continue
                    if marking:
                        wanted[ring, column] = True
                    elif wanted[ring, column]:
                        rings[found], rows[found], own[found] = ring, row, (row - first) % step == 0
                        found += 1
            count[window] = found - before
    return rings[:found], rows[:found], own[:found], count


@_loop
def aim_rays(
    pose: Floats, before: Ints, timing: Floats, axes: Floats, share: Floats, ring: Ints, column: Ints, row: Ints
) -> tuple[Floats, Floats]:
    """Return (K, 3) origins and directions of rays.

    Args:
        pose: (N, 3, 4) poses of the sensor at borders of segments.
        before: (c,) row in `pose` of the border before each column; that of the border after it is the next.
        timing: (4, C) see `Shutter.timing`.
        axes: (3, R, 1 or C) see `beam_axes`.
        share: (R,) firing time of each beam, as a share of its column.
        ring: (K,) of the rays.
        column: (c,) columns.
        row: (K,) rows of the rays' columns in `column`.
    """
    start, step = np.zeros((len(column), 3, 4), np.float32), np.zeros((len(column), 3, 4), np.float32)
    for at in range(len(column)):
        past, length, cosine, sine = timing[:, column[at]]
        for axis in range(3):
            for side in range(4):
                change = pose[before[at] + 1, axis, side] - pose[before[at], axis, side]
                start[at, axis, side] = pose[before[at], axis, side] + past * change
                step[at, axis, side] = length * change
            for turned in (start[at, axis], step[at, axis]):
                forward = cosine * turned[0] + sine * turned[1]
                turned[1] = cosine * turned[1] - sine * turned[0]
                turned[0] = forward
    origin, direction = np.zeros((len(ring), 3), np.float32), np.zeros((len(ring), 3), np.float32)
    for ray in range(len(ring)):
        at, beam = row[ray], ring[ray]
        along = min(column[at], axes.shape[2] - 1)
        x, y, z, f = axes[0, beam, along], axes[1, beam, along], axes[2, beam, along], share[beam]
        for axis in range(3):
            a, b = start[at, axis], step[at, axis]
            direction[ray, axis] = (a[0] + f * b[0]) * x + (a[1] + f * b[1]) * y + (a[2] + f * b[2]) * z
            origin[ray, axis] = a[3] + f * b[3]
    return origin, direction


@_loop
def nearest_hits(ray: Ints, face: NDArray[np.int32], distance: Floats, rays: int) -> Floats:
    """Return (rays,) distance of the nearest body that each ray meets, inf where it meets none."""
    nearest = np.full(rays, np.float32(np.inf))
    for hit in range(len(ray)):
        if face[hit] >= 0:
            nearest[ray[hit]] = min(nearest[ray[hit]], distance[hit])
    return nearest


@_loop
def seen_shares(
    body: Ints,
    count: Ints,
    ray: Ints,
    own: Flags,
    face: NDArray[np.int32],
    distance: Floats,
    least: Floats,
    nearest: Floats,
    bodies: int,
) -> Floats:
    """Return (bodies,) share of each body's rays that meet nothing before it, NaN where it has none.

    Args:
        body, count: (V,) body and number of rays of each window.
        ray, own: (K,) numbers of the rays and whether they are of their body's own sample.
        face, distance: (K,) their hits on the body alone, face -1 where they miss it.
        least: (R,) distance from which a hit counts.
        nearest: (R C,) distance of the nearest body that each ray meets, -inf where the static world is before it.
    """
    alone, reaching = np.zeros(bodies, np.int64), np.zeros(bodies, np.int64)
    columns = len(nearest) // len(least)
    end = 0
    for window in range(len(body)):
        start, end = end, end + count[window]
        for hit in range(start, end):
            if own[hit] and face[hit] >= 0 and distance[hit] >= least[ray[hit] // columns]:
                alone[body[window]] += 1
                reaching[body[window]] += distance[hit] <= nearest[ray[hit]]
    return (reaching / alone).astype(np.float32)
