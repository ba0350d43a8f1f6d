"""Road network of a scenario as highway-env's, for its observations, controllers and pictures.

highway-env's plane has x forward and y to the right, headings turn clockwise: a position is (x, -y) of the world, a
heading minus the yaw. Its lane 0 is the leftmost.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from highway_env.road.lane import LineType, PolyLaneFixedWidth
from highway_env.road.road import RoadNetwork
from numpy.typing import NDArray

from sim.encounters import network_file
from sim.roads.networks import read_network
from sim.scenario import Scenario
from sim.traffic.highway.roads import read_roads

LaneIndex = tuple[str, str, int]

_LEAST_M = 1.5
"""Least length of a lane: highway-env's splines need two samples, m."""
_NEAR_M = 12.0
"""Distance within which the nearest lane is searched first, m."""
_START_M = 46.0
"""Distance of the ego of `intersection-v0` from the middle of its junction, m."""


class SampledLane(PolyLaneFixedWidth):
    """Lane of fixed width along a line; highway-env's own tries one sample after the other for each position.

    Attributes:
        left: (K, 2) its left border in highway-env's plane, m.
        right: (K, 2) its right border.
        bordered: whether its borders are drawn; those of lanes through a junction cross each other.

    Args:
        line: (K, 2) its middle in highway-env's plane, without repeated points.
        bordered: see above.
    """

    def __init__(self, line: NDArray[np.float64], width_m: float, limit_mps: float, bordered: bool = True) -> None:
        super().__init__(line.tolist(), width_m, _BORDERS, speed_limit=limit_mps)
        self.bordered = bordered
        self._places = np.array([pose.position for pose in self.curve.poses])
        self._along = np.array([pose.normal for pose in self.curve.poses])
        self._known = np.ones(len(self._places), bool)
        self._known[[0, -1]] = False
        ahead = np.gradient(line, axis=0)
        side = ahead[:, ::-1] * [-1.0, 1.0] / np.maximum(np.hypot(*ahead.T), 1e-9)[:, None]
        self.left, self.right = line - 0.5 * width_m * side, line + 0.5 * width_m * side

    def local_coordinates(self, position: NDArray[np.float64]) -> tuple[float, float]:
        """Return the distance along and beside the lane, m, as highway-env's own: the last sample that is passed."""
        offset = position - self._places
        ahead = np.einsum("ij,ij->i", offset, self._along)
        if ahead[-1] >= 0.0:
            row = len(ahead) - 1
        else:
            passed = np.flatnonzero((ahead >= 0.0) & self._known)
            row = int(passed[-1]) if len(passed) else 0
        (x, y), (dx, dy) = self._along[row], offset[row]
        return float(self.curve.s_samples[row] + ahead[row]), float(x * dy - y * dx)


class IndexedRoadNetwork(RoadNetwork):
    """Road network whose nearest lane is found by a spatial index: highway-env's own scans all lanes."""

    def __init__(self) -> None:
        super().__init__()
        self._indices: list[LaneIndex] = []
        self._lines: list[shapely.LineString] = []
        self._tree = shapely.STRtree([])

    def add_line(
        self, start: str, end: str, line: NDArray[np.float64], width_m: float, limit_mps: float, bordered: bool
    ) -> None:
        """Add a lane along a (K, 2) line in highway-env's plane, the leftmost of a road first, see `SampledLane`."""
        self.add_lane(start, end, SampledLane(_stretched(line), width_m, limit_mps, bordered))
        self._indices.append((start, end, len(self.graph[start][end]) - 1))
        self._lines.append(shapely.LineString(line))

    def finish(self) -> None:
        """Build the index and give every end of a road a node."""
        self._tree = shapely.STRtree(self._lines)
        for ends in list(self.graph.values()):
            for end in ends:
                self.graph.setdefault(end, {})

    def lanes_within(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> list[SampledLane]:
        """Return the lanes in a rectangle of highway-env's plane, those through junctions first."""
        rows = np.sort(self._tree.query(shapely.box(*low, *high).buffer(_NEAR_M)))
        return sorted((self.get_lane(self._indices[row]) for row in rows), key=lambda lane: lane.bordered)

    def get_closest_lane_index(self, position: NDArray[np.float64], heading: float | None = None) -> LaneIndex:
        """Return the index of the lane that is nearest in place and heading, as highway-env weighs them."""
        point = shapely.Point(position)
        near = self._tree.query(point, predicate="dwithin", distance=_NEAR_M)
        rows = sorted(near.tolist()) or [int(self._tree.nearest(point))]
        distances = [self._distance(row, point, heading) for row in rows]
        return self._indices[rows[int(np.argmin(distances))]]

    def _distance(self, row: int, point: shapely.Point, heading: float | None) -> float:
        line = self._lines[row]
        away = float(line.distance(point))
        if heading is None:
            return away
        along = line.project(point)
        a, b = line.interpolate(max(along - 0.5, 0.0)), line.interpolate(along + 0.5)
        turn = heading - np.arctan2(b.y - a.y, b.x - a.x)
        return away + abs((turn + np.pi) % (2.0 * np.pi) - np.pi)


def network_of(scenario: Scenario, seed: int) -> RoadNetwork:
    """Return highway-env's network of a scenario: its own for a place of highway-env, else a mirrored one.

    Raises:
        ScenarioError: the network is invalid.
    """
    if scenario.network.highway_env:
        return read_roads(scenario.network.highway_env).network
    return mirrored_network(network_file(scenario, seed))


def to_plane(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (..., 2) world positions in highway-env's plane; its own inverse."""
    return np.asarray(xy, np.float64) * [1.0, -1.0]


@dataclass(frozen=True)
class Origin:
    """Origin of absolute positions in highway-env's plane.

    Attributes:
        position: (2,) of the origin in the plane, m.
        heading: of its x axis in the plane, rad.
    """

    position: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0

    def seen(self, position: NDArray[np.float64]) -> tuple[float, float]:
        """Return a position of the plane as seen from the origin, m."""
        dx, dy = position[0] - self.position[0], position[1] - self.position[1]
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return float(cos * dx + sin * dy), float(cos * dy - sin * dx)


def junction_ahead(scenario: Scenario, seed: int, route: NDArray[np.float64]) -> Origin:
    """Return the junction that a route comes to, as highway-env's `intersection-v0` sees it.

    Its middle is the origin, and who comes along the route drives towards smaller y. Without a junction of three roads
    or more the origin is where `intersection-v0` has it, `_START_M` ahead.

    Args:
        route: (K, 2) in the world, from the ego onwards, m.

    Raises:
        ScenarioError: the network is invalid.
    """
    line = shapely.LineString(to_plane(route))
    nearest, middle = math.inf, line.interpolate(_START_M)
    if not scenario.network.highway_env:
        for area in junctions(network_file(scenario, seed)):
            ends = shapely.points(shapely.get_coordinates(line.intersection(area)))
            along = float(shapely.line_locate_point(line, ends).min(initial=math.inf))
            if 0.0 < along < nearest:
                nearest, middle = along, area.centroid
    along = nearest if math.isfinite(nearest) else _START_M
    before, after = line.interpolate(max(along - 1.0, 0.0)), line.interpolate(max(along, 1.0))
    forward = math.atan2(after.y - before.y, after.x - before.x)
    return Origin((middle.x, middle.y), forward + 0.5 * math.pi)


@lru_cache(maxsize=8)
def junctions(path: Path) -> tuple[shapely.Polygon, ...]:
    """Return the areas of the junctions of three roads or more of a .net.xml file, in highway-env's plane."""
    areas = []
    for node in read_network(path).getNodes():
        ends = {edge.getFromNode().getID() for edge in node.getIncoming() if edge.getFunction() != "internal"}
        ends |= {edge.getToNode().getID() for edge in node.getOutgoing() if edge.getFunction() != "internal"}
        shape = node.getShape()
        if len(ends) >= 3 and len(shape) >= 3:
            areas.append(shapely.make_valid(shapely.Polygon(to_plane(np.array(shape)[:, :2]))))
    return tuple(areas)


@lru_cache(maxsize=8)
def mirrored_network(path: Path) -> IndexedRoadNetwork:
    """Return highway-env's network of a .net.xml file: every lane that cars may use.

    A road E runs from node `E<` to node `E>`, a lane through a junction from `A>` to `B<`.

    Raises:
        ScenarioError: the file is missing or damaged.
    """
    net = read_network(path)
    network = IndexedRoadNetwork()
    for edge in net.getEdges(withInternal=True):
        lanes = [lane for lane in edge.getLanes()[::-1] if lane.allows("passenger") and len(lane.getShape()) > 1]
        if not lanes:
            continue
        start, end = _nodes(edge)
        for lane in lanes:
            line = to_plane(np.array(lane.getShape())[:, :2])
            bordered = edge.getFunction() != "internal"
            network.add_line(start, end, line, float(lane.getWidth()), float(lane.getSpeed()), bordered)
    network.finish()
    return network


def _nodes(edge: Any) -> tuple[str, str]:
    if edge.getFunction() != "internal":
        return f"{edge.getID()}<", f"{edge.getID()}>"
    before = next(iter(edge.getIncoming()), None)
    after = next(iter(edge.getOutgoing()), None)
    start = f"{edge.getID()}<" if before is None else _end(before)
    end = f"{edge.getID()}>" if after is None else _start(after)
    return start, end


def _start(edge: Any) -> str:
    return f"{edge.getID()}<"


def _end(edge: Any) -> str:
    return f"{edge.getID()}>"


def _stretched(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a line without repeated points, lengthened at its end to `_LEAST_M`."""
    step = np.hypot(*np.diff(line, axis=0).T)
    line = line[np.concatenate([[True], step > 1e-6])]
    if len(line) < 2:
        return np.array([line[0], line[0] + [_LEAST_M, 0.0]])
    missing = _LEAST_M - float(np.hypot(*np.diff(line, axis=0).T).sum())
    if missing > 0.0:
        last = line[-1] - line[-2]
        line = np.concatenate([line, [line[-1] + missing * last / np.hypot(*last)]])
    return line


_BORDERS = (LineType.STRIPED, LineType.STRIPED)
