"""Geometry of OpenDRIVE roads: places on lanes and the lanes' outlines, for what names them.

Source: ASAM OpenDRIVE 1.7: plan view (line, arc, spiral, poly3, paramPoly3), elevation profile, lane offset, lane
sections and widths. The reference line is cut into pieces of at most `STEP_M`, whose headings are exact; a spiral is
integrated.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from sim.errors import DataError, UserError, complaint
from sim.reading import parsing, read_bytes

STEP_M = 0.5
_MOST_STEPS = 200_000
_MOST_OUTLINE = 2000
"""Most points of one side of an outline."""
_DRIVEN = ("driving", "entry", "exit", "onramp", "offramp", "connectingramp", "slipway", "bidirectional", "biking")


class LanePlace(NamedTuple):
    """Place on a lane: id of the road, number of the lane, m along the road, m left of the lane's middle."""

    road: str
    lane: int
    s: float
    offset: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Section:
    """Lane section: from where on, by lane its (s, a, b, c, d) widths, and whether it is driven on."""

    start: float
    widths: dict[int, NDArray[np.float64]]
    driven: dict[int, bool]


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """Road: (K, 4) rows of s, x, y and heading of its reference line, profiles as rows of s and a cubic, sections."""

    length: float
    junction: bool
    line: NDArray[np.float64]
    elevation: NDArray[np.float64]
    offset: NDArray[np.float64]
    sections: tuple[_Section, ...]
    links: dict[str, tuple[str, str, str]]

    def section(self, s: float) -> _Section:
        """Return the lane section at a distance along the road."""
        row = int(np.searchsorted([one.start for one in self.sections], s + 1e-9, side="right")) - 1
        return self.sections[max(row, 0)]

    def middle(self, lane: int, s: float) -> float | None:
        """Return how far left of the reference line the middle of a lane is, m; None where there is no such lane."""
        section = self.section(s)
        if lane == 0 or lane not in section.widths:
            return None
        side = 1 if lane > 0 else -1
        inner = sum(
            _cubic(section.widths[k], s - section.start) for k in range(side, lane, side) if k in section.widths
        )
        own = _cubic(section.widths[lane], s - section.start)
        return _cubic(self.offset, s) + side * (inner + 0.5 * own)

    def width(self, lane: int, s: float) -> float:
        """Return the width of a lane, m."""
        section = self.section(s)
        return _cubic(section.widths[lane], s - section.start)

    def at(self, s: float, t: float) -> tuple[float, float, float, float]:
        """Return x, y, z and heading of the reference line at s, moved t to the left."""
        line = self.line
        row = min(max(int(np.searchsorted(line[:, 0], s, side="right")) - 1, 0), len(line) - 2)
        share = (s - line[row, 0]) / max(line[row + 1, 0] - line[row, 0], 1e-9)
        x, y = (line[row, k] + share * (line[row + 1, k] - line[row, k]) for k in (1, 2))
        turn = (line[row + 1, 3] - line[row, 3] + math.pi) % math.tau - math.pi
        heading = float(line[row, 3] + share * turn)
        z = _cubic(self.elevation, s)
        return float(x - t * math.sin(heading)), float(y + t * math.cos(heading)), z, heading


class OpenDrive:
    """Roads of a file by their ids.

    Raises:
        DataError: the file is missing or wrong; names the road.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with parsing(path, "OpenDRIVE file"):
            root = read_root(path)
            if root.tag != "OpenDRIVE":
                raise DataError(complaint(path, "root", "<OpenDRIVE>", f"<{root.tag}>"))
            self.roads = {one.get("id", ""): read_road(path, one) for one in root.findall("road")}

    def place(self, field: str, at: LanePlace) -> tuple[float, float, float, float]:
        """Return x, y, z, m, and the heading of a lane's traffic at a place; right-hand lanes run with the road.

        Raises:
            DataError: there is no such road or lane; names the field.
        """
        road = self.roads.get(at.road)
        if road is None:
            raise DataError(complaint(self.path, field, "the id of a road", at.road))
        if not -1e-6 <= at.s <= road.length + 1e-6:
            raise DataError(complaint(self.path, field, f"s in [0, {road.length:g}] on road {at.road}", f"{at.s:g}"))
        middle = road.middle(at.lane, at.s)
        if middle is None:
            raise DataError(complaint(self.path, field, f"a lane of road {at.road} at s = {at.s:g}", at.lane))
        x, y, z, heading = road.at(at.s, middle + at.offset)
        return x, y, z, heading if at.lane < 0 else heading + math.pi

    def nearest(self, x: float, y: float) -> LanePlace | None:
        """Return the lane that a place is on; None where it is on none."""
        best: tuple[float, LanePlace] | None = None
        for name, road in self.roads.items():
            gaps = np.hypot(road.line[:, 1] - x, road.line[:, 2] - y)
            row = int(np.argmin(gaps))
            if best is not None and gaps[row] > best[0] + 30.0:
                continue
            s, x0, y0, heading = road.line[row]
            ahead = (x - x0) * math.cos(heading) + (y - y0) * math.sin(heading)
            t = -(x - x0) * math.sin(heading) + (y - y0) * math.cos(heading)
            s = float(min(max(s + ahead, 0.0), road.length))
            for lane, driven in road.section(s).driven.items():
                middle = road.middle(lane, s)
                if driven and middle is not None and abs(ahead) < 1.0:
                    off = abs(t - middle)
                    if off <= 0.5 * road.width(lane, s) + 0.2 and (best is None or off < best[0]):
                        best = off, LanePlace(name, lane, s, t - middle)
        return None if best is None else best[1]

    def outlines(self) -> Iterator[NDArray[np.float64]]:
        """Yield (K, 2) outlines of the driven lanes, section by section."""
        for road in self.roads.values():
            ends = [one.start for one in road.sections[1:]] + [road.length]
            for section, end in zip(road.sections, ends, strict=True):
                steps = min(max(2, math.ceil(end - section.start) + 1), _MOST_OUTLINE)
                places = np.linspace(section.start, max(end - 1e-6, section.start), steps)
                for lane, driven in section.driven.items():
                    middles = [road.middle(lane, s) for s in places.tolist()]
                    halves = [0.5 * road.width(lane, s) for s in places.tolist()]
                    if driven and max(halves) > 0.01 and None not in middles:
                        sides = [
                            [
                                road.at(s, (m or 0.0) + side * h)[:2]
                                for s, m, h in zip(places, middles, halves, strict=True)
                            ]
                            for side in (1, -1)
                        ]
                        yield np.array(sides[0] + sides[1][::-1])


def read_root(path: Path, error: type[UserError] = DataError) -> ET.Element:
    """Return the root of an OpenDRIVE file, without namespaces.

    Args:
        error: class of error to raise.

    Raises:
        ParseError: the file is not XML.
        UserError: of the class `error`: the file is missing or has entities.
    """
    content = read_bytes(path, "OpenDRIVE file", error)
    if b"<!ENTITY" in content:
        raise error(complaint(path, "OpenDRIVE file", "no entities", "<!ENTITY"))
    root = ET.fromstring(content)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root


def _number(path: Path, field: str, element: ET.Element, name: str) -> float:
    text = element.get(name)
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 1e8:
        raise DataError(complaint(path, f"{field}: {name}", "a number", text or "nothing"))
    return value


def read_road(path: Path, road: ET.Element) -> Road:
    """Return a road of a file.

    Raises:
        DataError: the file is wrong; names the road.
    """
    field = f"road {road.get('id')}"
    length = _number(path, field, road, "length")
    rows = [_geometry(path, field, one) for one in road.findall("planView/geometry")]
    if not rows or not 0.0 < length <= STEP_M * _MOST_STEPS:
        raise DataError(complaint(path, field, "a length and a plan view", "none"))
    line = np.concatenate(rows)
    line = line[np.argsort(line[:, 0], kind="stable")]
    sections = tuple(_section(path, field, one) for one in road.findall("lanes/laneSection"))
    if not sections:
        raise DataError(complaint(path, field, "a lane section", "none"))
    links = {
        end: (one.get("elementType", ""), one.get("elementId", ""), one.get("contactPoint", "start"))
        for end in ("predecessor", "successor")
        if (one := road.find(f"link/{end}")) is not None
    }
    return Road(
        length,
        road.get("junction", "-1") != "-1",
        line,
        _profile(path, field, road.findall("elevationProfile/elevation"), "s"),
        _profile(path, field, road.findall("lanes/laneOffset"), "s"),
        sections,
        links,
    )


def _profile(path: Path, field: str, parts: list[ET.Element], start: str) -> NDArray[np.float64]:
    rows = [[_number(path, field, one, name) for name in (start, "a", "b", "c", "d")] for one in parts]
    return np.array(rows or [[0.0] * 5], np.float64)


def _cubic(profile: NDArray[np.float64], s: float) -> float:
    row = profile[max(int(np.searchsorted(profile[:, 0], s + 1e-9, side="right")) - 1, 0)]
    u = s - row[0]
    return float(row[1] + u * (row[2] + u * (row[3] + u * row[4])))


def _section(path: Path, field: str, section: ET.Element) -> _Section:
    widths: dict[int, NDArray[np.float64]] = {}
    driven: dict[int, bool] = {}
    for lane in (*section.findall("left/lane"), *section.findall("right/lane")):
        number = int(_number(path, f"{field}: lane", lane, "id"))
        widths[number] = _profile(path, f"{field}: lane {number}", lane.findall("width"), "sOffset")
        driven[number] = lane.get("type", "").lower() in _DRIVEN
    return _Section(_number(path, f"{field}: laneSection", section, "s"), widths, driven)


def _geometry(path: Path, field: str, geometry: ET.Element) -> NDArray[np.float64]:
    """Return (K, 4) rows of s, x, y and heading along one piece of a plan view."""
    start, x, y, heading, length = (_number(path, field, geometry, name) for name in ("s", "x", "y", "hdg", "length"))
    if not 0.0 <= length <= STEP_M * _MOST_STEPS:
        raise DataError(complaint(path, f"{field}: length", "a length of a road", f"{length:g}"))
    s = np.linspace(0.0, length, max(2, math.ceil(length / STEP_M) + 1))
    kind = next((one for one in geometry if one.tag in _KINDS), None)
    if kind is None:
        raise DataError(complaint(path, field, " or ".join(_KINDS), "another geometry"))
    values = [_number(path, f"{field}: {kind.tag}", kind, name) for name in _KINDS[kind.tag]]
    if kind.tag in ("line", "arc", "spiral"):
        first, last = (values[0], values[-1]) if values else (0.0, 0.0)
        turn = np.asarray(first * s + 0.5 * (last - first) * s**2 / max(length, 1e-9))
        u, v = _integrated(s, first, last)
    else:
        whole = kind.tag == "poly3" or kind.get("pRange") == "arcLength"
        p = s if whole else s / max(length, 1e-9)
        parts = [[0.0, 1.0, 0.0, 0.0], values] if kind.tag == "poly3" else [values[:4], values[4:]]
        u, v = (np.asarray(polynomial.polyval(p, part), np.float64) for part in parts)
        du, dv = (polynomial.polyval(p, polynomial.polyder(part)) for part in parts)
        turn = np.asarray(np.arctan2(dv, du), np.float64)
    cos, sin = math.cos(heading), math.sin(heading)
    return np.column_stack([start + s, x + cos * u - sin * v, y + sin * u + cos * v, heading + turn])


_KINDS: dict[str, tuple[str, ...]] = {
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": ("a", "b", "c", "d"),
    "paramPoly3": ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"),
}


def _integrated(s: NDArray[np.float64], first: float, last: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (K,) u and v of a curve that begins along u and whose curvature changes linearly."""
    length = max(float(s[-1]), 1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    places = s[:-1, None] + 0.5 * np.diff(s)[:, None] * (nodes + 1.0)
    turn = first * places + 0.5 * (last - first) * places**2 / length
    steps = [0.5 * np.diff(s) * (weights * part).sum(axis=1) for part in (np.cos(turn), np.sin(turn))]
    u, v = (np.concatenate([[0.0], np.cumsum(part)]) for part in steps)
    return u, v
