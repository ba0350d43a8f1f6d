"""Windows of bodies: rays of a sweep that may meet a body, and the sensor's poses in the body's frame."""

import numpy as np
from numpy.typing import NDArray

from sensors.optics.beams import Fan, halo
from sensors.raycast.base import Bodies, SweepRequest
from sensors.scan.angular_windows import Arcs, angular_windows, arcs_of
from sensors.scan.shutter import Shutter
from sensors.scan.visibility_kernel import Windows

_GROW_M = 0.05
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_CONE_MARGIN_RAD = np.radians(0.3)
_MOMENTS = np.array([0.0, 0.5, 1.0])

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


def body_windows(request: SweepRequest, shutter: Shutter, bodies: Bodies) -> Windows:
    """Return the windows of the bodies that may come within reach and are not hidden."""
    rows = _near(request, shutter, bodies)
    fan = request.beams.fan
    return _by_cone(request, shutter, bodies, rows) if fan is None else _by_fan(fan, request, shutter, bodies, rows)


def body_poses(shutter: Shutter, bodies: Bodies, windows: Windows) -> tuple[Floats, Ints]:
    """Return the sensor's poses in the frames of the bodies.

    Returns:
        (N, 3, 4) float32 poses at the borders around each window's columns, window by window; (c,) row in them of the
        border before each column.
    """
    segment = shutter.segment[windows.column]
    first, last = np.zeros((2, 0), np.int64)
    if len(segment):
        first, last = (function.reduceat(segment, windows.start) for function in (np.minimum, np.maximum))
    borders = last - first + 2
    shift = np.cumsum(borders) - borders - first
    border = shutter.border[np.arange(borders.sum()) - np.repeat(shift, borders)]
    poses = shutter.body_from_lidar(bodies, np.repeat(windows.body, borders), border)
    return poses.astype(np.float32), segment + np.repeat(shift, windows.end - windows.start)


def _near(request: SweepRequest, shutter: Shutter, bodies: Bodies) -> Ints:
    """Return the rows of the bodies that may come within reach and are not hidden."""
    middle = shutter.sensor(np.array([0.5 * request.beams.columns]))[0, :2, 3]
    offset = bodies.path.xyz[:, :, :2] - middle
    distance = np.sqrt((offset * offset).sum(axis=2).min(axis=1))
    # A quarter more than the reach covers any motion within the time of a path.
    seen = distance - 0.5 * bodies.size[:, :2].sum(axis=1) <= 1.25 * float(request.beams.reach[:, 1].max())
    if request.hidden_id is not None:
        seen &= bodies.object_id != request.hidden_id
    return np.flatnonzero(seen)


def _by_fan(fan: Fan, request: SweepRequest, shutter: Shutter, bodies: Bodies, rows: Ints) -> Windows:
    azimuth = fan.azimuth[: request.beams.columns]
    of, first, after = _anywhere(request, shutter, bodies, rows).columns(azimuth, fan.spread)
    # Only these columns can meet the body, so only its poses while they fire matter.
    moments = first[:, None] + (after - first)[:, None] * _MOMENTS
    tight = angular_windows(_corners(shutter, bodies, rows[of], moments))
    top, bottom = tight.rings(fan.elevation, fan.spread)
    again, start, end = tight.arcs.columns(azimuth, fan.spread)
    start, end = np.maximum(start, first[again]), np.minimum(end, after[again])
    seen = np.flatnonzero((end > start) & (bottom > top)[again])
    again, start, count = again[seen], start[seen], end[seen] - start[seen]
    column = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - start, count)
    return Windows(rows[of[again]], top[again], bottom[again], np.cumsum(count) - count, np.cumsum(count), column)


def _by_cone(request: SweepRequest, shutter: Shutter, bodies: Bodies, rows: Ints) -> Windows:
    """Return the candidates of a rosette: all rings of the columns within a cone around each body."""
    beams = request.beams
    corners = _corners(shutter, bodies, rows, np.tile(beams.columns * _MOMENTS, (len(rows), 1)))
    near = angular_windows(corners).near
    direction = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    middle = direction.sum(axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    angle = np.arccos(np.clip(np.einsum("nki,ni->nk", direction, middle), -1.0, 1.0)).max(axis=1)
    angle += _CONE_MARGIN_RAD + halo(request.spec)
    found: list[tuple[int, Ints]] = []
    for row in range(len(rows)):
        seen = np.arange(beams.columns)
        if angle[row] < 0.5 * np.pi and near[row] > 0.0:
            along = np.einsum("i,irc->rc", middle[row].astype(np.float32), beams.axis[:, :, : beams.columns])
            seen = np.flatnonzero((along >= np.float32(np.cos(angle[row]))).any(axis=0))
        if len(seen):
            found.append((int(rows[row]), seen))
    count = np.array([len(seen) for _, seen in found], np.int64)
    return Windows(
        body=np.array([body for body, _ in found], np.int64),
        top=np.zeros(len(found), np.int64),
        bottom=np.full(len(found), beams.rings),
        start=np.cumsum(count) - count,
        end=np.cumsum(count),
        column=np.concatenate([np.zeros(0, np.int64), *(seen for _, seen in found)]),
    )


def _anywhere(request: SweepRequest, shutter: Shutter, bodies: Bodies, rows: Ints) -> Arcs:
    """Return arcs that hold the bodies during the whole sweep."""
    moments = request.beams.columns * _MOMENTS
    place, sensor = shutter.places(bodies, rows, moments), shutter.sensor(moments)
    centre = np.einsum("kji,nkj->nki", sensor[:, :, :3], place - sensor[:, :, 3])
    # A sphere around the middle of the footprint that holds the box however it leans.
    radius = np.sqrt(0.25 * (bodies.size[rows, :2] ** 2).sum(axis=1) + bodies.size[rows, 2] ** 2) + _GROW_M
    return arcs_of(centre[..., 0], centre[..., 1], radius[:, None])


def _corners(shutter: Shutter, bodies: Bodies, rows: Ints, moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 8 K, 3) corners of N bodies' boxes in the sensor frame at (N, K) moments in columns."""
    count = moments.shape[1]
    body_from_lidar = shutter.body_from_lidar(bodies, np.repeat(rows, count), moments.reshape(-1))
    rotation, place = body_from_lidar[:, :, :3], body_from_lidar[:, :, 3]
    local = _CORNERS * (bodies.size[rows, None] + _GROW_M) - np.array([0.0, 0.0, 0.5 * _GROW_M])
    corners = (np.repeat(local, count, axis=0) - place[:, None]) @ rotation
    return corners.reshape(len(rows), count * len(_CORNERS), 3)
