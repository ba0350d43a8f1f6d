"""Islands of worlds of version 2: ground of wide junctions over which no lane leads, raised by kerbs."""

from dataclasses import replace

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import rings_of
from sim.world.roads.kerbs import prolonged
from sim.world.roads.streets import Streets

_FREE_M = 0.5
"""Distance from lanes, m."""
_LONG_M, _WIDE_M, _STEP_M = (6.0, 12.0), 4.2, 1.0
"""Lengths of vehicles that cut corners, m; their width with what they keep free on both sides; distance of their
places along a lane."""
_NARROWEST_M, _LEAST_M2 = 1.6, 4.0
"""Width of the narrowest island, m: that of dividers with signs; refuges of people are 2 to 2.5 m wide (RASt 06, as
commonly quoted). Area of the smallest one."""


def with_islands(streets: Streets) -> Streets:
    """Return streets whose carriageways leave out the islands: what no lane, bay, crossing or long vehicle covers."""
    lanes = [
        shapely.LineString(lane.line).buffer(0.5 * lane.width + _FREE_M, cap_style="square")
        for lane in streets.lanes
        if lane.kind in ("road", "bicycle", "crossing", "rail")
    ]
    unused = streets.road - shapely.union_all([*lanes, streets.bays.buffer(_FREE_M)])
    near = [lane.line for lane in streets.lanes if lane.kind == "road"]
    near = [line for line in near if shapely.dwithin(unused, shapely.LineString(line), _LONG_M[-1])]
    swept = np.concatenate([np.zeros(0, object), *map(_swept, near)])
    unused -= shapely.union_all(shapely.buffer(swept[shapely.dwithin(swept, unused, 0.5 * _WIDE_M)], 0.5 * _WIDE_M))
    wide = unused.buffer(-0.5 * _NARROWEST_M).buffer(0.5 * _NARROWEST_M).simplify(0.03)
    islands = shapely.MultiPolygon([shape for shape in rings_of(wide) if shape.area >= _LEAST_M2])
    return replace(streets, road=streets.road - islands, islands=islands)


def _swept(line: Array) -> Array:
    """Return the axes of long vehicles, as chords of the way along a lane."""
    way = prolonged(line, _LONG_M[-1])
    chords = []
    for long_m in _LONG_M:
        back = np.arange(0.0, max(way.length - long_m, 0.0) + _STEP_M, _STEP_M)
        ends = shapely.line_interpolate_point(way, np.stack([back, back + long_m], axis=1))
        chords.append(shapely.linestrings(shapely.get_coordinates(ends).reshape(-1, 2, 2)))
    return np.concatenate(chords)
