"""Buildings extruded from footprints of .poly.xml files."""

from pathlib import Path

import numpy as np
import shapely

from sim.mesh.solids import MeshPart, rings_of
from sim.roads.polygons import read_outlines
from sim.world.buildings.facades import WALLS
from sim.world.buildings.houses import Buildings, walled
from sim.world.roads.streets import Streets

_LOWEST_M, _HIGHEST_M = 9.0, 18.0
"""Range of heights for buildings without one in the file, m."""

_FROM_LANE_M = 0.5
_NARROW_M = 1.0
"""Smallest width of a building clipped beside a lane, m; slivers are dropped."""


def outlined(path: Path, streets: Streets, rng: np.random.Generator) -> Buildings:
    """Return the buildings of a .poly.xml file within the window, clipped at lanes and footways.

    Args:
        rng: generator of walls, and of heights that the file lacks.

    Raises:
        ScenarioError: the file is missing, of another format or without buildings.
    """
    frame = shapely.box(*streets.window)
    taken = (streets.road | streets.walk | streets.rail).buffer(_FROM_LANE_M)
    houses: list[shapely.Polygon] = []
    parts: list[MeshPart] = []
    for outline in read_outlines(path):
        # Drawn for every building of the file, so that none depends on the window.
        guess, wall = float(rng.uniform(_LOWEST_M, _HIGHEST_M)), WALLS[int(rng.integers(len(WALLS)))]
        if not outline.shape.intersects(frame):
            continue
        polygons = rings_of(_without_slivers((outline.shape & frame) - taken))
        for polygon in polygons:
            parts += walled(polygon, streets, guess if outline.height_m is None else outline.height_m, wall)
        houses += polygons
        taken |= shapely.unary_union(polygons)
    return Buildings(tuple(parts), shapely.unary_union(houses))


def _without_slivers(shape: shapely.Geometry) -> shapely.Geometry:
    half = 0.5 * _NARROW_M
    core = shape.buffer(-half, join_style="mitre")
    return (core.buffer(half, join_style="mitre") & shape).simplify(0.02).buffer(0)
