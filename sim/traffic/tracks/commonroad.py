"""Tracks in a CommonRoad XML, versions 2018b and 2020a: obstacles with trajectories, lanelets as road surface.

Source: CommonRoad scenario documentation, XML formats 2018b and 2020a: positions are those of the origin of a shape,
which may lie off its centre; times are numbers of steps of `timeStepSize`; values are exact or intervals.
"""

import logging
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint
from sim.reading import parsing, read_bytes
from sim.traffic.tracks.base import GAP_S, Recording, Track, class_of, make_track

VERSIONS = ("2018b", "2020a")

_log = logging.getLogger(__name__)


def read_commonroad(path: Path) -> Recording:
    """Read obstacles and lanelets.

    Static obstacles stand for the whole time. Obstacles that are no road users, and those whose motion is a set of
    occupancies, are left out and named in the log. An interval is its middle.

    Raises:
        DataError: no CommonRoad file of these versions, or a value is missing or wrong; names the obstacle.
    """
    content = read_bytes(path, "CommonRoad file")
    with parsing(path, "CommonRoad file"):
        root = ET.fromstring(content)
        version = root.get("commonRoadVersion", "")
        if root.tag != "commonRoad" or version not in VERSIONS:
            found = f"<{root.tag}> {version}".strip()
            raise DataError(complaint(path, "root", f"<commonRoad> of version {' or '.join(VERSIONS)}", found))
        return _recording(path, root)


def _recording(path: Path, root: ET.Element) -> Recording:
    step_s = _value(path, "timeStepSize", root.get("timeStepSize"))
    if not 0.0 < step_s <= 10.0:
        raise DataError(complaint(path, "timeStepSize", "seconds in (0, 10]", root.get("timeStepSize", "nothing")))
    lanes = [_outline(path, lanelet) for lanelet in root.findall("lanelet")]
    moving: list[Track] = []
    still: list[Track] = []
    for obstacle in root.iter():
        if obstacle.tag not in ("obstacle", "dynamicObstacle", "staticObstacle"):
            continue
        stands = obstacle.tag == "staticObstacle" or obstacle.findtext("role", "").strip() == "static"
        track = _track(path, obstacle, step_s)
        if track is not None:
            (still if stands else moving).append(track)
    ends = [float(one.time_s[row]) for one in moving for row in (0, -1)] or [0.0, 1.0]
    start, end = min(ends), max(ends)
    time_s = np.linspace(start, end, max(2, math.ceil(2.0 * (end - start) / GAP_S) + 1))  # without a gap
    waiting = [
        replace(
            one, time_s=time_s, center=np.tile(one.center[0], (len(time_s), 1)), yaw=np.full(len(time_s), one.yaw[0])
        )
        for one in still
    ]
    return Recording((*moving, *waiting), tuple(lanes))


def _outline(path: Path, lanelet: ET.Element) -> NDArray[np.float64]:
    field = f"lanelet {lanelet.get('id')}"
    sides = [_points(path, field, lanelet.findall(f"{side}/point")) for side in ("leftBound", "rightBound")]
    if min(map(len, sides)) < 2:
        raise DataError(complaint(path, field, "two bounds of at least two points", "fewer"))
    return np.concatenate([sides[0], sides[1][::-1]])


def _track(path: Path, obstacle: ET.Element, step_s: float) -> Track | None:
    name = obstacle.get("id", "")
    field = f"obstacle {name}"
    shape = obstacle.find("shape")
    if not name or shape is None:
        raise DataError(complaint(path, field, "an id and a shape", "none"))
    length, width, offset, turn = _shape(path, field, shape)
    class_name = class_of(path, f"{field}: type", obstacle.findtext("type", ""), length)
    states = [*obstacle.findall("initialState"), *obstacle.findall("trajectory/state")]
    if class_name is None or (obstacle.find("occupancySet") is not None and obstacle.find("trajectory") is None):
        reason = "no road user" if class_name is None else "a set of occupancies"
        _log.warning("%s: %s: %s: it is left out", path, field, reason)
        return None
    if not states:
        raise DataError(complaint(path, field, "an initialState", "none"))
    rows = []
    for state in states:
        point = state.find("position/point")
        region = state.find("position")
        if point is None and region is not None:
            point = region.find(".//center")
        if point is None:
            raise DataError(complaint(path, f"{field}: position", "a point", "none"))
        x, y = _points(path, field, [point])[0]
        rows.append([_number(path, field, state, "time") * step_s, x, y, _number(path, field, state, "orientation")])
    time_s, x, y, yaw = np.array(rows, np.float64).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    center = np.column_stack(
        [x + cos * offset[0] - sin * offset[1], y + sin * offset[0] + cos * offset[1], np.full(len(x), np.nan)]
    )
    return make_track(path, name, class_name, [length, width, math.nan], time_s, center, yaw + turn)


def _shape(path: Path, field: str, shape: ET.Element) -> tuple[float, float, NDArray[np.float64], float]:
    """Return length, width, (2,) centre and heading of a shape in the frame of its obstacle."""
    rectangle, circle, polygon = (shape.find(kind) for kind in ("rectangle", "circle", "polygon"))
    for found in (rectangle, circle):
        if found is None:
            continue
        center = found.find("center")
        offset = np.zeros(2) if center is None else _points(path, f"{field}: center", [center])[0]
        if found is circle:
            radius = _value(path, f"{field}: radius", found.findtext("radius"))
            return 2.0 * radius, 2.0 * radius, offset, 0.0
        length, width = (_value(path, f"{field}: {name}", found.findtext(name)) for name in ("length", "width"))
        turn = found.findtext("orientation")
        return length, width, offset, 0.0 if turn is None else _value(path, f"{field}: orientation", turn)
    if polygon is not None:
        corners = _points(path, f"{field}: polygon", polygon.findall("point"))
        if len(corners) >= 3:
            low, high = corners.min(axis=0), corners.max(axis=0)
            return float(high[0] - low[0]), float(high[1] - low[1]), 0.5 * (low + high), 0.0
    raise DataError(complaint(path, f"{field}: shape", "a rectangle, circle or polygon", "none"))


def _points(path: Path, field: str, points: list[ET.Element]) -> NDArray[np.float64]:
    rows = [[_value(path, f"{field}: {axis}", point.findtext(axis)) for axis in "xy"] for point in points]
    return np.array(rows, np.float64).reshape(-1, 2)


def _number(path: Path, field: str, state: ET.Element, name: str) -> float:
    """Return an exact value of a state, or the middle of its interval."""
    exact = state.findtext(f"{name}/exact")
    if exact is not None:
        return _value(path, f"{field}: {name}", exact)
    ends = [_value(path, f"{field}: {name}", state.findtext(f"{name}/interval{end}")) for end in ("Start", "End")]
    return 0.5 * sum(ends)


def _value(path: Path, field: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(complaint(path, field, "a number", text or "nothing"))
    return value
