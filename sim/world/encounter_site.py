"""The site of an encounter: the solid things that a conflict brings, and where nothing else may stand."""

from dataclasses import dataclass

import numpy as np
import shapely

from sim.encounters.types import Structure
from sim.mesh.solids import Piece, slab
from sim.scenario import Scenario
from sim.world.buildings.facades import WALLS
from sim.world.buildings.houses import walled
from sim.world.roads.streets import Streets

_SITE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """What a conflict puts into the world.

    Attributes:
        pieces: triangles of its structures.
        footprint: polygon of all of them.
        clear: no houses, lamps or trees are made up here.
    """

    pieces: tuple[Piece, ...]
    footprint: shapely.Geometry
    clear: shapely.Geometry


def conflict_site(scenario: Scenario, seed: int, streets: Streets) -> Site:
    """Return the site of a scenario's conflict; an empty one without a conflict.

    Raises:
        ScenarioError: the conflict cannot be laid out.
    """
    if scenario.conflict is None:
        return Site((), shapely.Polygon(), shapely.Polygon())
    from sim.encounters import instance_of

    layout = instance_of(scenario, seed).layout
    rng = np.random.default_rng([seed, _SITE])
    pieces: list[Piece] = []
    for structure in layout.structures:
        pieces += _solid(structure, streets, WALLS[int(rng.integers(len(WALLS)))])
    footprint = shapely.union_all([structure.outline for structure in layout.structures])
    return Site(tuple(pieces), footprint, layout.clear)


def _solid(structure: Structure, streets: Streets, wall: str) -> list[Piece]:
    if structure.kind == "building":
        return walled(structure.outline, streets, structure.height_m, wall)
    material = {"hedge": "hedge", "wall": "brick"}[structure.kind]
    return [
        slab(streets.terrain.follow(structure.outline), streets.height, structure.height_m, material, material, 0.3)
    ]
