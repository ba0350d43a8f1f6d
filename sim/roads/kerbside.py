"""Parking bays: footways moved away from the carriageway between junctions to make room."""

import re
from pathlib import Path

import numpy as np
import shapely

from sim.geometry import Array
from sim.roads.polygons import has_buildings, read_outlines
from sim.roads.rounding import line_of, text_of

ROOM_M = 2.5
"""Shift of a footway away from the carriageway, m."""

_STAY_M, _SHIFT_M = 7.0, 5.0
"""Unshifted length at each end of a footway, and length of the transition, m."""

_LEAST_M = 45.0
_CAR_LANES = 2
_SPEED_MPS = (5.0, 14.5)
_LANE = re.compile(r'<lane id="([^":]+)_(\d+)"[^>]*>')
_ATTRIBUTE = re.compile(r' (\w+)="([^"]*)"')


def with_room_to_park(text: str, houses: list[shapely.Geometry]) -> str:
    """Return the text of a .net.xml whose footways make room for parked cars on streets of at most 50 km/h.

    Ends of footways stay, so that crossings still meet them; no footway moves into a house or another street.
    """
    streets: dict[str, list[dict[str, str]]] = {}
    for found in _LANE.finditer(text):
        streets.setdefault(found[1], []).append(dict(_ATTRIBUTE.findall(found[0])))
    others = [_band(lane) for lanes in streets.values() for lane in lanes if lane.get("allow") != "pedestrian"]
    tree = shapely.STRtree([*houses, *others])
    moved = {}
    side = 1.0 if 'lefthand="true"' in text[: text.find("<location")] else -1.0
    for lanes in streets.values():
        line = _aside(lanes, side)
        if line is not None:
            # Unshifted, it touches the lane beside it.
            free = _band(lanes[0] | {"shape": text_of(line)}).buffer(-0.2)
            if not len(tree.query(free, predicate="intersects")):
                moved[lanes[0]["id"]] = text_of(line)

    def rewrite(found: re.Match[str]) -> str:
        shape = moved.get(f"{found[1]}_{found[2]}")
        return found[0] if shape is None else re.sub(r'shape="[^"]*"', f'shape="{shape}"', found[0])

    return _LANE.sub(rewrite, text)


def _band(lane: dict[str, str]) -> shapely.Polygon:
    half = 0.5 * float(lane.get("width", "3.2"))
    return shapely.LineString(line_of(lane["shape"])[:, :2]).buffer(half, cap_style="flat")


def _aside(lanes: list[dict[str, str]], side: float) -> Array | None:
    """Return the shifted line of a footway, to the left for side 1 and the right for -1; None without parking."""
    foot, beside = lanes[0], lanes[1] if len(lanes) > 1 else {}
    if foot.get("allow") != "pedestrian" or "passenger" in beside.get("disallow", "").split():
        return None
    if not beside or ("allow" in beside and "passenger" not in beside["allow"].split()):
        return None
    low, high = _SPEED_MPS
    if len(lanes) > 1 + _CAR_LANES or not low <= float(beside["speed"]) <= high:
        return None
    line = line_of(foot["shape"])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    if along[-1] < _LEAST_M:
        return None
    bends = [_STAY_M, _STAY_M + _SHIFT_M, along[-1] - _STAY_M - _SHIFT_M, along[-1] - _STAY_M]
    at = np.unique(np.concatenate([along, bends]))
    out = np.interp(at, bends, [0.0, ROOM_M, ROOM_M, 0.0])
    dense = np.column_stack([np.interp(at, along, line[:, k]) for k in range(line.shape[1])])
    way = np.gradient(dense[:, :2], axis=0)
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    dense[:, :2] += side * out[:, None] * np.column_stack([-way[:, 1], way[:, 0]])
    return dense


def houses_of(polygons: Path | None) -> list[shapely.Geometry]:
    """Return the building outlines of a .poly.xml file; empty without a file."""
    if polygons is None or not has_buildings(polygons):
        return []
    return [outline.shape for outline in read_outlines(polygons)]
