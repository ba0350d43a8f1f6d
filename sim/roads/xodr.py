"""OpenDRIVE as netconvert can read it, and the objects beside its roads.

After ASAM OpenDRIVE 1.8, sections 9 (geometry), 10.2 (rule of traffic) and 13 (objects). netconvert 1.28 knows neither
left-hand rules nor namespaces, and refuses a whole map for one odd attribute.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sim.errors import ScenarioError, UserError
from sim.geometry import Array
from sim.reading import read_bytes

_AT_FAULT = re.compile(r"Attribute '(\w+)'.*?in definition of (?:an? )?(\w+)(?: '([^']*)')?")
_MAY_GO = ("signal", "signalReference", "object", "objectReference", "controller", "connection", "control", "outline")
"""Elements that a map is read without."""


class OpenDrive:
    """OpenDRIVE file as an element tree without namespaces.

    Attributes:
        root: its `OpenDRIVE` element.
        left_hand: most of its roads have the rule LHT.
    """

    def __init__(self, source: Path) -> None:
        self.root = ET.fromstring(read_bytes(source, ".xodr file", ScenarioError))
        for element in self.root.iter():
            element.tag = element.tag.rpartition("}")[2]
        rules = [road.get("rule", "RHT") for road in self.root.iter("road")]
        self.left_hand = 2 * rules.count("LHT") > len(rules)

    def write(self, target: Path, *, left_hand: bool) -> None:
        """Write the file as netconvert reads it, which takes lanes of negative number as those along the road.

        Args:
            left_hand: traffic keeps left: the lanes of a road change their numbers' sign, and netconvert mirrors them.
        """
        root = self.root
        if left_hand:
            root = ET.fromstring(ET.tostring(root))
            for road in root.iter("road"):
                _swap_sides(road, rule_is_left=road.get("rule") == "LHT")
            for link in root.iter("laneLink"):
                _negate(link, "from", "to")
        target.write_bytes(ET.tostring(root))

    def drop_fault(self, refusal: UserError) -> str:
        """Drop what netconvert refuses, and all else of its kind with the same fault.

        Returns:
            What was dropped and why; "" if the roads themselves are at fault.
        """
        found = _AT_FAULT.search(str(refusal))
        if found is None or found[2] not in _MAY_GO:
            return ""
        attribute, tag, name = found.groups()
        faulty = [
            (parent, child)
            for parent in self.root.iter()
            for child in parent
            if child.tag == tag and (not child.get(attribute) or (name and child.get("id") == name))
        ]
        for parent, child in faulty:
            parent.remove(child)
        return f"{len(faulty)} x {tag} without a usable attribute '{attribute}'" if faulty else ""

    def objects_xml(self, offset: tuple[float, float]) -> str:
        """Return the buildings, barriers, poles and trees as rows of a .poly.xml.

        Args:
            offset: of the network's coordinates from those of the file, m.
        """
        rows: list[str] = []
        for road in self.root.iter("road"):
            line = _ReferenceLine(road)
            for thing in road.iterfind("objects/object"):
                try:
                    rows += [
                        _row(f"{len(rows) + k}", thing, *one) for k, one in enumerate(_placed(thing, line, offset))
                    ]
                except ValueError:  # an object without a place is none
                    continue
        return "".join(rows)


def _swap_sides(road: ET.Element, *, rule_is_left: bool) -> None:
    """Change the sign of the lanes of a road, whose left lanes lead along it, or not if it keeps right."""
    if not rule_is_left:
        return
    for section in road.iter("laneSection"):
        left, right = section.find("left"), section.find("right")
        for side, name in ((left, "right"), (right, "left")):
            if side is not None:
                side.tag = name
                side[:] = side[::-1]
        for lane in section.iter("lane"):
            _negate(lane, "id")
            for end in lane.iterfind("link/*"):
                _negate(end, "id")


def _negate(element: ET.Element, *names: str) -> None:
    for name in names:
        text = element.get(name, "")
        if re.fullmatch(r"[+-]?\d+", text):
            element.set(name, str(-int(text)))


class _ReferenceLine:
    """Reference line of a road: position and heading at a distance along it."""

    def __init__(self, road: ET.Element) -> None:
        self._pieces = sorted(road.iterfind("planView/geometry"), key=lambda piece: _number(piece, "s"))
        self._starts = np.array([_number(piece, "s") for piece in self._pieces])

    def at(self, s: float) -> tuple[float, float, float]:
        """Return x, y, m, and heading, rad, at a distance along the road, m."""
        if not self._pieces:
            raise ValueError("no geometry")
        piece = self._pieces[max(int(np.searchsorted(self._starts, s, side="right")) - 1, 0)]
        along = min(max(s - _number(piece, "s"), 0.0), _number(piece, "length"))
        u, v, turned = _within(piece, along)
        heading = _number(piece, "hdg")
        c, n = math.cos(heading), math.sin(heading)
        return _number(piece, "x") + c * u - n * v, _number(piece, "y") + n * u + c * v, heading + turned


def _within(piece: ET.Element, along: float) -> tuple[float, float, float]:
    """Return the position within a piece of geometry and the turn since its start."""
    shape = next(iter(piece), None)
    kind = "line" if shape is None else shape.tag
    if shape is None or kind == "line":
        return along, 0.0, 0.0
    if kind in ("arc", "spiral"):
        start = _number(shape, "curvature" if kind == "arc" else "curvStart")
        rate = 0.0 if kind == "arc" else (_number(shape, "curvEnd") - start) / max(_number(piece, "length"), 1e-9)
        at = np.linspace(0.0, along, 2 + int(along))
        turned = start * at + 0.5 * rate * at**2
        return float(np.trapezoid(np.cos(turned), at)), float(np.trapezoid(np.sin(turned), at)), float(turned[-1])
    if kind == "paramPoly3":
        p = along / max(_number(piece, "length"), 1e-9) if shape.get("pRange") != "arcLength" else along
        (u, du), (v, dv) = (_cubic([_number(shape, f"{k}{axis}") for k in "abcd"], p) for axis in "UV")
        return u, v, math.atan2(dv, du)
    v, slope = _cubic([_number(shape, k) for k in "abcd"], along)
    return along, v, math.atan(slope)


def _cubic(terms: list[float], p: float) -> tuple[float, float]:
    a, b, c, d = terms
    return a + b * p + c * p * p + d * p**3, b + 2.0 * c * p + 3.0 * d * p * p


def _number(element: ET.Element, name: str) -> float:
    value = float(element.get(name, "0") or "0")
    if not math.isfinite(value):
        raise ValueError(name)
    return value


_POINTS = {"tree": "natural.tree", "vegetation": "natural.tree", "pole": "man_made.utility_pole",
    "streetlamp": "highway.street_lamp", "gantry": "man_made.utility_pole"}  # fmt: skip
_LAMPS = ("lamp", "lantern", "light")
_BARRIERS = {"fence": "fence", "wall": "wall", "hedge": "hedge", "railing": "guard_rail", "guard": "guard_rail"}


def _placed(thing: ET.Element, line: _ReferenceLine, offset: tuple[float, float]) -> Iterator[tuple[str, Array]]:
    """Yield (kind of a .poly.xml, (K, 2) corners or (1, 2) place) of an object and its repetitions."""
    kind, name = thing.get("type", "").lower(), f"{thing.get('subtype', '')} {thing.get('name', '')}".lower()
    spots = list(_repeated(thing)) or [(_number(thing, "s"), _number(thing, "t"))]
    if kind in ("barrier", "railing", "soundbarrier"):
        name = f"{kind} {name}".replace("soundbarrier", "wall")
        words = [word for word in _BARRIERS if word in name]
        sort = f"barrier.{_BARRIERS[words[0]] if words else 'guard_rail'}"
        if len(spots) > 1:
            yield sort, np.array([_beside(line, s, t, offset) for s, t in spots])
        else:
            outline = _outline(thing, line, *spots[0], offset)
            yield sort, outline if outline is not None else _box(thing, line, *spots[0], offset)[[0, 1]]
        return
    for s, t in spots:
        if kind in _POINTS:
            lamp = kind == "pole" and any(word in name for word in _LAMPS)
            yield "highway.street_lamp" if lamp else _POINTS[kind], _beside(line, s, t, offset)[None]
        elif kind == "building":
            outline = _outline(thing, line, s, t, offset)
            yield "building", outline if outline is not None else _box(thing, line, s, t, offset)


def _repeated(thing: ET.Element) -> Iterator[tuple[float, float]]:
    """Yield (s, t) of the repetitions of an object; a continuous one has a point every 2 m."""
    for repeat in thing.iterfind("repeat"):
        start, length, step = (_number(repeat, key) for key in ("s", "length", "distance"))
        count = min(int(length / (step or 2.0)), 5000)
        for k in range(count + 1):
            share = min(k * (step or 2.0) / max(length, 1e-9), 1.0)
            low, high = _number(repeat, "tStart"), _number(repeat, "tEnd")
            yield start + share * length, low + share * (high - low)


def _beside(line: _ReferenceLine, s: float, t: float, offset: tuple[float, float]) -> Array:
    x, y, heading = line.at(s)
    return np.array([x - t * math.sin(heading) + offset[0], y + t * math.cos(heading) + offset[1]])


def _outline(thing: ET.Element, line: _ReferenceLine, s: float, t: float, offset: tuple[float, float]) -> Array | None:
    """Return the (K, 2) first outline of an object; None without one."""
    outline = next(thing.iter("outline"), None)
    corners = [] if outline is None else list(outline)
    on_road = [_beside(line, _number(c, "s"), _number(c, "t"), offset) for c in corners if c.tag == "cornerRoad"]
    local = np.array([[_number(c, "u"), _number(c, "v")] for c in corners if c.tag == "cornerLocal"]).reshape(-1, 2)
    if len(on_road) > 1:
        return np.array(on_road)
    return _turned(thing, line, s, t, offset, local) if len(local) > 1 else None


def _box(thing: ET.Element, line: _ReferenceLine, s: float, t: float, offset: tuple[float, float]) -> Array:
    """Return the (4, 2) corners of the box of an object, along its length first."""
    half = 0.5 * np.array([_number(thing, "length"), _number(thing, "width")]) + _number(thing, "radius")
    corners = half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    return _turned(thing, line, s, t, offset, corners)


def _turned(
    thing: ET.Element, line: _ReferenceLine, s: float, t: float, offset: tuple[float, float], local: Array
) -> Array:
    heading = line.at(s)[2] + _number(thing, "hdg")
    ahead = np.array([math.cos(heading), math.sin(heading)])
    return _beside(line, s, t, offset) + local[:, :1] * ahead + local[:, 1:] * [-ahead[1], ahead[0]]


def _row(name: str, thing: ET.Element, kind: str, corners: Array) -> str:
    if len(corners) == 1:
        x, y = corners[0]
        return f'<poi id="{name}" type="{kind}" color="gray" x="{x:.3f}" y="{y:.3f}"/>\n'
    shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in corners)
    height = thing.get("height") or max((c.get("height", "") for c in thing.iter() if c is not thing), default="")
    param = f'<param key="height" value={quoteattr(height)}/>' if height else ""
    return f'<poly id="{name}" type="{kind}" color="gray" shape="{shape}">{param}</poly>\n'
