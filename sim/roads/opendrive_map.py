"""OpenDRIVE as netconvert can read it, and the objects beside its roads.

After ASAM OpenDRIVE 1.8, sections 10.2 (rule of traffic) and 13 (objects). netconvert 1.28 knows neither
left-hand rules nor namespaces, and refuses a whole map for one odd attribute.
"""

import logging
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sim.errors import DataError, ScenarioError, UserError
from sim.geometry import Array
from sim.roads.opendrive import Road, read_road, read_root

log = logging.getLogger(__name__)

_AT_FAULT = re.compile(
    r"Attribute '(\w+)'.*?in definition of (?:an? )?(\w+)(?: '([^']*)')?(?: Invalid \w+ Format \([\w ]+\) ([^ ]*)\.)?"
)
_MAY_GO = ("signal", "signalReference", "controller", "connection", "control", "validity")
"""Elements that a map is read without."""


class OpenDriveMap:
    """OpenDRIVE file as an element tree without namespaces.

    Attributes:
        root: its `OpenDRIVE` element.
        left_hand: most of its roads have the rule LHT.

    Raises:
        ParseError: the file is not XML.
        ScenarioError: the file is missing or has entities.
    """

    def __init__(self, source: Path) -> None:
        self._source = source
        self.root = read_root(source, ScenarioError)
        rules = [road.get("rule", "RHT") for road in self.root.iter("road")]
        self.left_hand = 2 * rules.count("LHT") > len(rules)
        # netconvert draws none, and repeats one of length 0 for ever.
        self._things = [(road, things) for road in self.root.iter("road") for things in road.findall("objects")]
        for road, things in self._things:
            road.remove(things)
        self._drop_links_to_nowhere()
        for road in self.root.iter("road"):
            with suppress(ValueError):  # a wrong number is told by netconvert
                _limit_lanes(road)

    def _drop_links_to_nowhere(self) -> None:
        """Drop links to roads that the file lacks, as one cut out of a larger map has them."""
        known = {road.get("id") for road in self.root.iter("road")}
        dangling = [
            (link, end)
            for link in self.root.iterfind("road/link")
            for end in link
            if end.get("elementType") == "road" and end.get("elementId") not in known
        ]
        for link, end in dangling:
            link.remove(end)
        if dangling:
            log.warning("%s: left out %d x link to a road that is not there", self._source.name, len(dangling))

    def write(self, target: Path, *, left_hand: bool) -> None:
        """Write the file as netconvert reads it, which takes lanes of negative number as those along the road.

        Args:
            left_hand: traffic keeps left: the lanes of a road change their numbers' sign, and netconvert mirrors them.
        """
        root = self.root
        if left_hand:
            root = ET.fromstring(ET.tostring(root))
            for road in root.iter("road"):
                if road.get("rule") == "LHT":
                    _swap_sides(road)
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
        attribute, tag, name, value = found.groups()
        faulty = [
            (parent, child)
            for parent in self.root.iter()
            for child in parent
            if child.tag == tag
            and (child.get(attribute, "") in ("", value) or (name and not value and child.get("id") == name))
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
        placeless = 0
        for road, things in self._things:
            try:
                line = read_road(self._source, road)
            except DataError:  # netconvert has read what it could of it
                continue
            for thing in things.iterfind("object"):
                try:
                    rows += [
                        _row(f"{len(rows) + k}", thing, *one) for k, one in enumerate(_placed(thing, line, offset))
                    ]
                except ValueError:
                    placeless += 1
        if placeless:
            log.warning("%s: left out %d x object without a usable place or size", self._source.name, placeless)
        return "".join(rows)


_FOR_VEHICLES = frozenset(
    "driving entry exit onRamp offRamp connectingRamp slipLane bidirectional bus taxi HOV mwyEntry mwyExit".split()
)
"""Types of lanes that the speed limit of their road is for."""


def _limit_lanes(road: ET.Element) -> None:
    """Write the speed limits of a road's types into those of its lanes that have none: netconvert reads lanes alone."""
    limits = [(float(kind.get("s") or 0.0), _limit(kind.find("speed"))) for kind in road.findall("type")]
    limits.sort(key=lambda pair: pair[0])
    sections = road.findall("lanes/laneSection") if limits else []
    starts = [float(section.get("s") or 0.0) for section in sections]
    for section, start, end in zip(sections, starts, [*starts[1:], math.inf], strict=True):
        before = [(0.0, limit) for s, limit in limits if s <= start]
        within = [(s - start, limit) for s, limit in limits if start < s < end]
        for lane in section.iterfind("*/lane"):
            if lane.get("type") in _FOR_VEHICLES and lane.find("speed") is None:
                for offset, limit in before[-1:] + within:
                    if limit is not None:
                        ET.SubElement(lane, "speed", {"sOffset": f"{offset:g}", **limit})


def _limit(speed: ET.Element | None) -> dict[str, str] | None:
    """Return a limit as a lane has it; None where it is "no limit", "undefined" or missing."""
    if speed is None:
        return None
    try:
        known = 0.0 < float(speed.get("max", "")) < math.inf
    except ValueError:
        return None
    return {"max": speed.get("max", ""), "unit": speed.get("unit", "m/s")} if known else None


def _swap_sides(road: ET.Element) -> None:
    """Change the sign of the lanes of a road."""
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


def _number(element: ET.Element, name: str, usual: float | None = 0.0) -> float:
    """Return a number of an object, or the usual one where it has none.

    Raises:
        ValueError: it is no finite number, or missing without a usual one.
    """
    value = float(element.get(name) or ("nan" if usual is None else usual))
    if not math.isfinite(value):
        raise ValueError(name)
    return value


_POINTS = {"tree": "natural.tree", "vegetation": "natural.tree", "pole": "man_made.utility_pole",
    "streetlamp": "highway.street_lamp", "gantry": "man_made.utility_pole"}  # fmt: skip
_LAMPS = ("lamp", "lantern", "light")
_BARRIERS = {"fence": "fence", "wall": "wall", "hedge": "hedge", "railing": "guard_rail", "guard": "guard_rail"}


def _placed(thing: ET.Element, line: Road, offset: tuple[float, float]) -> Iterator[tuple[str, Array]]:
    """Yield (kind of a .poly.xml, (K, 2) corners or (1, 2) place) of an object and its repetitions."""
    kind, name = thing.get("type", "").lower(), f"{thing.get('subtype', '')} {thing.get('name', '')}".lower()
    spots = list(_repeated(thing)) or [(_number(thing, "s", None), _number(thing, "t", None))]
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


def _beside(line: Road, s: float, t: float, offset: tuple[float, float]) -> Array:
    x, y, _, _ = line.at(s, t)
    return np.array([x + offset[0], y + offset[1]])


def _outline(thing: ET.Element, line: Road, s: float, t: float, offset: tuple[float, float]) -> Array | None:
    """Return the (K, 2) first outline of an object; None without one."""
    outline = next(thing.iter("outline"), None)
    corners = [] if outline is None else list(outline)
    on_road = [_beside(line, _number(c, "s"), _number(c, "t"), offset) for c in corners if c.tag == "cornerRoad"]
    local = np.array([[_number(c, "u"), _number(c, "v")] for c in corners if c.tag == "cornerLocal"]).reshape(-1, 2)
    if len(on_road) > 1:
        return np.array(on_road)
    return _turned(thing, line, s, t, offset, local) if len(local) > 1 else None


def _box(thing: ET.Element, line: Road, s: float, t: float, offset: tuple[float, float]) -> Array:
    """Return the (4, 2) corners of the box of an object, along its length first."""
    half = 0.5 * np.array([_number(thing, "length"), _number(thing, "width")]) + _number(thing, "radius")
    if not half.any():
        raise ValueError("no size")
    corners = half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    return _turned(thing, line, s, t, offset, corners)


def _turned(thing: ET.Element, line: Road, s: float, t: float, offset: tuple[float, float], local: Array) -> Array:
    heading = line.at(s, t)[3] + _number(thing, "hdg")
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
