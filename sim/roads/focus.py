"""Busiest place of a network, and the area around it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from shapely import line_merge
from shapely.geometry import LineString, MultiLineString, Point, box
from shapely.ops import unary_union

from sim.roads.network import Edge, Lane, Network, Node

HALF_M = (150.0, 600.0)
"""Least and largest half of the side of the area around a place, m."""

CROSSED_S = 24.0
"""Time in which the fastest road crosses the area, s: more than twice that of a drive of 100 frames."""

_BESIDE_M = 20.0
"""Margin of the area beyond the ends and the sides of the network, m."""

_NEAR_M = 120.0
_CAR = "passenger"


@dataclass(frozen=True, slots=True)
class PlaceArea:
    """Place on a road and the area around it.

    Attributes:
        xy: position of the place, m.
        area_m: (x_min, y_min, x_max, y_max) around it, m.
        lanes_km: lanes for cars in the area, km.
        signals: number of junctions of three or more streets with traffic lights in the area.
        walk, cycle: whether there are footways and bicycle lanes.
    """

    xy: tuple[float, float]
    area_m: tuple[float, float, float, float]
    lanes_km: float
    signals: int
    walk: bool
    cycle: bool


def busiest_place(net: Network) -> PlaceArea | None:
    """Return the area around the junction with the most car lanes, or around the middle of the longest road.

    Signalised junctions are preferred; None without car lanes. The area is the wider the faster the roads.
    """
    edges = [edge for edge in net.getEdges(withInternal=False) if edge.allows(_CAR)]
    if not edges:
        return None
    nodes = {edge.getToNode().getID(): edge.getToNode() for edge in sorted(edges, key=lambda edge: edge.getID())}
    xy = np.array([node.getCoord()[:2] for node in nodes.values()])
    weight = np.array([_weight(node) for node in nodes.values()])
    if not weight.any():
        return around(net, _middle_of_longest(edges))
    near = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) < _NEAR_M
    score = weight + 0.3 * near @ weight
    # Streets of a junction at the border of the map end at once.
    x_min, y_min, x_max, y_max = net.getBoundary()
    rim = np.minimum.reduce([xy[:, 0] - x_min, x_max - xy[:, 0], xy[:, 1] - y_min, y_max - xy[:, 1]])
    score *= np.clip(rim / HALF_M[0], 0.2, 1.0)
    best = int(np.argmax(score))
    return around(net, (float(xy[best, 0]), float(xy[best, 1])))


def _middle_of_longest(edges: Sequence[Edge]) -> tuple[float, float]:
    """Return the middle of the longest road, whose edges follow one another without a junction."""
    lines = [_line(edge) for edge in sorted(edges, key=lambda edge: edge.getID())]
    roads = line_merge(MultiLineString(lines), directed=True)
    longest = max(getattr(roads, "geoms", [roads]), key=lambda road: road.length)
    middle = longest.interpolate(0.5, normalized=True)
    return middle.x, middle.y


def around(net: Network, xy: tuple[float, float]) -> PlaceArea:
    """Return the area of a square around a position, clipped to the surroundings of the network."""
    bounds = [bound + side * _BESIDE_M for bound, side in zip(net.getBoundary(), (-1, -1, 1, 1), strict=True)]
    here = Point(xy).buffer(HALF_M[0])
    fastest = max(
        (
            edge.getSpeed()
            for edge in net.getEdges(withInternal=False)
            if edge.allows(_CAR) and here.intersects(_line(edge))
        ),
        default=0.0,
    )
    half_m = float(np.clip(0.5 * CROSSED_S * fastest, *HALF_M))
    area = (
        round(max(xy[0] - half_m, bounds[0]), 1), round(max(xy[1] - half_m, bounds[1]), 1),
        round(min(xy[0] + half_m, bounds[2]), 1), round(min(xy[1] + half_m, bounds[3]), 1),
    )  # fmt: skip

    square = box(*area)
    edges = [edge for edge in net.getEdges(withInternal=False) if square.intersects(_line(edge))]
    lanes = [lane for edge in edges for lane in edge.getLanes()]
    nodes = [node for node in net.getNodes() if square.covers(Point(node.getCoord()[:2])) and _weight(node) > 0]
    length = sum(_line(lane).intersection(square).length for lane in lanes if lane.allows(_CAR))
    return PlaceArea(
        xy=(round(xy[0], 1), round(xy[1], 1)),
        area_m=area,
        lanes_km=length / 1000.0,
        signals=sum(node.getType().startswith("traffic_light") for node in nodes),
        walk=any(lane.allows("pedestrian") and not lane.allows(_CAR) for lane in lanes),
        cycle=any(lane.allows("bicycle") and not lane.allows(_CAR) for lane in lanes),
    )


def _line(road: Edge | Lane) -> LineString:
    return LineString([corner[:2] for corner in road.getShape()])


def _weight(node: Node) -> float:
    """Return the traffic weight of a junction: its car lanes by speed, 0 with fewer than three streets."""
    incoming = [edge for edge in node.getIncoming() if edge.allows(_CAR)]
    streets = {edge.getFromNode().getID() for edge in incoming}
    streets |= {edge.getToNode().getID() for edge in node.getOutgoing() if edge.allows(_CAR)}
    if len(streets) < 3:
        return 0.0
    lanes = sum(lane.allows(_CAR) * edge.getSpeed() / 13.9 for edge in incoming for lane in edge.getLanes())
    return float(lanes) * (1.5 if node.getType().startswith("traffic_light") else 1.0)


def beside_road(net: Network, xy: tuple[float, float]) -> tuple[float, float, float] | None:
    """Return x, y and heading in degrees of a roadside unit facing a place; None without room within 35 m."""
    lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes() if len(lane.getShape()) > 1]
    lines = [(_line(lane), 0.5 * lane.getWidth()) for lane in lanes]
    cover = unary_union([line.buffer(half) for line, half in lines if line.distance(Point(xy)) < 80.0])
    for radius in np.arange(10.0, 36.0, 1.0):
        for angle in np.radians(np.arange(-45.0, 315.0, 15.0)):
            place = Point(xy[0] + radius * np.cos(angle), xy[1] + radius * np.sin(angle))
            if 2.0 <= cover.distance(place) <= 5.0:
                return round(place.x, 1), round(place.y, 1), round(float(np.degrees(angle) + 180.0) % 360.0, 0)
    return None
