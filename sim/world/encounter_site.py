"""Site of an encounter: its structures, and the ground kept clear of generated objects."""

from dataclasses import dataclass

import shapely

from sim.encounters.types import Structure
from sim.mesh.solids import MeshPart, slab
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.world.buildings.facades import WALLS
from sim.world.buildings.houses import walled
from sim.world.roads.streets import Streets


@dataclass(frozen=True, slots=True, eq=False)
class EncounterSite:
    """Structures of an encounter.

    Attributes:
        pieces: triangles of its structures.
        footprint: polygon of all of them.
        clear: ground without generated houses, lamps or trees.
    """

    parts: tuple[MeshPart, ...]
    footprint: shapely.Geometry
    clear: shapely.Geometry


def encounter_site(scenario: Scenario, seed: int, streets: Streets) -> EncounterSite:
    """Return the site of a scenario's encounter; empty without an encounter.

    Raises:
        ScenarioError: the encounter is invalid.
    """
    if scenario.conflict is None:
        return EncounterSite((), shapely.Polygon(), shapely.Polygon())
    from sim.encounters import encounter_of

    layout = encounter_of(scenario, seed).layout
    rng = random_generator(seed, Stream.ENCOUNTER_SITE)
    parts: list[MeshPart] = []
    for structure in layout.structures:
        parts += _solid(structure, streets, WALLS[int(rng.integers(len(WALLS)))])
    footprint = shapely.union_all([structure.outline for structure in layout.structures])
    return EncounterSite(tuple(parts), footprint, layout.clear)


def _solid(structure: Structure, streets: Streets, wall: str) -> list[MeshPart]:
    if structure.kind == "building":
        return walled(structure.outline, streets, structure.height_m, wall)
    material = {"hedge": "hedge", "wall": "brick"}[structure.kind]
    return [
        slab(streets.terrain.follow(structure.outline), streets.height, structure.height_m, material, material, 0.3)
    ]
