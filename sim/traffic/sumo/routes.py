"""Candidate routes through a network or an area of it, and connected footways."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from shapely.geometry import LineString, Point, box

from sim.roads.network import Edge, Network
from sim.roads.network import Lane as RoadLane

Area = tuple[float, float, float, float]

MARGIN_M = 150.0
"""Margin around an area on whose edges trips begin and end, m."""

_TURNAROUNDS = ("t", "T")
"""SUMO's directions of connections that turn back, on the right and on the left."""

_ANYWHERE = 60
"""Approximate number of trip ends in an area without gates."""

_ROUND_S = 60.0
"""Least duration of a round trip, which takes as many laps as that needs, s."""

_COVERED = 0.4
"""Least share of the streets of an area on routes from gate to gate; with less, trips begin and end inside too."""

FOCUS_M = 40.0
"""Distance from the focus at which a trip is e times less likely, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Routes:
    """Candidate routes of one vClass: edge ids in driving order and the probability of each."""

    edges: tuple[tuple[str, ...], ...]
    probability: NDArray[np.float64]


@lru_cache(maxsize=32)
def candidate_routes(net: Network, vclass: str, area: Area | None, focus: tuple[float, float] | None) -> Routes:
    """Return the fastest routes between the gates of an area that touch it.

    A gate is an edge where traffic enters or leaves: one without a predecessor, or a successor, within the zone (the
    area and a margin). A road that joins no other is a route of its own. Where the routes from gate to gate leave most
    streets of the area empty, as in a ring or a closed town, traffic begins and ends anywhere. A route is the likelier
    the more lanes its ends have and the nearer it passes to the focus.

    Args:
        vclass: SUMO's class of the vehicles.
        area: (x_min, y_min, x_max, y_max), m; None is the whole network.
        focus: (x, y) that trips prefer to pass, m; None: no preference.

    Returns:
        Routes; none when no pair of gates is connected for this class.
    """
    edges = [e for e in net.getEdges(withInternal=False) if e.allows(vclass) and _near(e, area, MARGIN_M)]
    edges.sort(key=lambda e: e.getID())
    rows = {e.getID(): row for row, e in enumerate(edges)}
    links = [(rows[a.getID()], rows[b.getID()]) for a in edges for b in _next(a, vclass) if b.getID() in rows]
    if not links:  # the two halves of a ring
        halves = ((a.getID(), b.getID()) for a in edges for b in _next(a, vclass, back=True))
        links = [(rows[a], rows[b]) for a, b in halves if b in rows]
    followed, preceded = {a for a, _ in links}, {b for _, b in links}
    origins = [row for row in range(len(edges)) if row not in preceded and row in followed]
    goals = [row for row in range(len(edges)) if row not in followed and row in preceded]
    shapes = [LineString([p[:2] for p in e.getShape()]) for e in edges]
    if links:
        cost = [edges[b].getLength() / edges[b].getSpeed() + 0.1 for _, b in links]
        graph = csr_matrix((cost, tuple(np.array(links).T)), shape=(len(edges), len(edges)))
        anywhere = list(range(0, len(edges), max(1, len(edges) // _ANYWHERE)))
        for starts, ends, round_trips in (
            (origins, goals, False),
            (anywhere, anywhere, False),
            (anywhere, anywhere, True),
        ):
            paths = _paths(edges, graph, starts, ends, round_trips=round_trips)
            routes = _weighted(edges, shapes, paths, area, focus)
            if routes.edges and (starts is anywhere or _covered(edges, shapes, routes, area) >= _COVERED):
                return routes
    alone = [[row] for row in range(len(edges)) if row not in followed and row not in preceded]
    return _weighted(edges, shapes, alone, area, focus)


def _paths(
    edges: Sequence[Edge], graph: csr_matrix, origins: list[int], goals: list[int], *, round_trips: bool
) -> Iterator[list[int]]:
    """Yield the fastest paths of two edges or more from any origin to any goal, by rows of the edges.

    Args:
        round_trips: paths may end where they begin, and then take several laps.
    """
    if not origins or not goals:
        return
    _, before = dijkstra(graph, indices=origins, return_predecessors=True)
    for start, tree in zip(origins, before, strict=True):
        for goal in goals:
            closed = edges[goal].getToNode() is edges[start].getFromNode()
            if closed and not round_trips:
                continue
            path = _trace(tree, start, goal)
            if len(path) > 1:
                lap_s = sum(edges[row].getLength() / edges[row].getSpeed() for row in path)
                yield path * max(1, int(np.ceil(_ROUND_S / lap_s))) if closed and graph[goal, start] > 0 else path


def _weighted(
    edges: Sequence[Edge],
    shapes: Sequence[LineString],
    paths: Iterable[list[int]],
    area: Area | None,
    focus: tuple[float, float] | None,
) -> Routes:
    """Return the paths that touch the area as routes with their probabilities."""
    inside = [area is None or shape.intersects(box(*area)) for shape in shapes]
    off = [shape.distance(Point(focus)) if focus else 0.0 for shape in shapes]
    found, weight = [], []
    for path in paths:
        if any(inside[row] for row in path):
            found.append(tuple(edges[row].getID() for row in path))
            lanes = edges[path[0]].getLaneNumber() * edges[path[-1]].getLaneNumber()
            weight.append(lanes * np.exp(-min(off[row] for row in path) / FOCUS_M))
    return Routes(tuple(found), np.array(weight) / max(np.sum(weight), 1e-300))


def _covered(edges: Sequence[Edge], shapes: Sequence[LineString], routes: Routes, area: Area | None) -> float:
    """Return the share of the length of all edges inside the area that lies on a route."""
    used = {name for route in routes.edges for name in route}
    length = [shape.length if area is None else shape.intersection(box(*area)).length for shape in shapes]
    on_routes = sum(one for one, edge in zip(length, edges, strict=True) if edge.getID() in used)
    return on_routes / max(sum(length), 1e-9)


@lru_cache(maxsize=8)
def walkable_edges(net: Network, area: Area | None) -> tuple[tuple[Edge, ...], ...]:
    """Return groups of connected sidewalk and footway edges near an area.

    Walking areas and crossings connect edges where the network has them, else shared junctions do, as in SUMO.
    """
    every = sorted(net.getEdges(withInternal=True), key=lambda e: e.getID())
    paved = [e for e in every if e.getFunction() != "internal" and any(map(_is_pavement, e.getLanes()))]
    rows = {e.getID(): row for row, e in enumerate(paved)}
    crossed = any(e.getFunction() == "walkingarea" for e in paved)
    pairs = list(_foot_links(paved, rows) if crossed else _shared_junctions(paved))
    graph = (
        csr_matrix((np.ones(len(pairs)), tuple(np.array(pairs).T)), shape=(len(paved), len(paved))) if pairs else None
    )
    group = connected_components(graph, directed=False)[1] if graph is not None else np.arange(len(paved))
    streets = [
        row for row, e in enumerate(paved) if e.getFunction() == "" and e.getLength() > 15.0 and _near(e, area, 0.0)
    ]
    stretches = [
        tuple(paved[row] for row in streets if group[row] == g) for g in sorted({group[row] for row in streets})
    ]
    return tuple(stretches)


def _is_pavement(lane: RoadLane) -> bool:
    return bool(lane.allows("pedestrian") and not lane.allows("passenger"))


def _foot_links(paved: list, rows: dict[str, int]) -> Iterator[tuple[int, int]]:
    for edge in paved:
        for other in edge.getOutgoing():
            if other.getID() in rows:
                yield rows[edge.getID()], rows[other.getID()]


def _shared_junctions(paved: list) -> Iterator[tuple[int, int]]:
    first: dict[str, int] = {}
    for row, edge in enumerate(paved):
        for node in (edge.getFromNode(), edge.getToNode()):
            yield first.setdefault(node.getID(), row), row


def _near(edge: Edge, area: Area | None, margin: float) -> bool:
    """Return whether an edge reaches into the area with its margin."""
    if area is None:
        return True
    zone = box(*area).buffer(margin, join_style="mitre")
    return bool(zone.intersects(LineString([p[:2] for p in edge.getShape()])))


def _next(edge: Edge, vclass: str, *, back: bool = False) -> Iterator[Edge]:
    """Yield the successors of an edge for a vehicle class, without U-turns.

    Args:
        back: successors that lead back to where the edge begins count too, unless SUMO calls the link a turn.
    """
    for other, connections in edge.getOutgoing().items():
        turns_back = edge.getFromNode() is other.getToNode() and edge.getToNode() is other.getFromNode()
        links = [c for c in connections if not turns_back or (back and c.getDirection() not in _TURNAROUNDS)]
        if any(c.getFromLane().allows(vclass) and c.getToLane().allows(vclass) for c in links):
            yield other


def _trace(tree: NDArray[np.integer], start: int, goal: int) -> list[int]:
    """Return the path from start to goal in a tree of predecessors; may be empty."""
    path = [goal]
    while path[-1] != start:
        if tree[path[-1]] < 0:
            return []
        path.append(int(tree[path[-1]]))
    return path[::-1]
