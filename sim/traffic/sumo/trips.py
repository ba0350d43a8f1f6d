"""Recorded demand: the vehicles, trips, flows and walks of a .rou.xml file.

After SUMO's documentation, "Definition of Vehicles, Vehicle Types, and Routes" and "Persons".
"""

import gzip
import io
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sim.errors import ScenarioError, complaint
from sim.reading import LARGEST_BYTES, parsing, read_bytes

_LABELS = {
    "passenger": "car", "private": "car", "taxi": "car", "evehicle": "car", "custom1": "car", "custom2": "car",
    "hov": "car", "delivery": "van", "emergency": "van", "authority": "car", "army": "truck", "vip": "car",
    "truck": "truck", "trailer": "truck", "bus": "bus", "coach": "bus", "motorcycle": "motorcycle",
    "moped": "motorcycle", "bicycle": "bicycle",
}  # fmt: skip
"""Class name by SUMO's vehicle class, of road vehicles."""

_MOST_TRIPS = 500_000
_KNOWN = ("vType", "vTypeDistribution", "route", "param")


class Trip(NamedTuple):
    """Recorded trip: departure, s, its edges, whether they are the whole route, and who makes it.

    `label` is the class name by its vType, "pedestrian" for a walk.
    """

    depart_s: float
    edges: list[str]
    is_route: bool
    label: str = "car"


def read_trips(path: Path) -> list[Trip]:
    """Return the trips of a .rou.xml(.gz) file by departure; a flow's vehicles depart evenly.

    Raises:
        ScenarioError: the file is of another format, without trips, or holds demand that is not read.
    """
    raw = read_bytes(path, ".rou.xml file", ScenarioError)
    with parsing(path, ".rou.xml file", ScenarioError):
        if path.suffix == ".gz":
            with gzip.open(io.BytesIO(raw)) as packed:
                raw = packed.read(LARGEST_BYTES)
        root = ET.fromstring(raw)
        routes = {route.get("id", ""): route.get("edges", "").split() for route in root.iterfind("route")}
        labels = {kind.get("id", ""): _LABELS.get(kind.get("vClass", "passenger"), "") for kind in root.iter("vType")}
        found: list[Trip] = []
        left_out: Counter[str] = Counter()
        for element in root:
            if element.tag in _KNOWN:
                continue
            trips = list(_trips(element, routes, labels))
            if not trips:
                left_out[_named(element)] += 1
            found += trips
            if len(found) > _MOST_TRIPS:
                raise ValueError(f"more than {_MOST_TRIPS} trips")
    expected = "vehicles, trips or flows with a route or with from and to, and persons that walk"
    if left_out:
        named = ", ".join(f"{count} x {what}" for what, count in left_out.most_common(5))
        raise ScenarioError(complaint(path, "demand.trips", f"only {expected}", named))
    if not found:
        raise ScenarioError(complaint(path, "demand.trips", expected, "none"))
    return sorted(found)


def _named(element: ET.Element) -> str:
    inside = [child.tag for child in element if child.tag != "param"]
    return f"{element.tag} with {inside[0]}" if inside else f"{element.tag} without an edge to go from and to"


def _trips(element: ET.Element, routes: Mapping[str, list[str]], labels: Mapping[str, str]) -> Iterator[Trip]:
    """Yield the trips of an element of a route file; none if it cannot be read."""
    walks = element.tag in ("person", "personFlow")
    label = "pedestrian" if walks else labels.get(element.get("type", ""), "car")
    edges, is_route = _way(element, routes, walks=walks)
    if not label or not edges:
        return
    if element.tag in ("vehicle", "trip", "person"):
        yield Trip(float(element.get("depart", "")), edges, is_route, label)
    elif element.tag in ("flow", "personFlow"):
        for depart_s in _departures(element):
            yield Trip(depart_s, edges, is_route, label)


def _way(element: ET.Element, routes: Mapping[str, list[str]], *, walks: bool) -> tuple[list[str], bool]:
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
    if element.get("route"):
        return routes.get(element.get("route", ""), []), True
    if element.get("from") and element.get("to"):
        return [element.get("from", ""), *element.get("via", "").split(), element.get("to", "")], False
    return [], False


def _departures(flow: ET.Element) -> Iterator[float]:
    """Yield the departures of a flow, s: even, also where SUMO would draw them."""
    begin_s, end_s = float(flow.get("begin", "0")), float(flow.get("end", "86400"))
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
