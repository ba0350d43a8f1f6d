"""Static world of a scenario as one mesh."""

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from sim.mesh.solids import join, to_mesh
from sim.roads.networks import resolve_polygons
from sim.roads.polygons import has_buildings
from sim.roads.tools import sumo_tools
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.world.beside.build import Site, beside, density_of
from sim.world.buildings.footprints import outlined
from sim.world.buildings.houses import Buildings, blocks, city_mesh, guard_rails
from sim.world.encounter_site import encounter_site
from sim.world.furniture.kerbside import furniture
from sim.world.furniture.map_objects import MapObjects, read_map_objects
from sim.world.ground import streets_of
from sim.world.highway import highway_world
from sim.world.roads.markings import markings
from sim.world.roads.streets import Streets
from sim.world.roads.surfaces import surfaces


def build_world(scenario: Scenario, seed: int) -> trimesh.Trimesh:
    """Build the static world in the coordinates of the SUMO network.

    Args:
        scenario: names the network, the city mesh or the polygons, and the area.
        seed: root seed of generated houses, heights and trees; roads and mapped buildings do not depend on it.

    Returns:
        A mesh whose `face_attributes["material"]` is (F,) uint8 indices into `sim.mesh.materials.MATERIALS`.

    Raises:
        ScenarioError: the network, the city mesh or the polygons are missing or cannot be read.
    """
    streets = streets_of(scenario, seed)
    if scenario.network.highway_env:
        return highway_world(scenario, seed, streets)
    units = np.array([unit.xyz_m for unit in scenario.agents.roadside], np.float64).reshape(-1, 3)
    site = encounter_site(scenario, seed, streets)
    town = _town(scenario, streets, units, seed, site.footprint | site.clear)
    rng = random_generator(seed, Stream.FURNITURE)
    polygons = resolve_polygons(scenario)
    map_objects = MapObjects() if polygons is None else read_map_objects(polygons)
    houses = town.footprint | site.footprint
    if scenario.uneven:
        things = beside(Site(streets, houses, town.parts, site.clear, units, map_objects), seed, density_of(scenario))
    else:
        things = furniture(
            streets,
            houses,
            units,
            rng,
            clear=site.clear,
            map_objects=map_objects,
            front_gardens=scenario.network.front_gardens,
        )
    solid = [*town.parts, *site.parts, guard_rails(streets)]
    return to_mesh(join([*surfaces(streets), *markings(streets), *solid, *things]))


def _town(
    scenario: Scenario, streets: Streets, units: NDArray[np.float64], seed: int, clear: shapely.Geometry
) -> Buildings:
    """Return the buildings: the scenario's city mesh or polygons, or seeded blocks when it has neither."""
    if scenario.network.city_mesh:
        return city_mesh(sumo_tools() / scenario.network.city_mesh, streets)
    path = resolve_polygons(scenario)
    if path is not None and has_buildings(path):
        return outlined(path, streets, random_generator(seed, Stream.BUILDING_FOOTPRINTS))
    return blocks(streets, units, random_generator(seed, Stream.BUILDING_BLOCKS), clear)
