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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensors.raycast import SweepRequest
from sensors.scan.body_rays import BodyRays, body_rays
from sensors.scan.lidar import Sensor, sweep_request
from sensors.scan.scene import RayScene
from sensors.scan.shutter import SensorMotion, Shutter, beam_axes

_TOUCH_M = 0.02
"""Least distance behind the static world at which a body counts as hidden, m: tyres touch the road."""

_MOST_RAYS = 700
_GOLDEN = 0.6180339887

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
        request = sweep_request(replace(sensor, rng=np.random.default_rng(0)))
        share[number, known] = _shares(scene, request)[rows[known]]
    return share


def _shares(scene: RayScene, request: SweepRequest) -> Floats:
    """Return (B,) fractions of the scene's bodies, NaN where undefined."""
    beams, count = request.beams, len(scene.bodies)
    shutter = Shutter(request, scene.bodies.path.time_s)
    candidates, motion = body_rays(request, shutter, scene.bodies)
    met = _alone(scene, request, candidates, motion)
    nearest = np.full(beams.rings * beams.columns, np.inf, np.float32)
    np.minimum.at(nearest, met.ray, met.distance)
    nearest[_hidden(scene, request, shutter, nearest)] = -np.inf
    counts = met.own & (met.distance >= beams.reach[met.ray // beams.columns, 0])
    alone = np.bincount(met.body[counts], minlength=count)
    reaching = np.bincount(met.body[counts & (met.distance <= nearest[met.ray])], minlength=count)
    with np.errstate(invalid="ignore"):
        return (reaching / alone).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Met:
    """Hits of rays on bodies, each body alone.

    Attributes:
        body: (K,) rows of the bodies.
        ray: (K,) numbers of the rays, counted ring by ring.
        distance: (K,) m.
        own: (K,) whether the ray is of the body's own sample; the others are samples of bodies behind it.
    """

    body: Ints
    ray: Ints
    distance: Floats
    own: NDArray[np.bool_]


def _alone(scene: RayScene, request: SweepRequest, candidates: Sequence[BodyRays], motion: SensorMotion) -> _Met:
    """Cast the rays of a sweep at every body by itself."""
    ray, span, own, count = _chosen(request, candidates)
    ring, column = np.divmod(ray, request.beams.columns)
    origin, direction = _aim(request, motion, span, ring, column)
    solids = [scene.bodies.solids[candidate.body] for candidate in candidates]
    hits = scene.engine.cast_each(solids, count.tolist(), origin, direction, request.beams.reach[ring, 1])
    hit = hits.face >= 0
    body = np.repeat(np.array([candidate.body for candidate in candidates], np.int64), count)
    return _Met(body[hit], ray[hit], hits.distance[hit], own[hit])


def _chosen(request: SweepRequest, candidates: Sequence[BodyRays]) -> tuple[Ints, Ints, NDArray[np.bool_], Ints]:
    """Choose the rays that are cast at bodies.

    Returns:
        (K,) rays, one body after another; (K,) rows of their columns in the motion of all candidates; (K,) whether they
        are of their body's own sample; (V,) rays per candidate.
    """
    columns, rings = request.beams.columns, request.beams.rings
    shift, spread = _lead(request)
    every = np.arange(columns)
    wanted = np.zeros((rings, columns), bool)
    samples: list[tuple[Ints, NDArray[np.bool_] | None, NDArray[np.bool_] | None]] = []
    for candidate in candidates:
        column = every[candidate.columns]
        ring = np.arange(candidate.top, candidate.bottom)
        stride = max(1, len(ring) * int(max(len(column) - 2.0 * spread, 1.0)) // _MOST_RAYS)
        if stride == 1 and spread == 0.0:
            wanted[candidate.top : candidate.bottom, candidate.columns] = True
            samples.append((column, None, None))
            continue
        first = np.floor(stride * ((_GOLDEN * ring) % 1.0)).astype(np.int64)
        seen = np.ones((len(ring), len(column)), bool)
        if spread > 0.0:
            # The columns cover the rings with the largest offsets; each ring needs its own part of them.
            if column[0] > 0:
                seen &= column >= (column[0] + spread + shift[ring] - 1.0)[:, None]
            if column[-1] < columns - 1:
                seen &= column <= (column[-1] - spread + shift[ring] + 1.0)[:, None]
        own = seen if stride == 1 else seen & ((np.arange(len(column)) - first[:, None]) % stride == 0)
        wanted[candidate.top : candidate.bottom, candidate.columns] |= own
        samples.append((column, seen, own))
    rays, spans, owned = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, bool)]
    for candidate, (column, looked, mine) in zip(candidates, samples, strict=True):
        if looked is None or mine is None:
            rows = np.arange(candidate.top, candidate.bottom)[:, None] * columns
            places = np.arange(candidate.span.start, candidate.span.stop)
            rays.append((rows + column).reshape(-1))
            spans.append(np.tile(places, len(rows)))
            owned.append(np.ones(rays[-1].shape, bool))
            continue
        # Rays sampled for one body are cast at those before it too, or they could not hide it.
        row, at = np.nonzero(looked & wanted[candidate.top : candidate.bottom, candidate.columns])
        rays.append((candidate.top + row) * columns + column[at])
        spans.append(candidate.span.start + at)
        owned.append(mine[row, at])
    count = np.array([len(part) for part in rays[1:]], np.int64)
    return np.concatenate(rays), np.concatenate(spans), np.concatenate(owned), count


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
    origin, direction = _aim(request, shutter.motion(poses, shutter.segment), column, ring, column)
    hits = scene.engine.cast(solid, origin, direction, nearest[rays] - np.float32(_TOUCH_M))
    return rays[hits.face >= 0]


def _aim(request: SweepRequest, motion: SensorMotion, place: Ints, ring: Ints, column: Ints) -> tuple[Floats, Floats]:
    """Return (K, 3) origins and directions of rays, each with its column's place in a motion."""
    axes = beam_axes(request.beams)
    axis = axes[:, ring, column if axes.shape[2] > 1 else 0]
    pose = motion.start.take(place, axis=2)
    if motion.step is not None:
        pose += request.beams.firing_share[ring] * motion.step.take(place, axis=2)
    direction = pose[:, 0] * axis[0] + pose[:, 1] * axis[1] + pose[:, 2] * axis[2]
    return np.ascontiguousarray(pose[:, 3].T), np.ascontiguousarray(direction.T)
