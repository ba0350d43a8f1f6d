"""Recorded demand: the vehicles, trips, flows and walks of a .rou.xml file.

After SUMO's documentation, "Definition of Vehicles, Vehicle Types, and Routes" and "Persons".
"""

import gzip
import io
import logging
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from sim.errors import ScenarioError, complaint
from sim.reading import LARGEST_BYTES, parsing, read_bytes

_LABELS = {
    "passenger": "car", "private": "car", "taxi": "car", "evehicle": "car", "custom1": "car", "custom2": "car",
    "hov": "car", "delivery": "van", "emergency": "van", "authority": "car", "army": "truck", "vip": "car",
    "truck": "truck", "trailer": "truck", "bus": "bus", "coach": "bus", "motorcycle": "motorcycle",
    "moped": "motorcycle", "bicycle": "bicycle",
}  # fmt: skip
"""Class name by SUMO's vehicle class, of road vehicles."""

_DEFAULT_TYPES = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_RAILTYPE": "", "DEFAULT_CONTAINERTYPE": ""}
"""Class name by SUMO's own types; all else that a file does not define is a car."""
_MOST_TRIPS = 500_000
_MOST_INCLUDES = 20
_KNOWN = ("vType", "vTypeDistribution", "route", "routeDistribution", "param")
log = logging.getLogger(__name__)


Choice = TypeVar("Choice")


class _Mix(Generic[Choice]):
    """Members of a distribution with their probabilities, each taken as often as it should be, in a fixed order."""

    def __init__(self, members: Sequence[Choice], weights: Sequence[float]) -> None:
        if not members or min(weights) < 0.0 or not 0.0 < sum(weights) < math.inf:
            raise ValueError("a distribution without members of probabilities above 0")
        self._members, self._weights = members, [weight / sum(weights) for weight in weights]
        self._taken = [0] * len(members)

    def next(self) -> Choice:
        """Return the member that lags most behind its share."""
        behind = [w * (sum(self._taken) + 1) - n for w, n in zip(self._weights, self._taken, strict=True)]
        row = behind.index(max(behind))
        self._taken[row] += 1
        return self._members[row]


class Trip(NamedTuple):
    """Recorded trip: departure, s, its edges, whether they are the whole route, and who makes it.

    `label` is the class name by its vType, "pedestrian" for a walk.
    """

    depart_s: float
    edges: list[str]
    is_route: bool
    label: str = "car"


def read_trips(path: Path) -> list[Trip]:
    """Return the trips of a .rou.xml(.gz) file and those that it includes, by departure.

    A flow's vehicles depart evenly; routes and types of distributions are taken in turn, by their probabilities.

    Raises:
        ScenarioError: the file is of another format, without trips, or holds demand that is not read.
    """
    with parsing(path, ".rou.xml file", ScenarioError):
        root = ET.Element("routes")
        root.extend(list(_elements(path, [path.resolve()])))
        routes, labels = _routes(root), _labels(root)
        found: list[Trip] = []
        left_out: Counter[str] = Counter()
        for element in root:
            if element.tag in _KNOWN:
                continue
            trips = list(_trips(element, routes, labels))
            if not trips:
                left_out[_named(element, routes)] += 1
            found += trips
            if len(found) > _MOST_TRIPS:
                raise ValueError(f"more than {_MOST_TRIPS} trips")
    expected = "vehicles, trips or flows with a route or with from and to, and persons that walk"
    if left_out:
        named = ", ".join(f"{count} x {what}" for what, count in left_out.most_common(5))
        raise ScenarioError(complaint(path, "demand.trips", f"only {expected}", named))
    if not found:
        raise ScenarioError(complaint(path, "demand.trips", expected, "none"))
    stops = sum(1 for _ in root.iter("stop"))
    if stops:
        log.warning("%s: %d stops of vehicles or routes are left out", path, stops)
    return sorted(found)


def _elements(path: Path, opened: list[Path]) -> Iterator[ET.Element]:
    """Yield the elements of a route file, and in place of an `include` those of the file that it names.

    Args:
        opened: files opened so far; grows.
    """
    raw = read_bytes(path, ".rou.xml file", ScenarioError)
    if path.suffix == ".gz":
        with gzip.open(io.BytesIO(raw)) as packed:
            raw = packed.read(LARGEST_BYTES)
    for element in ET.fromstring(raw):
        if element.tag != "include":
            yield element
            continue
        other = (path.parent / element.get("href", "")).resolve()
        if other in opened or len(opened) > _MOST_INCLUDES:
            raise ScenarioError(complaint(path, "include", f"at most {_MOST_INCLUDES} files, each once", str(other)))
        opened.append(other)
        with parsing(other, ".rou.xml file", ScenarioError):
            yield from _elements(other, opened)


def _routes(root: ET.Element) -> dict[str, _Mix[list[str]]]:
    """Return the edges of routes, and of distributions of routes, by their ids."""
    single = {one.get("id", ""): one.get("edges", "").split() for one in root.iter("route") if one.get("id")}
    mixes = {name: _Mix([edges], [1.0]) for name, edges in single.items()}
    for several in root.iterfind("routeDistribution"):
        members = [
            (one.get("edges", "").split() or single.get(one.get("refId", ""), []), float(one.get("probability", "1")))
            for one in several.iterfind("route")
        ]
        names, shares = several.get("routes", "").split(), several.get("probabilities", "").split()
        members += zip([single.get(name, []) for name in names], map(float, shares or ["1"] * len(names)), strict=True)
        if members:
            mixes[several.get("id", "")] = _Mix(*zip(*members, strict=True))
    return mixes


def _labels(root: ET.Element) -> dict[str, _Mix[str]]:
    """Return the class names of vTypes, and of distributions of them, by their ids; "" for what is no road vehicle."""
    kinds = {one.get("id", ""): one for one in root.iter("vType")}
    single = _DEFAULT_TYPES | {name: _LABELS.get(kind.get("vClass", "passenger"), "") for name, kind in kinds.items()}
    mixes = {name: _Mix([label], [1.0]) for name, label in single.items()}
    for several in root.iterfind("vTypeDistribution"):
        members = [(single[one.get("id", "")], float(one.get("probability", "1"))) for one in several.iterfind("vType")]
        names, shares = several.get("vTypes", "").split(), several.get("probabilities", "").split()
        usual = [kinds[name].get("probability", "1") if name in kinds else "1" for name in names]
        members += zip([single.get(name, "car") for name in names], map(float, shares or usual), strict=True)
        if members:
            mixes[several.get("id", "")] = _Mix(*zip(*members, strict=True))
    return mixes


def _named(element: ET.Element, routes: Mapping[str, _Mix[list[str]]]) -> str:
    """Return what an element is that is not read."""
    name = element.get("route")
    if name is not None and name not in routes:
        return f"{element.tag} with a route '{name}' that is not there"
    inside = [child.tag for child in element if child.tag not in ("param", "stop", "route")]
    if inside:
        return f"{element.tag} with {inside[0]}"
    ends = [key for key in element.attrib if re.fullmatch("(from|to|via)[A-Z].*", key)]
    if ends:
        return f"{element.tag} with {ends[0]}"
    if name is None and not (element.get("from") and element.get("to")):
        return f"{element.tag} without an edge to go from and to"
    return f"{element.tag} of type '{element.get('type', '')}', which is no road vehicle"


def _trips(
    element: ET.Element, routes: Mapping[str, _Mix[list[str]]], labels: Mapping[str, _Mix[str]]
) -> Iterator[Trip]:
    """Yield the trips of an element of a route file; none if it cannot be read."""
    walks = element.tag in ("person", "personFlow")
    if element.tag in ("vehicle", "trip", "person"):
        departures = iter([_seconds(element.get("depart", ""))])
    elif element.tag in ("flow", "personFlow"):
        departures = _departures(element)
    else:
        return
    for depart_s in departures:
        label = "pedestrian" if walks else _label(element, labels)
        edges, is_route = _way(element, routes, walks=walks)
        if not label or not edges:
            return
        yield Trip(depart_s, edges, is_route, label)


def _label(element: ET.Element, labels: Mapping[str, _Mix[str]]) -> str:
    mix = labels.get(element.get("type", ""))
    return "car" if mix is None else mix.next()


def _way(element: ET.Element, routes: Mapping[str, _Mix[list[str]]], *, walks: bool) -> tuple[list[str], bool]:
    """Return the edges of an element, and whether they are a whole route; empty without any."""
    if walks:
        steps = [child for child in element if child.tag != "param"]
        if len(steps) != 1 or steps[0].tag not in ("walk", "personTrip"):
            return [], False
        element = steps[0]
        if element.get("edges"):
            return element.get("edges", "").split(), True
    inner = element.find("route")
    if inner is not None:
        return inner.get("edges", "").split(), True
    mix = routes.get(element.get("route", ""))
    if mix is not None:
        return mix.next(), True
    if element.get("from") and element.get("to"):
        return [element.get("from", ""), *element.get("via", "").split(), element.get("to", "")], False
    return [], False


def _seconds(text: str) -> float:
    """Return a time in seconds, also of hours, minutes and seconds, or days before them, with colons."""
    parts = [float(part) for part in text.split(":")]
    if len(parts) not in (1, 3, 4) or not all(map(math.isfinite, parts)):
        raise ValueError(f"{text!r} is no time")
    return sum(part * unit for part, unit in zip(parts[::-1], (1.0, 60.0, 3600.0, 86400.0), strict=False))


def _departures(flow: ET.Element) -> Iterator[float]:
    """Yield the departures of a flow, s: even, also where SUMO would draw them."""
    begin_s, end_s = _seconds(flow.get("begin", "0")), _seconds(flow.get("end", "86400"))
    number = float(flow.get("number", "inf"))
    hourly = flow.get("vehsPerHour") or flow.get("personsPerHour") or flow.get("perHour")
    period = flow.get("period", "")
    if hourly:
        every_s = 3600.0 / float(hourly)
    elif period.startswith("exp(") and period.endswith(")"):
        every_s = 1.0 / float(period[4:-1])
    elif period:
        every_s = float(period)
    elif flow.get("probability"):
        every_s = 1.0 / float(flow.get("probability", ""))
    else:
        every_s = (end_s - begin_s) / number
    if not (every_s > 0.0 and math.isfinite(every_s) and math.isfinite(end_s)):
        raise ValueError(f"flow {flow.get('id')!r} without an end or a rate above 0")
    count = min(number, math.ceil((end_s - begin_s) / every_s - 1e-9))
    if count > _MOST_TRIPS:
        raise ValueError(f"more than {_MOST_TRIPS} trips")
    for index in range(int(count)):
        yield begin_s + index * every_s
