"""Visible fraction: which share of an agent's rays on an object nothing else stops.

The rays of a sweep are the axes of its beams at their true firings, from where the sensor is to where the body is then
(rolling shutter of both), without noise, divergence and losses. Those that hit a body when it stands alone in an empty
world, within the range of their beam, are its rays; the fraction is the share of them that meets neither the static
world nor another body before. What the sensor then makes of an echo (drop-off, dark paint, a pane that mirrors it away)
changes nothing: a visible object may have no points, and a corruption hides nobody.

Alone means per body, so each is cast at by itself, in its own frame and only by the rays of its angular window; rays
that hit one are compared with the hits on the other bodies and cast once more at the static world. Of a body that is so
near that more than a thousand rays may meet it, every n-th ray of each ring is taken, others in each ring: the fraction
is then that of a sample, true to one or two hundredths.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensors.raycast import Shot
from sensors.raycast.public.shutter import Motion, Shutter, axes_of
from sensors.raycast.public.views import View, views_of
from sensors.scan.lidar import Sensor, shot_of
from sensors.scan.scene import RayScene

_TOUCH_M = 0.02
"""The static world hides what lies at least so far behind it: tyres touch the road."""

_MOST_RAYS = 700
_GOLDEN = 0.6180339887

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


def visible_fraction(scene: RayScene, sensors: Sequence[Sensor], object_id: NDArray[np.int64]) -> NDArray[np.float32]:
    """Measure how much of the bodies of a scene each of some sensors sees.

    Args:
        scene: static world and bodies around the sensors' times.
        sensors: A of them; their random numbers are neither used nor drawn.
        object_id: (N,) of whom.

    Returns:
        (A, N) in [0, 1]; NaN where not even the object alone would be hit, and for one that is not in the scene or that
        the sensor rides on.

    Raises:
        DataError: a path that is not finite.
    """
    share = np.full((len(sensors), len(object_id)), np.nan, np.float32)
    row_of = {number: row for row, number in enumerate(scene.bodies.object_id.tolist())}
    rows = np.array([row_of.get(number, -1) for number in np.asarray(object_id).tolist()], np.int64)
    known = np.flatnonzero(rows >= 0)
    for number, sensor in enumerate(sensors):
        shot = shot_of(replace(sensor, rng=np.random.default_rng(0)))
        share[number, known] = _shares(scene, shot)[rows[known]]
    return share


def _shares(scene: RayScene, shot: Shot) -> Floats:
    """Return (B,) the fraction of each of the scene's bodies, NaN where there is none."""
    beams, count = shot.beams, len(scene.bodies)
    shutter = Shutter(shot, scene.bodies.path.time_s)
    views, motion = views_of(shot, shutter, scene.bodies)
    met = _alone(scene, shot, views, motion)
    nearest = np.full(beams.rings * beams.columns, np.inf, np.float32)
    np.minimum.at(nearest, met.ray, met.distance)
    nearest[_hidden(scene, shot, shutter, nearest)] = -np.inf
    counts = met.own & (met.distance >= beams.reach[met.ray // beams.columns, 0])
    alone = np.bincount(met.body[counts], minlength=count)
    reaching = np.bincount(met.body[counts & (met.distance <= nearest[met.ray])], minlength=count)
    with np.errstate(invalid="ignore"):
        return (reaching / alone).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Met:
    """Rays and the bodies that they would meet if each stood alone.

    Attributes:
        body: (K,) rows of the bodies.
        ray: (K,) numbers of the rays, counted ring by ring.
        distance: (K,) m.
        own: (K,) whether the ray is of the body's own sample; others are there for what stands behind it.
    """

    body: Ints
    ray: Ints
    distance: Floats
    own: NDArray[np.bool_]


def _alone(scene: RayScene, shot: Shot, views: Sequence[View], motion: Motion) -> _Met:
    """Cast the rays of a sweep at every body by itself."""
    ray, span, own, count = _chosen(shot, views)
    ring, column = np.divmod(ray, shot.beams.columns)
    origin, direction = _aim(shot, motion, span, ring, column)
    solids = [scene.bodies.solids[view.body] for view in views]
    hits = scene.engine.cast_each(solids, count.tolist(), origin, direction, shot.beams.reach[ring, 1])
    hit = hits.face >= 0
    body = np.repeat(np.array([view.body for view in views], np.int64), count)
    return _Met(body[hit], ray[hit], hits.distance[hit], own[hit])


def _chosen(shot: Shot, views: Sequence[View]) -> tuple[Ints, Ints, NDArray[np.bool_], Ints]:
    """Choose the rays that are cast at bodies.

    Returns:
        (K,) rays, one view after another; (K,) places of their columns in the motion of all views; (K,) whether they
        are of their body's own sample; (V,) rays per view.
    """
    columns, rings = shot.beams.columns, shot.beams.rings
    shift, spread = _lead(shot)
    every = np.arange(columns)
    wanted = np.zeros((rings, columns), bool)
    samples: list[tuple[Ints, NDArray[np.bool_] | None, NDArray[np.bool_] | None]] = []
    for view in views:
        column = every[view.columns]
        ring = np.arange(view.top, view.bottom)
        stride = max(1, len(ring) * int(max(len(column) - 2.0 * spread, 1.0)) // _MOST_RAYS)
        if stride == 1 and spread == 0.0:
            wanted[view.top : view.bottom, view.columns] = True
            samples.append((column, None, None))
            continue
        first = np.floor(stride * ((_GOLDEN * ring) % 1.0)).astype(np.int64)
        seen = np.ones((len(ring), len(column)), bool)
        if spread > 0.0:
            # The view has room for the rings that look aside most; each ring needs its own part of it.
            if column[0] > 0:
                seen &= column >= (column[0] + spread + shift[ring] - 1.0)[:, None]
            if column[-1] < columns - 1:
                seen &= column <= (column[-1] - spread + shift[ring] + 1.0)[:, None]
        own = seen if stride == 1 else seen & ((np.arange(len(column)) - first[:, None]) % stride == 0)
        wanted[view.top : view.bottom, view.columns] |= own
        samples.append((column, seen, own))
    rays, spans, owned = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, bool)]
    for view, (column, looked, mine) in zip(views, samples, strict=True):
        if looked is None or mine is None:
            rows = np.arange(view.top, view.bottom)[:, None] * columns
            places = np.arange(view.span.start, view.span.stop)
            rays.append((rows + column).reshape(-1))
            spans.append(np.tile(places, len(rows)))
            owned.append(np.ones(rays[-1].shape, bool))
            continue
        # What one body is asked, those before it are asked too, or they could not hide it.
        row, at = np.nonzero(looked & wanted[view.top : view.bottom, view.columns])
        rays.append((view.top + row) * columns + column[at])
        spans.append(view.span.start + at)
        owned.append(mine[row, at])
    count = np.array([len(part) for part in rays[1:]], np.int64)
    return np.concatenate(rays), np.concatenate(spans), np.concatenate(owned), count


def _lead(shot: Shot) -> tuple[NDArray[np.float64], float]:
    """Return (R,) by how many columns earlier each ring looks where the sensor does, and the most of them."""
    fan, offset = shot.beams.fan, shot.spec.azimuth_offset
    if fan is None or not np.any(offset):
        return np.zeros(shot.beams.rings), 0.0
    lead = -np.asarray(offset, np.float64) / float(fan.azimuth[1] - fan.azimuth[0])
    return lead, float(np.abs(lead).max())


def _hidden(scene: RayScene, shot: Shot, shutter: Shutter, nearest: Floats) -> Ints:
    """Return the rays that the static world stops before they are at the (R C,) nearest body, inf for none."""
    rays = np.flatnonzero(np.isfinite(nearest))
    ring, column = np.divmod(rays, shot.beams.columns)
    solid = scene.around(shot)
    poses = shutter.sensor(shutter.border)
    poses[:, :, 3] -= solid.origin
    origin, direction = _aim(shot, shutter.motion(poses, shutter.segment), column, ring, column)
    hits = scene.engine.cast(solid, origin, direction, nearest[rays] - np.float32(_TOUCH_M))
    return rays[hits.face >= 0]


def _aim(shot: Shot, motion: Motion, place: Ints, ring: Ints, column: Ints) -> tuple[Floats, Floats]:
    """Return (K, 3) origins and directions of rays, each with its column's place in a motion."""
    axes = axes_of(shot.beams)[1]
    axis = axes[:, 0, ring, column if axes.shape[3] > 1 else 0]
    pose = motion.start.take(place, axis=2)
    if motion.step is not None:
        pose += shot.beams.firing_share[ring] * motion.step.take(place, axis=2)
    direction = pose[:, 0] * axis[0] + pose[:, 1] * axis[1] + pose[:, 2] * axis[2]
    return np.ascontiguousarray(pose[:, 3].T), np.ascontiguousarray(direction.T)
