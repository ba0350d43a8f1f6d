"""Busiest junction of a network, and the area around it."""

from dataclasses import dataclass

import numpy as np
from shapely.geometry import LineString, Point
from shapely.ops import unary_union

from sim.roads.network import Network, Node

HALF_M = 150.0
"""Half the side of the area around a junction, m."""

_NEAR_M = 120.0
_CAR = "passenger"


@dataclass(frozen=True, slots=True)
class JunctionArea:
    """Junction and the area around it.

    Attributes:
        xy: position of the junction, m.
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


def densest_junction(net: Network) -> JunctionArea | None:
    """Return the junction with the most car lanes around it, signalised ones preferred; None without car lanes."""
    edges = [edge for edge in net.getEdges(withInternal=False) if edge.allows(_CAR)]
    if not edges:
        return None
    nodes = {edge.getToNode().getID(): edge.getToNode() for edge in sorted(edges, key=lambda edge: edge.getID())}
    xy = np.array([node.getCoord()[:2] for node in nodes.values()])
    weight = np.array([_weight(node) for node in nodes.values()])
    near = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) < _NEAR_M
    score = weight + 0.3 * near @ weight
    # Streets of a junction at the border of the map end at once.
    x_min, y_min, x_max, y_max = net.getBoundary()
    rim = np.minimum.reduce([xy[:, 0] - x_min, x_max - xy[:, 0], xy[:, 1] - y_min, y_max - xy[:, 1]])
    score *= np.clip(rim / HALF_M, 0.2, 1.0)
    best = int(np.argmax(score))
    return around(net, (float(xy[best, 0]), float(xy[best, 1])))


def around(net: Network, xy: tuple[float, float], half_m: float = HALF_M) -> JunctionArea:
    """Return the area of a square around a position, clipped to the network."""
    low_x, low_y, high_x, high_y = net.getBoundary()
    area = (
        round(max(xy[0] - half_m, low_x), 1), round(max(xy[1] - half_m, low_y), 1),
        round(min(xy[0] + half_m, high_x), 1), round(min(xy[1] + half_m, high_y), 1),
    )  # fmt: skip

    def inside(point: tuple[float, ...]) -> bool:
        return area[0] <= point[0] <= area[2] and area[1] <= point[1] <= area[3]

    edges = [e for e in net.getEdges(withInternal=False) if any(map(inside, e.getShape()))]
    lanes = [lane for edge in edges for lane in edge.getLanes()]
    nodes = [node for node in net.getNodes() if inside(node.getCoord()) and _weight(node) > 0]
    length = sum(LineString([p[:2] for p in lane.getShape()]).length for lane in lanes if lane.allows(_CAR))
    return JunctionArea(
        xy=(round(xy[0], 1), round(xy[1], 1)),
        area_m=area,
        lanes_km=length / 1000.0,
        signals=sum(node.getType().startswith("traffic_light") for node in nodes),
        walk=any(lane.allows("pedestrian") and not lane.allows(_CAR) for lane in lanes),
        cycle=any(lane.allows("bicycle") for lane in lanes),
    )


def _weight(node: Node) -> float:
    """Return the traffic weight of a junction: its car lanes by speed, 0 with fewer than three streets."""
    incoming = [edge for edge in node.getIncoming() if edge.allows(_CAR)]
    streets = {edge.getFromNode().getID() for edge in incoming}
    streets |= {edge.getToNode().getID() for edge in node.getOutgoing() if edge.allows(_CAR)}
    if len(streets) < 3:
        return 0.0
    lanes = sum(lane.allows(_CAR) * edge.getSpeed() / 13.9 for edge in incoming for lane in edge.getLanes())
    return float(lanes) * (1.5 if node.getType().startswith("traffic_light") else 1.0)


def beside_junction(net: Network, xy: tuple[float, float]) -> tuple[float, float, float] | None:
    """Return x, y and heading in degrees of a roadside unit facing a junction; None without room within 35 m."""
    lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes() if len(lane.getShape()) > 1]
    lines = [(LineString([p[:2] for p in lane.getShape()]), 0.5 * lane.getWidth()) for lane in lanes]
    cover = unary_union([line.buffer(half) for line, half in lines if line.distance(Point(xy)) < 80.0])
    for radius in np.arange(10.0, 36.0, 1.0):
        for angle in np.radians(np.arange(-45.0, 315.0, 15.0)):
            place = Point(xy[0] + radius * np.cos(angle), xy[1] + radius * np.sin(angle))
            if 2.0 <= cover.distance(place) <= 5.0:
                return round(place.x, 1), round(place.y, 1), round(float(np.degrees(angle) + 180.0) % 360.0, 0)
    return None
