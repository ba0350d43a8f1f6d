"""Compiled loops of the visible fraction: rays at bodies chosen, aimed and counted.

Shapes: R rings, C columns, V windows, c columns of all windows, K rays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled

_GOLDEN = 0.6180339887

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


@compiled()
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


@compiled()
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


@compiled()
def nearest_hits(ray: Ints, face: NDArray[np.int32], distance: Floats, rays: int) -> Floats:
    """Return (rays,) distance of the nearest body that each ray meets, inf where it meets none."""
    nearest = np.full(rays, np.float32(np.inf))
    for hit in range(len(ray)):
        if face[hit] >= 0:
            nearest[ray[hit]] = min(nearest[ray[hit]], distance[hit])
    return nearest


@compiled()
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
