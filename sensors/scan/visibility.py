"""Visible fraction: share of an agent's rays on an object that nothing else blocks.

The rays of a sweep are the axes of its beams at their true firings, from where the sensor is to where the body is then
(rolling shutter of both), without noise, divergence and losses. Those that hit a body when it stands alone in an empty
world, within the range of their beam, are its rays; the fraction is the share of them that meets neither the static
world nor another body before. Detection (drop-off, dark paint, a pane that mirrors the light away) is left out: a
visible object may have no points, and corruptions change nothing.

Each body is tested by itself, in its own frame and only by the rays of its angular window; rays that hit one are
compared with the hits on the other bodies and cast once more at the static world. Of a near body that more than about
a thousand rays may meet, every n-th ray of each ring is taken, others in each ring: the fraction is then that of a
sample, within one or two hundredths.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sensors.raycast import SweepRequest
from sensors.scan.body_windows import body_windows, motion_of
from sensors.scan.lidar import Sensor, sweep_request
from sensors.scan.scene import RayScene
from sensors.scan.shutter import Shutter, beam_axes
from sensors.scan.visibility_kernel import Windows, aim_rays, body_poses, choose_rays, nearest_hits, seen_shares

_TOUCH_M = 0.02
"""Least distance behind the static world at which a body counts as hidden, m: tyres touch the road."""

_MOST_RAYS = 700

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


def visible_fraction(scene: RayScene, sensors: Sequence[Sensor], object_id: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the visible fraction of a scene's bodies for each sensor.

    Args:
        scene: static world and bodies around the sensors' times.
        sensors: A of them; their random numbers are neither used nor drawn.
        object_id: (N,) ids of bodies.

    Returns:
        (A, N) in [0, 1]; NaN where no ray would hit even the object alone, for the sensor's carrier and for an object
        that is not in the scene.

    Raises:
        DataError: NaN or infinity in a path.
    """
    share = np.full((len(sensors), len(object_id)), np.nan, np.float32)
    row_of = {number: row for row, number in enumerate(scene.bodies.object_id.tolist())}
    rows = np.array([row_of.get(number, -1) for number in np.asarray(object_id).tolist()], np.int64)
    known = np.flatnonzero(rows >= 0)
    for number, sensor in enumerate(sensors):
        request = sweep_request(sensor, rng=np.random.default_rng(0))
        share[number, known] = _shares(scene, request)[rows[known]]
    return share


def _shares(scene: RayScene, request: SweepRequest) -> Floats:
    """Return (B,) fractions of the scene's bodies, NaN where undefined."""
    beams, bodies = request.beams, scene.bodies
    shutter = Shutter(request, bodies.path.time_s)
    motion = motion_of(request, bodies)
    windows = body_windows(request, motion, bodies)
    lead, widest = _lead(request)
    ring, row, own, count = choose_rays(windows, _strides(windows, widest), lead, widest, beams.columns)
    pose, before = body_poses(motion, shutter.border, shutter.segment, windows)
    origin, direction = _aim(request, shutter, pose, before, ring, windows.column, row)
    solids = [bodies.solids[body] for body in windows.body]
    hits = scene.engine.cast_each(solids, count.tolist(), origin, direction, beams.reach[ring, 1])
    ray = ring * beams.columns + windows.column[row]
    nearest = nearest_hits(ray, hits.face, hits.distance, beams.rings * beams.columns)
    nearest[_hidden(scene, request, shutter, nearest)] = -np.inf
    least = beams.reach[:, 0]
    return seen_shares(windows.body, count, ray, own, hits.face, hits.distance, least, nearest, len(bodies))


def _strides(windows: Windows, widest: float) -> Ints:
    """Return (V,) n of every n-th ray that is taken of each ring of a window."""
    columns = np.maximum(windows.end - windows.start - 2.0 * widest, 1.0).astype(np.int64)
    return np.maximum((windows.bottom - windows.top) * columns // _MOST_RAYS, 1)


def _lead(request: SweepRequest) -> tuple[NDArray[np.float64], float]:
    """Return (R,) lead of each ring's azimuth in columns, and the largest."""
    fan, offset = request.beams.fan, request.spec.azimuth_offset
    if fan is None or not np.any(offset):
        return np.zeros(request.beams.rings), 0.0
    lead = -np.asarray(offset, np.float64) / float(fan.azimuth[1] - fan.azimuth[0])
    return lead, float(np.abs(lead).max())


def _hidden(scene: RayScene, request: SweepRequest, shutter: Shutter, nearest: Floats) -> Ints:
    """Return the rays that the static world blocks before their (R C,) nearest body, inf for no body."""
    rays = np.flatnonzero(np.isfinite(nearest))
    ring, column = np.divmod(rays, request.beams.columns)
    solid = scene.around(request)
    poses = shutter.sensor(shutter.border)
    poses[:, :, 3] -= solid.origin
    every = np.arange(request.beams.columns)
    origin, direction = _aim(request, shutter, poses.astype(np.float32), shutter.segment, ring, every, column)
    hits = scene.engine.cast(solid, origin, direction, nearest[rays] - np.float32(_TOUCH_M))
    return rays[hits.face >= 0]


def _aim(
    request: SweepRequest, shutter: Shutter, pose: Floats, before: Ints, ring: Ints, column: Ints, row: Ints
) -> tuple[Floats, Floats]:
    """Return (K, 3) origins and directions of rays; see `aim_rays`."""
    beams = request.beams
    return aim_rays(pose, before, shutter.timing, beam_axes(beams), beams.firing_share, ring, column, row)
