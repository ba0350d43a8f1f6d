"""Path of a SUMO vehicle along the lanes ahead, as a world polyline."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Lane:
    """Lane of the running network, as drawn.

    Attributes:
        shape: (K, 2) m.
        along: (K,) distances from its start, m.
        scale: drawn length over the network's: the two may differ, and positions scale between them.
        whole: (L, 2) the shape without points at its ends' places.
        whole_m: its length, m.
        edge: edge that it belongs to.
        links: lane, its edge and the junction's lane to it, "" for none, of each way on.
    """

    shape: Array
    along: Array
    scale: float
    whole: Array
    whole_m: float
    edge: str
    links: tuple[tuple[str, str, str], ...]


class LanePaths:
    """Paths along the lanes of a running simulation, each of which is read once.

    Args:
        sumo: the libsumo module of the running simulation.
    """

    def __init__(self, sumo: Any) -> None:
        self._sumo = sumo
        self._lanes: dict[str, _Lane] = {}

    def path(self, vehicle: str, centre: Array, ahead_m: float) -> Array:
        """Return the path of a vehicle along its route, lane by lane, junctions included.

        Args:
            centre: (2,) centre of its box, m: the first point.
            ahead_m: length of the path, m; shorter where the route ends.

        Returns:
            (K, 2) with K >= 2, no point twice.
        """
        pieces = [np.asarray(centre, np.float64)[None]]
        name = self._sumo.vehicle.getLaneID(vehicle)
        done = self._sumo.vehicle.getLanePosition(vehicle)
        edges = self._sumo.vehicle.getRoute(vehicle)
        index = max(self._sumo.vehicle.getRouteIndex(vehicle), 0)
        remaining = ahead_m
        while name and remaining > 0.0:
            lane = self._lane(name)
            start, end = done * lane.scale, remaining + done * lane.scale
            if start == 0.0 and end >= lane.along[-1]:
                piece, length = lane.whole, lane.whole_m
            else:
                piece = _cut(lane.shape, lane.along, start, end)
                length = _length(piece)
            pieces.append(piece)
            remaining -= length
            done = 0.0
            name, moved_on = self._next(name, lane, edges, index)
            index += moved_on
        return _without_repeats(np.concatenate(pieces), ahead_m)

    def _next(self, name: str, lane: _Lane, edges: tuple[str, ...], index: int) -> tuple[str, int]:
        """Return the next lane, junction lanes included, and the number of route edges passed."""
        if name.startswith(":"):
            return (lane.links[0][2] or lane.links[0][0], 0) if lane.links else ("", 0)
        # A vehicle on a lane without a link to its next edge will change lanes: take the nearest that has one.
        position = edges.index(lane.edge, index) if lane.edge in edges[index:] else index
        if position + 1 >= len(edges):
            return "", 0
        number = int(name.rsplit("_", 1)[1])
        for other in sorted(range(self._sumo.edge.getLaneNumber(lane.edge)), key=lambda k: (abs(k - number), k)):
            for target, edge, via in self._lane(f"{lane.edge}_{other}").links:
                if edge == edges[position + 1]:
                    return (via or target), position + 1 - index
        return "", 0

    def _lane(self, name: str) -> _Lane:
        if name not in self._lanes:
            lane = self._sumo.lane
            shape = np.array(lane.getShape(name), np.float64)[:, :2]
            along = _along(shape)
            whole = _cut(shape, along, 0.0, along[-1])
            links = tuple((link[0], lane.getEdgeID(link[0]), link[4]) for link in lane.getLinks(name))
            scale = _length(shape) / max(lane.getLength(name), 1e-6)
            self._lanes[name] = _Lane(shape, along, scale, whole, _length(whole), lane.getEdgeID(name), links)
        return self._lanes[name]


def _steps(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points[1:] - points[:-1], axis=1))


def _length(points: Array) -> float:
    return float(_steps(points).sum())


def _along(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(_steps(points))])


def _cut(points: Array, along: Array, start: float, end: float) -> Array:
    """Return a polyline, whose points have distances `along` from its start, between two distances."""
    last = float(along[-1])
    start, end = (min(max(at, 0.0), last) for at in (start, max(start, end)))
    inner = along[(along > start) & (along < end)]
    at = np.concatenate([[start], inner, [end]])
    cut = np.zeros((len(at), 2))
    for axis in range(2):
        cut[:, axis] = np.interp(at, along, points[:, axis])
    return cut


def _without_repeats(points: Array, ahead_m: float) -> Array:
    keep = np.concatenate([[True], _steps(points) > 1e-6])
    path = points[keep]
    if len(path) == 1:
        return np.repeat(path, 2, axis=0)
    return _cut(path, _along(path), 0.0, ahead_m)
