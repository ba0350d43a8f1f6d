"""Buildings from outlines: the polygons that SUMO's polyconvert takes from OpenStreetMap, pulled up to solids."""

from pathlib import Path

import numpy as np
import shapely

from sim.mesh.solids import Piece, rings_of
from sim.roads.polygons import read_outlines
from sim.world.buildings.facades import WALLS
from sim.world.buildings.houses import Town, walled
from sim.world.roads.streets import Streets

_LOWEST_M, _HIGHEST_M = 9.0, 18.0
"""Heights of buildings that the file does not tell."""

_FROM_LANE_M = 0.5
_NARROW_M = 1.0
"""What is left of a building beside a lane and is narrower than this is dropped."""


def outlined(path: Path, streets: Streets, rng: np.random.Generator) -> Town:
    """Return the buildings of a .poly.xml file within the window; they end where lanes and footways lead through.

    Args:
        path: the file.
        streets: lanes and polygons.
        rng: chooses walls, and heights that the file does not tell.

    Raises:
        ScenarioError: the file is missing, not of this kind or holds no building.
    """
    frame = shapely.box(*streets.window)
    taken = (streets.road | streets.walk | streets.rail).buffer(_FROM_LANE_M)
    houses: list[shapely.Polygon] = []
    pieces: list[Piece] = []
    for outline in read_outlines(path):
        # Drawn for every building of the file, so that none changes when another leaves the window.
        guess, wall = float(rng.uniform(_LOWEST_M, _HIGHEST_M)), WALLS[int(rng.integers(len(WALLS)))]
        if not outline.shape.intersects(frame):
            continue
        parts = rings_of(_without_slivers((outline.shape & frame) - taken))
        for part in parts:
            pieces += walled(part, streets, guess if outline.height_m is None else outline.height_m, wall)
        houses += parts
        taken |= shapely.unary_union(parts)
    return Town(tuple(pieces), shapely.unary_union(houses))


def _without_slivers(shape: shapely.Geometry) -> shapely.Geometry:
    half = 0.5 * _NARROW_M
    core = shape.buffer(-half, join_style="mitre")
    return (core.buffer(half, join_style="mitre") & shape).simplify(0.02).buffer(0)
