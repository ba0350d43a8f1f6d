"""Tracks in a CommonRoad XML, versions 2018b and 2020a: obstacles with trajectories, lanelets as road surface.

Source: CommonRoad scenario documentation, XML formats 2018b and 2020a: positions are those of the origin of a shape,
which may lie off its centre; times are numbers of steps of `timeStepSize`; values are exact or intervals, and positions
points or areas.
"""

import logging
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.boxes import check_radians
from sim.errors import DataError, complaint
from sim.reading import parsing
from sim.traffic.tracks.base import GAP_S, Recording, Track, class_of, make_track
from sim.traffic.tracks.xml_file import number_of, read_xml_bytes

VERSIONS = ("2018b", "2020a")
_OBSTACLES = ("obstacle", "dynamicObstacle", "staticObstacle", "phantomObstacle", "environmentObstacle")
_SHAPES = ("rectangle", "circle", "polygon")
_INEXACT = (".//intervalStart", *(f".//position/{name}" for name in _SHAPES))
_SAME = 1e-6
"""Difference up to which two states of one step are the same, m and rad."""

_log = logging.getLogger(__name__)


def read_commonroad(path: Path) -> tuple[Recording, ...]:
    """Read obstacles and lanelets.

    Static obstacles stand for the whole time. Obstacles that are no road users, and those whose motion is a set of
    occupancies, are left out and named in the log. Of an interval and of an area the middle is taken, which is logged.

    Raises:
        DataError: no CommonRoad file of these versions, a value is missing or wrong, or every obstacle moves as a set
            of occupancies; names the obstacle.
    """
    content = read_xml_bytes(path, "CommonRoad file")
    with parsing(path, "CommonRoad file"):
        root = ET.fromstring(content)
        version = root.get("commonRoadVersion", "")
        if root.tag != "commonRoad" or version not in VERSIONS:
            found = f"<{root.tag}> {version}".strip()
            raise DataError(complaint(path, "root", f"<commonRoad> of version {' or '.join(VERSIONS)}", found))
        return (_recording(path, root),)


def _recording(path: Path, root: ET.Element) -> Recording:
    step_s = number_of(path, "timeStepSize", root.get("timeStepSize"))
    if not 0.0 < step_s <= 10.0:
        raise DataError(complaint(path, "timeStepSize", "seconds in (0, 10]", root.get("timeStepSize", "nothing")))
    lanes = [_outline(path, lanelet) for lanelet in root.findall("lanelet")]
    moving: list[Track] = []
    still: list[Track] = []
    sets: list[str] = []
    inexact: list[str] = []
    for obstacle in (child for child in root if child.tag in _OBSTACLES):
        field = f"obstacle {obstacle.get('id', '')}"
        if obstacle.find("occupancySet") is not None and obstacle.find("trajectory") is None:
            _log.warning("%s: %s: moves as a set of occupancies: it is left out", path, field)
            sets.append(field)
            continue
        stands = obstacle.tag == "staticObstacle" or obstacle.findtext("role", "").strip() == "static"
        track = _track(path, field, obstacle, step_s)
        if track is not None:
            (still if stands else moving).append(track)
            if any(obstacle.find(where) is not None for where in _INEXACT):
                inexact.append(field)
    if sets and not moving and not still:
        raise DataError(complaint(path, sets[0], "a trajectory", "a set of occupancies"))
    if inexact:
        _log.warning("%s: %s: of intervals and areas of its states the middle is taken", path, _several(inexact))
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


def _several(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _outline(path: Path, lanelet: ET.Element) -> NDArray[np.float64]:
    field = f"lanelet {lanelet.get('id')}"
    sides = [_points(path, field, lanelet.findall(f"{side}/point")) for side in ("leftBound", "rightBound")]
    if min(map(len, sides)) < 2:
        raise DataError(complaint(path, field, "two bounds of at least two points", "fewer"))
    return np.concatenate([sides[0], sides[1][::-1]])


def _track(path: Path, field: str, obstacle: ET.Element, step_s: float) -> Track | None:
    name = obstacle.get("id", "")
    shape = obstacle.find("shape")
    if not name or shape is None:
        raise DataError(complaint(path, field, "an id and a shape", "none"))
    length, width, offset, turn = _box(path, field, shape)
    class_name = class_of(path, f"{field}: type", obstacle.findtext("type", ""), length)
    if class_name is None:
        _log.warning("%s: %s: no road user: it is left out", path, field)
        return None
    states = [*obstacle.findall("initialState"), *obstacle.findall("trajectory/state")]
    if not states:
        raise DataError(complaint(path, field, "an initialState", "none"))
    rows: dict[float, list[float]] = {}
    for state in states:
        step = _number(path, f"{field}: time", state.find("time"))
        x, y = _position(path, field, state)
        row = [step * step_s, x, y, _number(path, f"{field}: orientation", state.find("orientation"), turns=True)]
        if np.abs(np.subtract(rows.setdefault(step, row), row)).max() > _SAME:
            raise DataError(complaint(path, field, f"one state at step {step:g}", "two that differ"))
    time_s, x, y, yaw = np.array(list(rows.values()), np.float64).T
    check_radians(path, f"{field}: orientation", yaw)
    cos, sin = np.cos(yaw), np.sin(yaw)
    center = np.column_stack(
        [x + cos * offset[0] - sin * offset[1], y + sin * offset[0] + cos * offset[1], np.full(len(x), np.nan)]
    )
    return make_track(path, name, class_name, [length, width, math.nan], time_s, center, yaw + turn)


def _box(path: Path, field: str, shape: ET.Element) -> tuple[float, float, NDArray[np.float64], float]:
    """Return length, width, (2,) centre and heading, in the frame of its obstacle, of the box around a shape.

    The box of a single rectangle is itself; those of a polygon and of a group of shapes have the obstacle's heading.
    """
    parts = [child for child in shape if child.tag in _SHAPES]
    if not parts:
        raise DataError(complaint(path, f"{field}: shape", "a rectangle, circle or polygon", "none"))
    if len(parts) == 1 and parts[0].tag == "rectangle":
        return _rectangle(path, field, parts[0])
    ends = np.concatenate([_extent(path, field, part) for part in parts])
    low, high = ends.min(axis=0), ends.max(axis=0)
    return float(high[0] - low[0]), float(high[1] - low[1]), 0.5 * (low + high), 0.0


def _rectangle(path: Path, field: str, part: ET.Element) -> tuple[float, float, NDArray[np.float64], float]:
    length, width = (number_of(path, f"{field}: {name}", part.findtext(name)) for name in ("length", "width"))
    turn = part.findtext("orientation")
    angle = 0.0 if turn is None else number_of(path, f"{field}: orientation", turn)
    check_radians(path, f"{field}: orientation", np.array([angle]))
    return length, width, _center(path, field, part), angle


def _extent(path: Path, field: str, part: ET.Element) -> NDArray[np.float64]:
    """Return (K, 2) points whose bounding box is that of a shape."""
    if part.tag == "polygon":
        corners = _points(path, f"{field}: polygon", part.findall("point"))
        if len(corners) < 3:
            raise DataError(complaint(path, f"{field}: polygon", "at least three points", str(len(corners))))
        return corners
    if part.tag == "circle":
        radius, center = number_of(path, f"{field}: radius", part.findtext("radius")), _center(path, field, part)
        return np.array([center - radius, center + radius])
    length, width, center, turn = _rectangle(path, field, part)
    ahead, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    return np.array([center + 0.5 * (i * length * ahead + j * width * left) for i in (-1, 1) for j in (-1, 1)])


def _center(path: Path, field: str, part: ET.Element) -> NDArray[np.float64]:
    center = part.find("center")
    return np.zeros(2) if center is None else _points(path, f"{field}: center", [center])[0]


def _position(path: Path, field: str, state: ET.Element) -> NDArray[np.float64]:
    """Return the (2,) place of a state: a point, the centre of an area, or the middle of several."""
    field = f"{field}: position"
    region = state.find("position")
    if region is not None and (point := region.find("point")) is not None:
        return _points(path, field, [point])[0]
    parts = [] if region is None else [child for child in region if child.tag in _SHAPES]
    if not parts:
        raise DataError(complaint(path, field, "a point, rectangle, circle or polygon", "none"))
    if len(parts) > 1:
        ends = np.concatenate([_extent(path, field, part) for part in parts])
        return 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    if parts[0].tag == "polygon":
        return np.array(shapely.Polygon(_extent(path, field, parts[0])).centroid.coords[0])
    return _center(path, field, parts[0])


def _points(path: Path, field: str, points: list[ET.Element]) -> NDArray[np.float64]:
    rows = [[number_of(path, f"{field}: {axis}", point.findtext(axis)) for axis in "xy"] for point in points]
    return np.array(rows, np.float64).reshape(-1, 2)


def _number(path: Path, field: str, value: ET.Element | None, turns: bool = False) -> float:
    """Return an exact value, or the middle of its interval.

    Args:
        turns: it is an angle, whose interval may go through half a turn: from 3.1 to -3.1 is 0.08 rad wide.
    """
    if value is None:
        raise DataError(complaint(path, field, "a number", "nothing"))
    exact = value.findtext("exact")
    if exact is not None:
        return number_of(path, field, exact)
    start, end = (number_of(path, field, value.findtext(f"interval{side}")) for side in ("Start", "End"))
    return 0.5 * (start + (end + math.tau if turns and end < start else end))
