"""Following of scripted actors: the safe speed behind bodies ahead on their path."""

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.traffic.base import Actors
from sim.traffic.scripted.mover import Mover

_REACTION_S = 0.5
_LOOK_AHEAD_M = 60.0
_BESIDE_M = 0.2


def safe_speed(mover: Mover, before: Actors, ahead: NDArray[np.bool_]) -> float:
    """Return the highest speed at which an actor can still stop behind the bodies on its path, m/s; inf for a free one.

    Krauss, *Microscopic modeling of traffic flow* (1998): the leader may brake as hard as its follower, which reacts
    after `_REACTION_S`.

    Args:
        ahead: (N,) bodies to mind.
    """
    if not mover.actor.pace.speed_mps.any():
        return math.inf  # it stands all the time
    path, kind = mover.actor.path, mover.actor.kind
    length, width, _ = kind.size
    inside = (path.along >= mover.at_m) & (path.along <= mover.at_m + _LOOK_AHEAD_M)
    if inside.sum() < 2:
        return math.inf
    way, reach = path.points[inside, :2], 0.5 * width + _BESIDE_M
    # Cutting polygons takes a hundred times as long as this: most bodies are nowhere near the way.
    far = np.hypot(before.boxes.size[:, 0], before.boxes.size[:, 1])[:, None] + reach
    center = before.boxes.center[:, :2]
    near = ((center >= way.min(axis=0) - far) & (center <= way.max(axis=0) + far)).all(axis=1)
    rows = np.flatnonzero(ahead & near)
    if not len(rows):
        return math.inf
    line = shapely.LineString(way)
    strip = line.buffer(reach, cap_style="flat")
    limit = math.inf
    bodies = shapely.polygons(before.boxes[rows].bev_polygons())
    for row, body in zip(rows, bodies, strict=True):
        if not strip.intersects(body):
            continue
        corners = shapely.points(shapely.get_coordinates(strip & body))
        gap = float(np.min(shapely.line_locate_point(line, corners))) - 0.5 * length - 1.0
        if gap < -0.5 * length:
            continue  # it is beside or behind
        heading = path.at(mover.at_m + max(gap, 0.0))[1]
        lead = max(0.0, float(before.velocity[row] @ [np.cos(heading), np.sin(heading)]))
        brakes = kind.accel_mps2[1]
        square = (brakes * _REACTION_S) ** 2 + lead**2 + 2.0 * brakes * max(gap, 0.0)
        limit = min(limit, -brakes * _REACTION_S + math.sqrt(square))
    return max(limit, 0.0)
