"""Corridor ahead of the ego: nearest obstacle and its gap."""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.boxes import Boxes


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Nearest box in the corridor.

    Attributes:
        gap: from the ego's front bumper along the path to the box, m; inf when the corridor is free.
        row: row of the box, -1 when the corridor is free.
        heading: direction of the path at the box, rad.
    """

    gap: float
    row: int
    heading: float


FREE = Obstacle(math.inf, -1, 0.0)


def nearest_obstacle(
    path: NDArray[np.float64], boxes: Boxes, ego_length: float, ego_width: float, margin: float = 0.3
) -> Obstacle:
    """Return the nearest box that overlaps the strip swept by the ego along its path.

    Args:
        path: (K, 2) polyline that begins at the ego's centre, in the frame of `boxes`, m.
        boxes: N boxes.
        ego_length: m.
        ego_width: m.
        margin: clearance on each side, m.
    """
    if len(path) < 2 or len(boxes) == 0:
        return FREE
    line = shapely.LineString(path)
    # A flat cap ends the strip at the end of the path, not half a width beyond it.
    strip = line.buffer(0.5 * ego_width + margin, cap_style="flat")
    footprints = shapely.polygons(boxes.bev_polygons())
    best = FREE
    for row in np.flatnonzero(shapely.intersects(strip, footprints)):
        overlap = shapely.intersection(strip, footprints[row])
        corners = shapely.points(shapely.get_coordinates(overlap))
        along = float(np.min(shapely.line_locate_point(line, corners)))
        if along <= 1e-6 and math.dist(path[0], boxes.center[row, :2]) < 0.5 * ego_length:
            continue  # the ego itself, or a box it overlaps: a collision, not an obstacle
        gap = max(along - 0.5 * ego_length, 0.0)
        if gap < best.gap:
            best = Obstacle(gap, int(row), _heading(line, along))
    return best


def _heading(line: shapely.LineString, along: float) -> float:
    """Direction of a polyline at a distance along it, rad."""
    here, there = line.interpolate(along), line.interpolate(min(along + 1.0, line.length))
    if here.equals(there):
        here = line.interpolate(max(along - 1.0, 0.0))
    return math.atan2(there.y - here.y, there.x - here.x)
