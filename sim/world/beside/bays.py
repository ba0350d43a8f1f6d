"""What stands right behind parking bays, where worlds of version 2 have parked cars."""

from dataclasses import replace

import numpy as np
import shapely

from sim.mesh.solids import MeshPart, move
from sim.world.beside.boundaries import boundary, drawn, plots, shrub_shapes
from sim.world.beside.edges import Edge, yielding
from sim.world.beside.ground import Ground
from sim.world.beside.planting import OVER_ROAD_M, Nursery, foot_at
from sim.world.beside.trees import pruned

_FREE_M, _HALF_M, _TALL_M = (0.15, 0.8), 0.5, (1.5, 3.0)
"""Free ground between bays and what stands behind them, half of its thickness at most, and its height, m."""
_PLANTED, _EVERY_M, _FOOT_M = 0.75, (5.0, 10.0), (1.5, 2.7)
"""Share of the bays with a row of trees behind them, distance between these, m, and height where their crowns begin, m.

Cities plant a tree for every two to four bays; young ones are not pruned over them."""


def behind_bays(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: Nursery, ground: Ground
) -> list[MeshPart]:
    """Return hedges, shrubs, walls, fences and trees right behind parking bays: parked cars stand close to tall things.

    Crowns hang over the bays, and not over the carriageway.
    """
    bays = [part for part in shapely.get_parts(ground.streets.bays & ground.frame) if part.area > 1.0]
    if not bays or not edges:
        return []
    shapes, sight = shrub_shapes(rng), yielding(ground.streets)
    carriageway = ground.road - ground.streets.bays.buffer(0.01)
    for shape in (sight, carriageway):
        shapely.prepare(shape)
    lines = shapely.STRtree([edge.line for edge in edges])
    parts: list[MeshPart] = []
    for bay in bays:
        shares = edges[int(lines.nearest(bay.centroid))].density
        away = float(rng.uniform(*_FREE_M)) + _HALF_M
        near = ground.road & bay.buffer(2.0 * away)
        behind = bay.buffer(away, join_style="mitre").boundary - near.buffer(away - 0.05, join_style="mitre")
        pieces = shapely.get_parts(shapely.line_merge(behind) if behind.geom_type == "MultiLineString" else behind)
        if shares.bay and rng.uniform() < density * _PLANTED:
            for line in pieces:
                parts += _avenue(rng, line, shares.species, carriageway, nursery, ground)
        for line in pieces:
            for piece in plots(rng, line):
                kind = drawn(rng, shares.bay, density)
                if kind is not None:
                    parts += boundary(rng, kind, piece, sight, shapes, ground, at_kerb=True, height_m=_TALL_M)
    return parts


def _avenue(
    rng: np.random.Generator,
    line: shapely.LineString,
    species: tuple[str, ...],
    carriageway: shapely.Geometry,
    nursery: Nursery,
    ground: Ground,
) -> list[MeshPart]:
    """Return a row of young trees along a line, with their crowns above parked cars."""
    every = float(rng.uniform(*_EVERY_M))
    along = np.arange(float(rng.uniform(0.5, every)), line.length - 0.5, every)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along + rng.uniform(-0.5, 0.5, len(along))))
    parts = []
    for place in xy[ground.is_fine(xy) & ground.free(xy, 0.1, at_kerb=True, tall=True)]:
        whole = nursery.choose(rng, species, True)
        yaw, size, tall = (
            float(rng.uniform(0.0, 2.0 * np.pi)),
            float(rng.uniform(0.5, 0.9)),
            float(rng.uniform(0.5, 1.0)),
        )
        foot, point = float(rng.uniform(*_FOOT_M)), shapely.Point(place)
        if shapely.dwithin(carriageway, point, size * whole.reach_m + 0.3):
            foot = OVER_ROAD_M
        young = replace(whole, part=move(whole.part, scale=[1.0, 1.0, tall]), foot_m=tall * whole.foot_m)
        grown = pruned(young, foot)
        if not shapely.dwithin(ground.houses, point, size * whole.reach_m + 0.1) and ground.take(place, 0.5):
            parts.append(move(grown.part, foot_at(ground, place), yaw, [size, size, 1.0]))
    return parts
