"""Swept ground of worlds of version 2: corners that long vehicles cut, and islands that no vehicle reaches.

A vehicle follows its lane with its front, and its rear cuts corners, as `sim.traffic.sumo.motion` moves it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.ops import substring

from sim.geometry import Array, wrap_angle
from sim.mesh.solids import rings_of
from sim.traffic.sumo.motion import BodyMotion
from sim.world.roads.streets import Lane, Streets, heading

_LONG_M, _WIDE_M = np.array([6.0, 12.0, 16.5]), 2.6
"""Lengths of vehicles, m, the longest that of articulated ones (directive 96/53/EC), and width of the widest
without its mirrors, m."""
_BEHIND_M, _AHEAD_M, _STEP_M, _MEET_M = 16.5, 35.0, 1.0, 0.3
"""Lengths of their ways before and behind a lane in a junction, distance of their places along these, and distance
within which lanes go on, m."""
_BACK_RAD, _ASIDE_M = np.radians(150.0), 0.2
"""Turn from which on a way leads back, where long vehicles do not turn, and distance of the rear from the way from
which a body leaves its lane, m."""
_OVER_M, _GAP_M, _EVEN_M = 0.05, 1.0, 0.1
"""What a body may reach over a carriageway, m, half the width of gaps in the ground that bodies sweep, m, and how
exactly its outline is kept, m."""
_FREE_M, _BESIDE_M = 0.5, 0.8
"""Distances of islands from lanes, and from vehicles that pass them, m."""
_NARROWEST_M, _LEAST_M2 = 1.6, 4.0
"""Width of the narrowest island, m: that of dividers with signs; refuges of people are 2 to 2.5 m wide (RASt 06, as
commonly quoted). Area of the smallest one."""


def swept_axes(streets: Streets) -> NDArray[np.object_]:
    """Return the (N,) axes of long vehicles that leave their lanes in junctions, as lines between their ends."""
    ways = np.array(list(_ways([lane for lane in streets.lanes if lane.kind == "road"])), object)
    way, long_m = np.repeat(ways, len(_LONG_M)), np.tile(_LONG_M, len(ways))
    numbers, bodies = np.arange(len(way)), BodyMotion(_STEP_M)
    bodies.make_room(len(way))
    angle_deg = np.array([90.0 - np.degrees(heading(line.coords[:2])) for line in way])
    axes, driven_m = [np.zeros(0, object)], shapely.length(way)
    for at_m in np.arange(0.0, driven_m.max(initial=0.0), _STEP_M):
        front = shapely.get_coordinates(shapely.line_interpolate_point(way, at_m))
        yaw = np.radians(90.0 - bodies.follow(numbers, front, angle_deg, long_m))
        rear = front - long_m[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        leaves = (at_m >= long_m) & (at_m < driven_m) & (shapely.distance(shapely.points(rear), way) > _ASIDE_M)
        axes.append(shapely.linestrings(np.stack([front, rear], axis=1)[leaves]))
    return np.concatenate(axes)


def with_swept(streets: Streets, axes: NDArray[np.object_]) -> Streets:
    """Return streets that know the ground beside their carriageways that long vehicles sweep.

    Args:
        axes: see `swept_axes`.
    """
    bodies = shapely.buffer(axes, 0.5 * _WIDE_M, cap_style="flat")
    shapely.prepare(held := streets.road.buffer(_OVER_M))
    beside = shapely.union_all(bodies[~shapely.covers(held, bodies)]) & shapely.box(*streets.window)
    smooth = beside.buffer(_GAP_M, join_style="mitre").buffer(-_GAP_M, join_style="mitre").simplify(_EVEN_M)
    return replace(streets, swept=shapely.MultiPolygon(rings_of(smooth.buffer(0) - streets.road - streets.rail)))


def with_islands(streets: Streets, axes: NDArray[np.object_]) -> Streets:
    """Return streets whose carriageways leave out the islands: what no lane, bay, crossing or long vehicle covers.

    Args:
        axes: see `swept_axes`.
    """
    lanes = [
        shapely.LineString(lane.line).buffer(0.5 * lane.width + _FREE_M, cap_style="square")
        for lane in streets.lanes
        if lane.kind in ("road", "bicycle", "crossing", "rail")
    ]
    unused = streets.road - shapely.union_all([*lanes, streets.bays.buffer(_FREE_M)])
    half_m = 0.5 * _WIDE_M + _BESIDE_M
    unused -= shapely.union_all(shapely.buffer(axes[shapely.dwithin(axes, unused, half_m)], half_m))
    wide = unused.buffer(-0.5 * _NARROWEST_M).buffer(0.5 * _NARROWEST_M).simplify(0.03)
    islands = shapely.MultiPolygon([shape for shape in rings_of(wide) if shape.area >= _LEAST_M2])
    walk = streets.walk | (islands & streets.on_foot)
    return replace(streets, road=streets.road - islands, walk=walk, islands=islands)


def _ways(lanes: Sequence[Lane]) -> Iterator[shapely.LineString]:
    """Yield the way of each lane in a junction, with what lies before and behind it, but for those that lead back."""
    lines = [lane.line for lane in lanes]
    begins, ends = (cKDTree(np.array([line[at] for line in lines]).reshape(-1, 2)) for at in (0, -1))
    backward = [line[::-1] for line in lines]
    for lane in lanes:
        if lane.internal:
            before = _goes_on(lane.line[::-1], backward, ends, _BEHIND_M)[::-1]
            way = np.concatenate([before, lane.line, _goes_on(lane.line, lines, begins, _AHEAD_M)])
            if abs(wrap_angle(heading(way[-2:]) - heading(way[:2]))) < _BACK_RAD:
                yield shapely.LineString(way)


def _goes_on(line: Array, lines: Sequence[Array], begins: cKDTree, left_m: float) -> Array:
    """Return the corners of the straightest way on from the end of a line, as far as is asked."""
    way = [np.zeros((0, 2))]
    while left_m > 0.0 and (rows := begins.query_ball_point(line[-1], _MEET_M)):
        line = min(
            (lines[row] for row in rows), key=lambda on: abs(wrap_angle(heading(on[[0, -1]]) - heading(line[-2:])))
        )
        way.append(np.asarray(shapely.get_coordinates(substring(shapely.LineString(line), 0.0, left_m))))
        left_m -= shapely.LineString(line).length
    return np.concatenate(way)
