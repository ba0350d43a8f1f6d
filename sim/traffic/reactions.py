"""Reactions of background drivers to a body that their simulation does not see, such as an ego off its lanes."""

import math
from collections.abc import Callable, Collection

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.traffic.base import Actors, Limits

REACTION_S = 0.75
"""Time from when a body is in a driver's way to braking, s: that of the careful driver of UN R157."""

NEAR_M = 40.0
"""Distance within which drivers look for such bodies, m."""

_AHEAD_S, _LEAST_AHEAD_M = 2.5, 6.0
_BESIDE_M = 0.3
_STOP_M = 2.0
_RELEASE_S = 0.5


class YieldShim:
    """Brakes of background drivers before bodies that the traffic simulation does not see.

    SUMO often misses an ego off its route's lanes, across them, or at an angle inside a junction: cars drive through
    it. A driver whose way of the next 2.5 s meets such a body brakes after a reaction time, as hard as it takes to stop
    before it and as its vehicle can, and drives on half a second after it has gone.
    """

    def __init__(self) -> None:
        self._since: dict[int, float] = {}
        self._last: dict[int, float] = {}

    def speeds(
        self,
        actors: Actors,
        unseen: Collection[int],
        drivers: Collection[int],
        route: Callable[[int, float], NDArray[np.float64]],
        limits: Callable[[int], Limits],
        step_s: float,
    ) -> dict[int, float]:
        """Return the highest speeds of the drivers who brake in the next step, by object id, m/s.

        Args:
            unseen: ids of the bodies that the simulation does not see.
            drivers: ids of the vehicles that may brake.
        """
        bodies = [
            (actors.boxes.center[row, :2], shapely.Polygon(actors.boxes[row : row + 1].bev_polygons()[0]))
            for row in map(actors.row, unseen)
        ]
        found = {}
        for driver in sorted(set(drivers) - set(unseen)):
            row = actors.row(driver)
            near = [body for center, body in bodies if math.dist(center, actors.boxes.center[row, :2]) < NEAR_M]
            speed = float(np.hypot(*actors.velocity[row]))
            gap = _gap(actors, row, near, route, speed) if near else math.inf
            if math.isfinite(gap):
                self._since.setdefault(driver, actors.time_s)
                self._last[driver] = actors.time_s
            elif actors.time_s - self._last.get(driver, -math.inf) > _RELEASE_S:
                self._since.pop(driver, None)
            if actors.time_s - self._since.get(driver, math.inf) < REACTION_S - 1e-9:
                continue
            if driver in self._since:
                room = max(gap - _STOP_M, 0.0)
                full = limits(driver).deceleration_mps2
                brakes = 0.0 if math.isinf(gap) else full if room <= 0.0 else min(speed**2 / (2.0 * room), full)
                found[driver] = max(speed - brakes * step_s, 0.0)
        return found


def _gap(
    actors: Actors,
    row: int,
    bodies: list[shapely.Polygon],
    route: Callable[[int, float], NDArray[np.float64]],
    speed: float,
) -> float:
    """Return the gap from a driver's front along its way to the first of the bodies, m; inf for a free way."""
    length, width, _ = actors.boxes.size[row]
    way = route(int(actors.boxes.object_id[row]), 0.5 * length + max(_AHEAD_S * speed, _LEAST_AHEAD_M))
    line = shapely.LineString(way)
    strip = line.buffer(0.5 * width + _BESIDE_M, cap_style="flat")
    nearest = math.inf
    for body in bodies:
        if strip.intersects(body):
            corners = shapely.points(shapely.get_coordinates(strip & body))
            along = float(np.min(shapely.line_locate_point(line, corners)))
            # A body beside or behind the middle of the car is passed.
            if along > 0.0:
                nearest = min(nearest, max(along - 0.5 * length, 0.0))
    return nearest
