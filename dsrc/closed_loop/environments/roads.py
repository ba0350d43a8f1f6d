"""Road network of a scenario as highway-env's, for its observations, controllers and pictures.

highway-env's plane has x forward and y to the right, headings turn clockwise: a position is (x, -y) of the world, a
heading minus the yaw. Its lane 0 is the leftmost.
"""

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


class IndexedRoadNetwork(RoadNetwork):
    """Road network whose nearest lane is found by a spatial index: highway-env's own scans all lanes."""

    def __init__(self) -> None:
        super().__init__()
        self._indices: list[LaneIndex] = []
        self._lines: list[shapely.LineString] = []
        self._tree = shapely.STRtree([])

    def add_line(self, start: str, end: str, line: NDArray[np.float64], width_m: float, limit_mps: float) -> None:
        """Add a lane along a (K, 2) line in highway-env's plane, the leftmost of a road first."""
        lane = PolyLaneFixedWidth(_stretched(line).tolist(), width_m, _BORDERS, speed_limit=limit_mps)
        self.add_lane(start, end, lane)
        self._indices.append((start, end, len(self.graph[start][end]) - 1))
        self._lines.append(shapely.LineString(line))

    def finish(self) -> None:
        """Build the index and give every end of a road a node."""
        self._tree = shapely.STRtree(self._lines)
        for ends in list(self.graph.values()):
            for end in ends:
                self.graph.setdefault(end, {})

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


@lru_cache(maxsize=8)
def mirrored_network(path: Path) -> IndexedRoadNetwork:
    """Return highway-env's network of a .net.xml file: every lane that cars may use.

    A road E runs from node `E<` to node `E>`, a lane through a junction from `A>` to `B<`.

    Args:
        path: network file.

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
            network.add_line(start, end, line, float(lane.getWidth()), float(lane.getSpeed()))
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
