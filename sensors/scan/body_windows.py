"""Windows of bodies: rays of a sweep that may meet a body."""

import numpy as np
from numpy.typing import NDArray

from sensors.optics.beams import halo
from sensors.raycast.base import Bodies, SweepRequest
from sensors.scan.angular_windows import angles_of
from sensors.scan.visibility_kernel import Motion, Windows, corners_of, fan_windows

_CONE_MARGIN_RAD = np.radians(0.3)

Ints = NDArray[np.int64]


def motion_of(request: SweepRequest, bodies: Bodies) -> Motion:
    """Return the motion of a sensor among bodies."""
    path, columns = bodies.path, request.beams.columns
    return Motion(
        request.knots,
        columns,
        float(request.time_s),
        float(request.spec.column_s),
        path.time_s,
        np.ascontiguousarray(path.xyz),
        np.ascontiguousarray(path.angles),
        bodies.size,
    )


def body_windows(request: SweepRequest, motion: Motion, bodies: Bodies) -> Windows:
    """Return the windows of the bodies that may come within reach and are not hidden."""
    rows, fan = _near(request, bodies), request.beams.fan
    if fan is None:
        return _by_cone(request, motion, rows)
    return fan_windows(motion, rows, fan.azimuth[: request.beams.columns], fan.elevation, fan.spread)


def _near(request: SweepRequest, bodies: Bodies) -> Ints:
    """Return the rows of the bodies that may come within reach and are not hidden."""
    middle = request.pose[:2, 3]
    offset = bodies.path.xyz[:, :, :2] - middle
    distance = np.sqrt((offset * offset).sum(axis=2).min(axis=1))
    # A quarter more than the reach covers any motion within the time of a path.
    seen = distance - 0.5 * bodies.size[:, :2].sum(axis=1) <= 1.25 * float(request.beams.reach[:, 1].max())
    if request.hidden_id is not None:
        seen &= bodies.object_id != request.hidden_id
    return np.flatnonzero(seen)


def _by_cone(request: SweepRequest, motion: Motion, rows: Ints) -> Windows:
    """Return the candidates of a rosette: all rings of the columns within a cone around each body."""
    beams = request.beams
    found: list[tuple[int, Ints]] = []
    for row in rows.tolist():
        corners = corners_of(motion, row, 0.0, float(beams.columns))
        direction = corners / np.linalg.norm(corners, axis=1, keepdims=True)
        middle = direction.sum(axis=0)
        middle /= max(float(np.linalg.norm(middle)), 1e-9)
        angle = np.arccos(np.clip(direction @ middle, -1.0, 1.0)).max() + _CONE_MARGIN_RAD + halo(request.spec)
        seen = np.arange(beams.columns)
        if angle < 0.5 * np.pi and angles_of(corners).near > 0.0:
            along = np.einsum("i,irc->rc", middle.astype(np.float32), beams.axis[:, :, : beams.columns])
            seen = np.flatnonzero((along >= np.float32(np.cos(angle))).any(axis=0))
        if len(seen):
            found.append((row, seen))
    count = np.array([len(seen) for _, seen in found], np.int64)
    return Windows(
        body=np.array([body for body, _ in found], np.int64),
        top=np.zeros(len(found), np.int64),
        bottom=np.full(len(found), beams.rings),
        start=np.cumsum(count) - count,
        end=np.cumsum(count),
        column=np.concatenate([np.zeros(0, np.int64), *(seen for _, seen in found)]),
    )
