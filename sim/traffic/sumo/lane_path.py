"""Path of a SUMO vehicle along the lanes ahead, as a world polyline."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def lane_path(sumo: Any, vehicle: str, centre: NDArray[np.float64], ahead_m: float) -> NDArray[np.float64]:
    """Return the path of a vehicle along its route, lane by lane, junctions included.

    Args:
        sumo: the libsumo module of the running simulation.
        centre: (2,) centre of its box, m: the first point.
        ahead_m: length of the path, m; shorter where the route ends.

    Returns:
        (K, 2) with K >= 2, no point twice.
    """
    pieces = [np.asarray(centre, np.float64)[None]]
    lane = sumo.vehicle.getLaneID(vehicle)
    done = sumo.vehicle.getLanePosition(vehicle)
    edges = sumo.vehicle.getRoute(vehicle)
    index = max(sumo.vehicle.getRouteIndex(vehicle), 0)
    remaining = ahead_m
    while lane and remaining > 0.0:
        shape = np.array(sumo.lane.getShape(lane), np.float64)[:, :2]
        # Lengths in the network may differ from those of the drawn shape: positions scale between them.
        scale = _length(shape) / max(sumo.lane.getLength(lane), 1e-6)
        piece = _cut(shape, done * scale, remaining + done * scale)
        pieces.append(piece)
        remaining -= _length(piece)
        done = 0.0
        internal = lane.startswith(":")
        lane, moved_on = _next_lane(sumo, lane, edges, index, internal)
        index += moved_on
    return _without_repeats(np.concatenate(pieces), ahead_m)


def _next_lane(sumo: Any, lane: str, edges: tuple[str, ...], index: int, internal: bool) -> tuple[str, int]:
    """Return the next lane, junction lanes included, and the number of route edges passed."""
    if internal:
        links = sumo.lane.getLinks(lane)
        if not links:
            return "", 0
        target, via = links[0][0], links[0][4]
        return (via, 0) if via else (target, 0)
    edge = sumo.lane.getEdgeID(lane)
    # A vehicle on a lane without a link to its next edge will change lanes: take the nearest that has one.
    position = edges.index(edge, index) if edge in edges[index:] else index
    if position + 1 >= len(edges):
        return "", 0
    number = int(lane.rsplit("_", 1)[1])
    for other in sorted(range(sumo.edge.getLaneNumber(edge)), key=lambda k: (abs(k - number), k)):
        for link in sumo.lane.getLinks(f"{edge}_{other}"):
            if sumo.lane.getEdgeID(link[0]) == edges[position + 1]:
                return (link[4] or link[0]), position + 1 - index
    return "", 0


def _length(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _cut(points: NDArray[np.float64], start: float, end: float) -> NDArray[np.float64]:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    start, end = np.clip([start, max(start, end)], 0.0, along[-1])
    inner = along[(along > start) & (along < end)]
    at = np.concatenate([[start], inner, [end]])
    return np.stack([np.interp(at, along, points[:, k]) for k in range(2)], axis=1)


def _without_repeats(points: NDArray[np.float64], ahead_m: float) -> NDArray[np.float64]:
    keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6])
    path = points[keep]
    if len(path) == 1:
        return np.repeat(path, 2, axis=0)
    return _cut(path, 0.0, ahead_m)
