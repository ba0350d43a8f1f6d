"""Trees planted where trunk and crown have room: in rows, scattered, and where a map has them."""

from dataclasses import replace

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import MeshPart, move
from sim.world.beside.edges import Edge, Places, scatter
from sim.world.beside.ground import Ground
from sim.world.beside.trees import SPECIES, Tree, pruned, tree
from sim.world.furniture.map_objects import MapObjects

OVER_ROAD_M, _OVER_WALK_M = 4.8, 2.6
_VARIANTS = 4
_TRUNK_M = 0.35


class Nursery:
    """Trees ready to be planted: a few of each species, fine and coarse."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._of = {
            (name, fine): [tree(rng, species, fine=fine) for _ in range(_VARIANTS)]
            for name, species in SPECIES.items()
            for fine in (True, False)
        }

    def choose(self, rng: np.random.Generator, names: tuple[str, ...], fine: bool) -> Tree:
        """Return a tree of one of the species."""
        name = names[int(rng.integers(len(names)))]
        return self._of[name, fine][int(rng.integers(_VARIANTS))]


def _plant(
    rng: np.random.Generator, places: Places, edges: list[Edge], trunk_apart_m: float, nursery: Nursery, ground: Ground
) -> list[MeshPart]:
    """Return trees at those places that have room for trunk and crown."""
    fine = ground.is_fine(places.xy)
    free = ground.free(places.xy, _TRUNK_M, tall=True)
    parts = []
    for row in np.flatnonzero(free):
        chosen = nursery.choose(rng, edges[int(places.edge[row])].density.species, bool(fine[row]))
        yaw, size = float(rng.uniform(0.0, 2.0 * np.pi)), float(rng.uniform(0.85, 1.15))
        grown = _fitting(replace(chosen, reach_m=size * chosen.reach_m), places.xy[row], ground)
        if grown is not None and ground.take(places.xy[row], trunk_apart_m):
            parts.append(move(grown.part, foot_at(ground, places.xy[row]), yaw, [size, size, 1.0]))
    return parts


def _fitting(whole: Tree, xy: Array, ground: Ground) -> Tree | None:
    """Return a tree pruned where its crown hangs over a road or a footway; None where there is no room for it."""
    place = shapely.Point(xy)
    if shapely.dwithin(ground.houses, place, whole.reach_m + 0.1):
        return None
    if shapely.dwithin(ground.road, place, whole.reach_m + 0.3):
        return pruned(whole, OVER_ROAD_M)
    return pruned(whole, _OVER_WALK_M) if shapely.dwithin(ground.walk, place, whole.reach_m) else whole


def kerb_rows(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: Nursery, ground: Ground
) -> list[MeshPart]:
    """Return rows of trees behind the pavement."""
    places = scatter(rng, edges, [density * edge.density.row for edge in edges], 0.9, 1.5, 8.0)
    return _plant(rng, places, edges, 1.6, nursery, ground)


def scattered(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: Nursery, ground: Ground
) -> list[MeshPart]:
    """Return trees scattered over gardens, verges and woods."""
    places = scatter(rng, edges, [density * edge.density.trees for edge in edges], 2.0, 16.0, 5.0)
    return _plant(rng, places, edges, 1.3, nursery, ground)


def mapped(
    rng: np.random.Generator, map_objects: MapObjects, edges: list[Edge], nursery: Nursery, ground: Ground
) -> list[MeshPart]:
    """Return the trees of a map, in species of its places."""
    xy = map_objects.points.get("tree", np.zeros((0, 2)))
    if not len(xy) or not edges:
        return []
    xy = xy[shapely.contains_xy(ground.frame, *xy.T)]
    lines = shapely.STRtree([edge.line for edge in edges])
    nearest = np.asarray(lines.nearest(shapely.points(xy)), np.int64)
    return _plant(rng, Places(xy, np.zeros(len(xy)), nearest), edges, 0.5, nursery, ground)


def foot_at(ground: Ground, xy: Array) -> Array:
    """Return the (3,) foot of what stands at a (2,) position, m."""
    return np.array([*xy, float(ground.streets.height(xy[None])[0])])
