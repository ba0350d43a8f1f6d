"""Line of sight between the agents' antennas and to objects, by rays through the LiDARs' scene."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sensors.scan.scene import RayScene
from sim.boxes import Boxes
from sim.geometry import pose_matrix, transform_points
from sim.radio import Obstruction

_CLEAR_M = 0.3
"""Radius around an antenna that counts as its own mount, m."""
_POINTS = np.array(
    [[x, y, z] for z in (-0.15, 0.3) for x, y in ((0.0, 0.0), (0.4, 0.4), (0.4, -0.4), (-0.4, 0.4), (-0.4, -0.4))]
)
"""Points of an object that are looked at, as shares of its length, width and height from its centre."""


def antennas(frame: Frame) -> NDArray[np.float64]:
    """Return (A, 3) places of the agents' antennas in the world, those of their LiDARs."""
    return np.array([agent.sweep.world_from_lidar[:3, 3] for agent in frame.agents], np.float64).reshape(-1, 3)


def lines_of_sight(scene: RayScene | None, frame: Frame) -> NDArray[np.int8]:
    """Return (A, A) `Obstruction` between the agents, the same both ways; the diagonal is free.

    Args:
        scene: static world, whose every surface blocks as a building, also a trunk or a pole; None where the world is
            unknown: only vehicles block.
        frame: agents and boxes of all moving objects.
    """
    place = antennas(frame)
    sight = np.zeros((len(place), len(place)), np.int8)
    first, second = np.triu_indices(len(place), 1)
    if len(first) == 0:
        return sight
    start, end = place[first], place[second]
    ids = np.array([agent.agent_id for agent in frame.agents])
    foreign = (frame.truth.object_id != ids[first, None]) & (frame.truth.object_id != ids[second, None])
    found = np.where((_crossed(frame.truth, start, end) & foreign).any(axis=1), Obstruction.VEHICLE, Obstruction.FREE)
    if scene is not None:
        found[_walled(scene, start, end)] = Obstruction.BUILDING
    sight[first, second] = sight[second, first] = found
    return sight


def seen_share(
    scene: RayScene, boxes: Boxes, places: NDArray[np.float64], carrier_ids: Sequence[int], rows: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return (A, K) shares of ten points in each of K objects that are in sight of A places.

    A cheap stand-in for `sensors.scan.visibility`: the static world blocks by rays, road users block as their boxes.
    An object never hides itself.

    Args:
        boxes: N road users, world frame.
        places: (A, 3) of the LiDARs, world frame, m.
        carrier_ids: object ids of what carries them, which does not block its own view; any other for none.
        rows: (K,) objects, as rows of `boxes`.
    """
    agents, objects, points = len(places), len(rows), len(_POINTS)
    if not agents or not objects:
        return np.zeros((agents, objects))
    at = boxes[rows]
    ends = transform_points(pose_matrix(at.center, at.yaw), _POINTS * at.size[:, None]).astype(np.float64)
    start = np.broadcast_to(places[:, None, None], (agents, objects, points, 3)).reshape(-1, 3)
    end = np.broadcast_to(ends, (agents, objects, points, 3)).reshape(-1, 3)
    blocked = _walled(scene, start, end)
    carrier = np.repeat(np.asarray(carrier_ids, np.int64), objects * points)
    target = np.tile(np.repeat(at.object_id, points), agents)
    free = np.flatnonzero(~blocked)
    foreign = (boxes.object_id != carrier[free, None]) & (boxes.object_id != target[free, None])
    blocked[free] = (_crossed(boxes, start[free], end[free]) & foreign).any(axis=1)
    return 1.0 - blocked.reshape(agents, objects, points).mean(axis=2)


def _walled(scene: RayScene, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (P,) whether the static world blocks the line between P pairs of places."""
    length = np.linalg.norm(end - start, axis=1)
    way = (end - start) / np.maximum(length, 1e-9)[:, None]
    hits = scene.cast(start + _CLEAR_M * way, way, float(length.max()))
    return (hits.face >= 0) & (hits.distance < length - 2.0 * _CLEAR_M)


def _crossed(boxes: Boxes, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (P, N) whether the segments between P pairs of places cross each box.

    Slab method in the frame of the box (Kay, Kajiya 1986).
    """
    cos, sin = np.cos(boxes.yaw), np.sin(boxes.yaw)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    turn = np.stack(
        [np.stack([cos, sin, zero], -1), np.stack([-sin, cos, zero], -1), np.stack([zero, zero, one], -1)], 1
    )
    origin = np.einsum("nij,pnj->pni", turn, start[:, None] - boxes.center)
    step = np.einsum("nij,pj->pni", turn, end - start)
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    near, far = (-0.5 * boxes.size - origin) / step, (0.5 * boxes.size - origin) / step
    enter = np.minimum(near, far).max(axis=2)
    leave = np.maximum(near, far).min(axis=2)
    return (enter <= leave) & (leave >= 0.0) & (enter <= 1.0)
