"""Edges of the streets along which things stand, and random places along them."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.geometry import Array
from sim.world.beside.kinds import DENSITIES, Density, Kind, kinds_of
from sim.world.beside.plants import beside_line
from sim.world.furniture.kerbside import street_edges
from sim.world.roads.markings import offset
from sim.world.roads.streets import Streets
from sim.world.roads.surfaces import TOWN_SPEED_MPS

_PAVEMENT_M = 2.5
_BEHIND_RAIL_M, _MEDIAN_M = 2.2, 1.2


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """Edge of a street.

    Attributes:
        line: along the street's own way, m.
        side: on which the ground beside the road lies: 1 left of the line, -1 right.
        kerb_m: from the line to the place of posts, m.
        plot_m: from the line to the boundary of the plots, m.
        kind: of place.
        fast: it has guard rails in place of kerbs.
    """

    line: shapely.LineString
    side: float
    kerb_m: float
    plot_m: float
    kind: Kind
    fast: bool

    @property
    def density(self) -> Density:
        """What stands along it."""
        return DENSITIES[self.kind]

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.line.length)

    def beside(self, aside_m: float, around_m: float = 0.0) -> shapely.LineString:
        """Return the parallel at a distance from its line, prolonged by `around_m` at both ends, around the corners."""
        coords = offset(np.asarray(self.line.coords), self.side * aside_m)
        if around_m:
            first, last = coords[0] - coords[1], coords[-1] - coords[-2]
            first, last = (around_m * way / max(float(np.hypot(*way)), 1e-9) for way in (first, last))
            coords = np.concatenate([[coords[0] + first], coords, [coords[-1] + last]])
        return shapely.LineString(coords)


def edges_of(streets: Streets, houses: shapely.Geometry) -> list[Edge]:
    """Return the edges of all streets.

    Args:
        houses: polygon of the buildings, which tell towns from the country.
    """
    pairs = street_edges(streets)
    kinds = kinds_of([lane for lane, _ in pairs], houses)
    found = []
    for (lane, side), kind in zip(pairs, kinds, strict=True):
        half, at_kerb = 0.5 * lane.width, side == lane.kerb_side
        verge = lane.verge if at_kerb else 0.0
        town = lane.speed <= TOWN_SPEED_MPS
        plot = half + (max(verge, _PAVEMENT_M) if town and at_kerb else verge)
        line = shapely.LineString(lane.line)
        found.append(
            Edge(
                line,
                side,
                half + verge + 0.6,
                plot + (0.0 if town else _BEHIND_RAIL_M if at_kerb else _MEDIAN_M),
                kind,
                not town,
            )
        )
    return found


def yielding(streets: Streets) -> shapely.Geometry:
    """Return the points where drivers yield."""
    return shapely.MultiPoint([lane.line[-1] for lane in streets.lanes if lane.stop == "yield"])


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """N random places along edges.

    Attributes:
        xy: (N, 2) m.
        yaw: (N,) way of the road, which lies on the right, rad.
        edge: (N,) rows of the edges.
    """

    xy: Array
    yaw: Array
    edge: NDArray[np.int64]


def scatter(
    rng: np.random.Generator,
    edges: list[Edge],
    counts_per_100m: list[float],
    low_m: float,
    high_m: float,
    ends_m: float,
) -> Places:
    """Return random places beside the edges, evenly spread along each.

    Args:
        counts_per_100m: per edge.
        low_m: nearest distance beyond the boundary of the plots, m; from the place of posts if negative.
        high_m: farthest distance.
        ends_m: free length at both ends of an edge, m.
    """
    flat, yaw, of = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, np.int64)]
    for row, (edge, per_100m) in enumerate(zip(edges, counts_per_100m, strict=True)):
        room = edge.length - 2.0 * ends_m
        expected = max(room, 0.0) * per_100m / 100.0
        count = int(expected + rng.uniform())
        if not count or not per_100m:
            continue
        along = ends_m + room * (np.arange(count) + rng.uniform(0.1, 0.9, count)) / count
        base = edge.kerb_m if low_m < 0.0 else edge.plot_m
        aside = base + (rng.uniform(low_m, high_m, count) if low_m >= 0.0 else np.zeros(count))
        here = beside_line(edge.line, along, edge.side * aside)
        on = beside_line(edge.line, along, np.zeros(count))
        out = here - on
        # With the road on the right: the way lies a quarter turn to the right of the way out.
        yaw.append(np.arctan2(out[:, 1], out[:, 0]) - 0.5 * np.pi)
        flat.append(here)
        of.append(np.full(count, row))
    return Places(np.concatenate(flat), np.concatenate(yaw), np.concatenate(of))
