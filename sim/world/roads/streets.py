"""Lanes and junctions of a network near an area, as lines and polygons."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from sim.geometry import Array
from sim.roads.network import Edge, Network
from sim.roads.network import Lane as RoadLane
from sim.world.roads.terrain import Terrain, land

Area = tuple[float, float, float, float]

_ROAD_CLASSES = ("passenger", "delivery", "bus", "truck", "motorcycle", "taxi", "coach", "trailer")
_WALK_WIDTH_M = 2.6

NOTHING = shapely.Polygon()
"""Empty polygon."""


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """Lane near the area.

    Attributes:
        kind: "road", "bicycle" (part of a carriageway), "walk", "rail" or "crossing".
        line: (K, 2) centre line, m.
        width: m.
        edge: id of its edge.
        index: from the kerb among the lanes of its kind, 0 first.
        count: lanes of its kind on the edge.
        verge: width of lanes of other kinds on its kerb's side, such as sidewalks, m.
        internal: it lies in a junction.
        speed: limit, m/s.
        stop: control at its end: "signal", "yield" or "".
        opposite: the edge has a partner in the other direction along its inner side.
        beside_road: the edge has lanes for motor vehicles.
        kerb_side: side of its kerb: -1 right, or 1 left where traffic keeps left.
    """

    kind: str
    line: Array
    width: float
    edge: str
    index: int
    count: int
    verge: float
    internal: bool
    speed: float
    stop: str
    opposite: bool
    beside_road: bool
    kerb_side: float = -1.0


@dataclass(frozen=True, slots=True, eq=False)
class Streets:
    """Lanes near an area, and the ground they cover.

    Attributes:
        area: (x_min, y_min, x_max, y_max) the part that carries agents, m.
        window: the wider part that is meshed.
        lanes: all lanes that touch the window.
        road: polygon of the carriageways and of the junctions between them.
        walk: polygon of footways and crossings off the road.
        rail: polygon of tracks off the road.
        terrain: height field; of the carriageways, where `land` has that of all else.
        bays: polygon of parking bays, a part of the road.
        land: height field beside the carriageways, on the triangles of `terrain`; None where no kerb raises it.
        kerbs: polygon of the stones between both.
        islands: polygon of islands in junctions, no part of the road.
        on_foot: polygon of where people walk, but for crossings: also on the road and on islands.
        swept: polygon beside the road that long vehicles sweep at corners: even, and nothing stands there.
    """

    area: Area
    window: Area
    lanes: tuple[Lane, ...]
    road: shapely.Geometry
    walk: shapely.Geometry
    rail: shapely.Geometry
    terrain: Terrain
    bays: shapely.Geometry = NOTHING
    land: Terrain | None = None
    kerbs: shapely.Geometry = NOTHING
    islands: shapely.Geometry = NOTHING
    on_foot: shapely.Geometry = NOTHING
    swept: shapely.Geometry = NOTHING

    def height(self, xy: Array) -> Array:
        """Return (N,) height of the road or the land at (N, 2) positions."""
        if self.land is None:
            return self.terrain.height(xy)
        on_road = shapely.intersects_xy(self.road, *xy.T)
        level = np.zeros(len(xy))
        level[on_road] = self.terrain.height(xy[on_road])
        level[~on_road] = self.land.height(xy[~on_road])
        return level


def read_streets(net: Network, area: Area | None, margin_m: float, bays: shapely.Geometry = NOTHING) -> Streets:
    """Read the lanes within `margin_m` of an area (default: the whole network) from a sumolib network.

    Args:
        area: x_min, y_min, x_max, y_max, m.
        bays: polygon of parking bays, a part of the road.
    """
    low_x, low_y, high_x, high_y = area or net.getBoundary()
    area = (float(low_x), float(low_y), float(high_x), float(high_y))
    window = (area[0] - margin_m, area[1] - margin_m, area[2] + margin_m, area[3] + margin_m)
    frame = shapely.box(*window)
    edges = [edge for edge in net.getEdges(withInternal=True) if edge.getFunction() != "walkingarea"]
    lanes = []
    lines: list[Array] = []
    for edge in sorted(edges, key=lambda edge: edge.getID()):
        opposite = _has_opposite(edge)
        kinds = [_kind(edge, lane) for lane in edge.getLanes()]
        for lane in edge.getLanes():
            line = np.array(lane.getShape3D(), np.float64)
            if len(line) < 2 or not frame.intersects(shapely.LineString(line[:, :2])):
                continue
            lines.append(line)
            lanes.append(_lane(edge, lane, kinds, _without_repeats(line[:, :2]), opposite, net.kerb_side))
    road = _close(_cover(lanes, ("road", "bicycle")) | _junctions(net, frame) | bays) & frame
    areas = [edge for edge in net.getEdges(withInternal=True) if edge.getFunction() == "walkingarea"]
    walk = _cover(lanes, ("walk",)) | _walking_areas(areas, frame)
    on_foot = _close(walk & frame)
    walk = on_foot - road
    rail = (_cover(lanes, ("rail",)) & frame) - road - walk
    terrain = land(window, lines, shapely.union_all([road, walk, rail]))
    return Streets(area, window, tuple(lanes), road, walk, rail, terrain, bays, on_foot=on_foot)


def heading(ends: Array) -> float:
    """Return the direction of (2, 2) ends of a line, rad."""
    (x, y), (to_x, to_y) = ends
    return float(np.arctan2(to_y - y, to_x - x))


def _kind(edge: Edge, lane: RoadLane) -> str:
    if edge.getFunction() == "crossing":
        return "crossing"
    if any(lane.allows(name) for name in _ROAD_CLASSES):
        return "road"
    if lane.allows("bicycle"):
        return "bicycle" if not lane.allows("pedestrian") else "walk"
    return "walk" if lane.allows("pedestrian") else "rail"


def _lane(edge: Edge, lane: RoadLane, kinds: list[str], line: Array, opposite: bool, kerb_side: float) -> Lane:
    own = lane.getIndex()
    kind = kinds[own]
    # A cycle lane beside a carriageway is part of it.
    if kind == "bicycle" and "road" not in kinds and edge.getFunction() == "":
        kind = "walk"
    internal = edge.getFunction() != ""
    others = [other.getWidth() for other, of in zip(edge.getLanes()[:own], kinds, strict=False) if of != kinds[own]]
    return Lane(
        kind=kind,
        line=line,
        width=min(lane.getWidth(), _WALK_WIDTH_M) if kind == "walk" and "road" not in kinds else lane.getWidth(),
        edge=edge.getID(),
        index=kinds[:own].count(kinds[own]),
        count=kinds.count(kinds[own]),
        verge=float(sum(others)),
        internal=internal,
        speed=edge.getSpeed(),
        stop="" if internal else _stop(edge, lane),
        opposite=opposite,
        beside_road="road" in kinds and not internal,
        kerb_side=kerb_side,
    )


def _stop(edge: Edge, lane: RoadLane) -> str:
    """Return the control at the end of a lane: "signal", "yield" or ""."""
    if edge.getToNode().getType().startswith("traffic_light"):
        return "signal"
    states = {link.getState() for link in lane.getOutgoing() if hasattr(link, "getState")}
    return "yield" if states and states <= {"m", "s", "w"} and len(edge.getToNode().getIncoming()) > 2 else ""


def _has_opposite(edge: Edge) -> bool:
    if edge.getFunction() != "":
        return False
    back = [other for other in edge.getToNode().getOutgoing() if other.getToNode() is edge.getFromNode()]
    left = np.array(edge.getLanes()[-1].getShape()[:1]) if back else np.zeros((1, 2))
    reach = 1.25 * edge.getLanes()[-1].getWidth()
    return any(np.hypot(*(np.array(other.getLanes()[-1].getShape()[-1:]) - left)[0]) < reach for other in back)


def _without_repeats(line: Array) -> Array:
    keep = np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-3])
    return line[keep] if keep.sum() > 1 else line + np.array([[0.0, 0.0]] * (len(line) - 1) + [[1e-2, 0.0]])


def _cover(lanes: list[Lane], kinds: tuple[str, ...]) -> shapely.Geometry:
    chosen = [lane for lane in lanes if lane.kind in kinds]
    strips = [shapely.LineString(lane.line).buffer(0.5 * lane.width, cap_style="flat") for lane in chosen]
    return shapely.unary_union(strips)


def _junctions(net: Network, frame: shapely.Geometry) -> shapely.Geometry:
    """Return the polygons of the junctions that motor vehicles enter."""
    shapes = []
    for node in net.getNodes():
        drivable = any(lane.allows(c) for e in node.getIncoming() for lane in e.getLanes() for c in _ROAD_CLASSES)
        if drivable and len(node.getShape()) > 2:
            shape = shapely.Polygon([point[:2] for point in node.getShape()]).buffer(0)
            if shape.intersects(frame):
                shapes.append(shape)
    return shapely.unary_union(shapes)


def _walking_areas(edges: Sequence[Edge], frame: shapely.Geometry) -> shapely.Geometry:
    lines = [np.array(edge.getLanes()[0].getShape())[:, :2] for edge in edges]
    shapes = [shapely.Polygon(line).buffer(0) for line in lines if len(line) > 2]
    return shapely.unary_union([shape for shape in shapes if shape.intersects(frame)])


def _close(shape: shapely.Geometry, gap_m: float = 0.4) -> shapely.Geometry:
    """Close gaps between adjacent lanes and drop corners too small to matter."""
    return shape.buffer(gap_m, join_style="mitre").buffer(-gap_m, join_style="mitre").simplify(0.03).buffer(0)
