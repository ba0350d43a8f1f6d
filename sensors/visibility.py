"""Visible fraction: which share of an agent's rays on an object nothing else stops.

The rays of a sweep are the axes of its beams at their true firings, from where the sensor is to where the body is then
(rolling shutter of both), without noise, divergence and losses. Those that hit a body when it stands alone in an empty
world, within the range of their beam, are its rays; the fraction is the share of them that meets neither the static
world nor another body before. What the sensor then makes of an echo (drop-off, dark paint, a pane that mirrors it away)
changes nothing: a visible object may have no points, and a corruption hides nobody.

Alone means per body, so each is cast at by itself, in its own frame and only by the rays of its angular window; rays
that hit one are compared with the hits on the other bodies and cast once more at the static world.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.lidar import Sensor, shot_of
from sensors.raycast import Shot
from sensors.raycast.shutter import Motion, Shutter, axes_of
from sensors.raycast.views import View, views_of
from sensors.scene import RayScene

_TOUCH_M = 0.02
"""The static world hides what lies at least so far behind it: tyres touch the road."""

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
    body, rays, distance = _alone(scene, shot, views, motion)
    nearest = np.full(beams.rings * beams.columns, np.inf, np.float32)
    np.minimum.at(nearest, rays, distance)
    nearest[_hidden(scene, shot, shutter, nearest)] = -np.inf
    ring = rays // beams.columns
    counts = distance >= beams.reach[ring, 0]
    alone = np.bincount(body[counts], minlength=count)
    reaching = np.bincount(body[counts & (distance <= nearest[rays])], minlength=count)
    with np.errstate(invalid="ignore"):
        return (reaching / alone).astype(np.float32)


def _alone(scene: RayScene, shot: Shot, views: Sequence[View], motion: Motion) -> tuple[Ints, Ints, Floats]:
    """Return who is hit by which ray and where, m, when everybody stands alone: (K,) rows of bodies, rays, distances.

    The rays of a sweep count ring by ring.
    """
    columns = shot.beams.columns
    width = np.array([view.span.stop - view.span.start for view in views], np.int64)
    rings = np.array([view.bottom - view.top for view in views], np.int64)
    size = width * rings
    after = np.cumsum(size)
    # Each ray's place among those of its view, thus its ring, and its column's place in the motion of all views.
    place = np.arange(size.sum()) - np.repeat(after - size, size)
    down, along = np.divmod(place, np.repeat(width, size))
    ring = down + np.repeat([view.top for view in views], size)
    span = along + np.repeat([view.span.start for view in views], size)
    every = np.arange(columns)
    column = np.concatenate([np.zeros(0, np.int64), *(every[view.columns] for view in views)])[span]
    origin, direction = _aim(shot, motion, span, ring, column)
    distance = shot.beams.reach[ring, 1]
    hit = np.zeros(len(ring), bool)
    for view, end, length in zip(views, after.tolist(), size.tolist(), strict=True):
        rows = slice(end - length, end)
        hits = scene.engine.cast(scene.bodies.solids[view.body], origin[rows], direction[rows], distance[rows])
        hit[rows], distance[rows] = hits.face >= 0, hits.distance
    body = np.repeat(np.array([view.body for view in views], np.int64), size)
    return body[hit], (ring * columns + column)[hit], distance[hit]


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
    return pose[:, 3].T, direction.T
