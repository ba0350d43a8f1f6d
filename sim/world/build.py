"""The static world of a scenario as one mesh."""

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from sim.encounters import network_of
from sim.mesh.solids import join, to_mesh
from sim.roads.networks import read_network, resolve_polygons
from sim.roads.polygons import has_buildings
from sim.roads.tools import sumo_tools
from sim.scenario import Scenario
from sim.traffic.parking import parked_cars
from sim.world.buildings.footprints import outlined
from sim.world.buildings.houses import Town, blocks, city_mesh, guard_rails
from sim.world.encounter_site import conflict_site
from sim.world.furniture.kerbside import furniture
from sim.world.furniture.map_objects import Mapped, read_mapped
from sim.world.roads.markings import markings
from sim.world.roads.streets import Streets, read_streets
from sim.world.roads.surfaces import surfaces

MARGIN_M = 120.0
"""How far beyond `network.area_m` the world is built: the reach of a sensor."""

_BLOCKS, _FURNITURE, _OUTLINES = 1, 2, 3


def build_world(scenario: Scenario, seed: int) -> trimesh.Trimesh:
    """Build everything that does not move, in the coordinates of the SUMO network.

    Args:
        scenario: names the network, the city mesh or the polygons, and the area.
        seed: of houses, heights and trees that no map tells; roads and places of real buildings do not depend on it.

    Returns:
        A mesh whose `face_attributes["material"]` is (F,) uint8 indices into `sim.mesh.materials.MATERIALS`.

    Raises:
        ScenarioError: the network, the city mesh or the polygons are missing or cannot be read.
    """
    if scenario.network.highway_env:
        from sim.world.highway import highway_world

        return highway_world(scenario, seed)
    net = read_network(network_of(scenario, seed))
    bays = parked_cars(scenario, net, seed).bays
    streets = read_streets(net, scenario.network.area_m, MARGIN_M, bays)
    units = np.array([unit.xyz_m for unit in scenario.agents.roadside], np.float64).reshape(-1, 3)
    site = conflict_site(scenario, seed, streets)
    town = _town(scenario, streets, units, seed, site.footprint | site.clear)
    rng = np.random.default_rng([seed, _FURNITURE])
    polygons = resolve_polygons(scenario)
    mapped = Mapped() if polygons is None else read_mapped(polygons)
    things = furniture(
        streets,
        town.footprint | site.footprint,
        units,
        rng,
        clear=site.clear,
        mapped=mapped,
        front_gardens=scenario.network.front_gardens,
    )
    solid = [*town.pieces, *site.pieces, guard_rails(streets)]
    return to_mesh(join([*surfaces(streets), *markings(streets), *solid, *things]))


def _town(scenario: Scenario, streets: Streets, units: NDArray[np.float64], seed: int, clear: shapely.Geometry) -> Town:
    """Return the buildings: the scenario's city mesh or polygons, or seeded blocks when it has neither."""
    if scenario.network.city_mesh:
        return city_mesh(sumo_tools() / scenario.network.city_mesh, streets)
    path = resolve_polygons(scenario)
    if path is not None and has_buildings(path):
        return outlined(path, streets, np.random.default_rng([seed, _OUTLINES]))
    return blocks(streets, units, np.random.default_rng([seed, _BLOCKS]), clear)
