"""Road markings: lane lines, centre lines, edge lines, stop lines and zebra crossings."""

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import MeshPart, carpet, strip
from sim.world.roads.streets import Lane, Streets
from sim.world.roads.surfaces import TOWN_SPEED_MPS

LIFT_M = 0.01
"""Height of paint above the road, m, to avoid coplanar surfaces."""

_LINE_M = 0.12
_STOP_M = 0.5


def markings(streets: Streets) -> list[MeshPart]:
    """Return the markings of all lanes."""
    frame = shapely.box(*streets.window)
    lines: list[tuple[Array, float]] = []
    for lane in streets.lanes:
        if lane.kind == "crossing":
            # A zebra crossing: half a metre of paint in each metre, across its width.
            lines += [(cut, lane.width) for cut in dashes(lane.line, 0.5, 0.5)]
        elif lane.kind == "road" and not lane.internal:
            lines += _lane_lines(lane)
    inside = [(line, width) for line, width in lines if frame.contains(shapely.LineString(line))]
    return paint([(offset(line, 0.5 * width), offset(line, -0.5 * width)) for line, width in inside], streets)


def paint(bands: list[tuple[Array, Array]], streets: Streets) -> list[MeshPart]:
    """Return the paint between lines, (K, 2) left and right of each band, on the road."""
    if streets.terrain.flat:
        return [strip(left, right, streets.height, LIFT_M, "marking") for left, right in bands]
    shapes = shapely.make_valid(np.array([shapely.Polygon([*left, *right[::-1]]) for left, right in bands]))
    return [carpet(streets.terrain.cut(shapely.union_all(shapes)), streets.terrain.height, LIFT_M, "marking")]


def _lane_lines(lane: Lane) -> list[tuple[Array, float]]:
    """Return (line, width) of the markings of a lane: inner border, edge at the kerb, end."""
    fast = lane.speed > TOWN_SPEED_MPS
    dash, gap = (6.0, 12.0) if fast else (3.0, 6.0)
    found: list[tuple[Array, float]] = []
    large = lane.count > 1 or fast
    side = -lane.kerb_side
    inner = offset(lane.line, side * 0.5 * lane.width)
    if lane.index + 1 < lane.count:
        found += [(cut, _LINE_M) for cut in dashes(inner, dash, gap)]
    elif lane.opposite and lane.count == 1:
        # Both directions share this border: each paints every other dash.
        found += [(cut, _LINE_M) for cut in dashes(inner, dash, 2.0 * gap + dash)]
    elif large:
        found.append((offset(lane.line, side * (0.5 * lane.width - _LINE_M)), _LINE_M))
    if lane.index == 0 and large:
        found.append((offset(lane.line, side * (-0.5 * lane.width + _LINE_M)), _LINE_M))
    length = _length(lane.line)
    if lane.stop and length > 6.0 and lane.speed > 8.0:
        end = cut_line(lane.line, length - 0.9, length - 0.9 + _STOP_M)
        if lane.stop == "signal":
            found.append((end, 0.92 * lane.width))
        else:
            half = 0.4 * lane.width
            found += [(offset(end, side), 0.5) for side in np.linspace(-half, half, 4)]
    return found


def dashes(line: Array, dash_m: float, gap_m: float) -> list[Array]:
    """Return the dashes of a (K, 2) line, the first after half a gap."""
    length = _length(line)
    starts = np.arange(0.5 * gap_m, length - dash_m, dash_m + gap_m)
    return [cut_line(line, start, start + dash_m) for start in starts]


def cut_line(line: Array, start_m: float, end_m: float) -> Array:
    """Return the part of a (K, 2) line between two distances along it."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    inside = (along > start_m + 1e-3) & (along < end_m - 1e-3)
    at = np.concatenate([[start_m], along[inside], [end_m]])
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def offset(line: Array, left_m: float) -> Array:
    """Return a (K, 2) line offset to its left, with mitred corners."""
    way = np.diff(line, axis=0)
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    normal = np.column_stack([-way[:, 1], way[:, 0]])
    before, after = np.concatenate([normal[:1], normal]), np.concatenate([normal, normal[-1:]])
    middle = before + after
    # A mitre grows with the turn; beyond a right angle it is kept short.
    scale = 2.0 / np.maximum((middle**2).sum(axis=1), 2.0)
    return line + left_m * middle * scale[:, None]


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())
