"""What stands beside the road in worlds of version 2: placed by rules from the map, and a seed.

Each purpose draws from a stream of its own, so that more of one thing moves no other.
"""

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import MeshPart, move, rings_of
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.world.beside import posts
from sim.world.beside.bays import behind_bays
from sim.world.beside.boundaries import boundaries, kerbs, shrub_shapes, shrubs_at
from sim.world.beside.edges import Edge, edges_of, scatter
from sim.world.beside.facades import relief
from sim.world.beside.fences import HEIGHT_M, THICK_M, fence
from sim.world.beside.ground import Ground
from sim.world.beside.planting import Nursery, foot_at, kerb_rows, mapped, scattered
from sim.world.beside.plants import HEDGE_TIPS_M, grass, hedge
from sim.world.furniture.barriers import barrier
from sim.world.furniture.kerbside import fixtures, traffic_light
from sim.world.furniture.map_objects import MapObjects
from sim.world.roads.streets import Streets

_FROM_CORNER_M = 6.0
_SIGNAL_M = 25.0
"""Farthest stop line whose signal is repeated on an island, m."""
_INSET_M, _RAIL_M2, _SPACE_M = 0.5, 12.0, 0.35
"""Distance of railings and bollards from the edge of an island, area from which it has railings, and room of a post."""

THINGS: dict[str, tuple[Callable[[np.random.Generator], MeshPart], float, bool]] = {
    "sign": (posts.sign, 0.35, True),
    "place_name": (posts.place_name, 1.3, False),
    "delineator": (posts.delineator, 0.15, True),
    "pole": (posts.pole, 0.3, False),
    "bins": (posts.bins, 0.9, False),
    "litter_bin": (posts.litter_bin, 0.25, True),
    "cabinet": (posts.cabinet, 0.6, False),
    "bollard": (posts.bollard, 0.1, True),
    "bench": (posts.bench, 0.8, False),
    "planter": (posts.planter, 0.5, False),
    "bicycles": (posts.bicycles, 0.9, True),
    "bus_stop": (posts.bus_stop, 1.6, False),
}
"""Things by name: how to make one, how far it reaches, m, and whether it stands at the kerb or at the plots."""


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Ground and structures of a world before anything stands beside its roads.

    Attributes:
        streets: lanes and terrain.
        houses: polygon of buildings and structures.
        walls: triangles of the buildings.
        clear: ground that an encounter keeps free.
        units: (U, 3) roadside sensors.
        map_objects: what a map tells of trees, posts and barriers.
    """

    streets: Streets
    houses: shapely.Geometry
    walls: tuple[MeshPart, ...]
    clear: shapely.Geometry
    units: Array
    map_objects: MapObjects


def density_of(scenario: Scenario) -> float:
    """Return the density that a scenario sets, times the usual one."""
    set_to = scenario.network.beside
    return 1.0 if isinstance(set_to, msgspec.UnsetType) else set_to


def beside(site: Site, seed: int, density: float = 1.0) -> list[MeshPart]:
    """Return what stands beside the roads.

    Args:
        seed: root seed.
        density: times the shares and counts of `sim.world.beside.kinds.DENSITIES`; 0 leaves what the map tells, masts,
            traffic lights and lamps.
    """
    streets = site.streets
    things, taken = fixtures(streets, site.houses, site.clear, site.units, site.map_objects.points)
    ground = Ground(streets, site.houses, site.clear, site.units, taken)
    edges = edges_of(streets, site.houses)

    def rng(purpose: str) -> np.random.Generator:
        return random_generator(seed, Stream.BESIDE, purpose)

    things += _map_barriers(rng("map barriers"), site.map_objects, ground)
    nursery = Nursery(rng("species"))
    if density > 0.0:
        things += _on_islands(rng("islands"), ground)
    things += behind_bays(rng("bays"), edges, density, nursery, ground)
    things += boundaries(rng("boundaries"), edges, density, ground) + kerbs(rng("kerbs"), edges, density, ground)
    things += mapped(rng("map trees"), site.map_objects, edges, nursery, ground)
    if "tree" not in site.map_objects.points:
        things += kerb_rows(rng("rows"), edges, density, nursery, ground) + scattered(
            rng("trees"), edges, density, nursery, ground
        )
    things += _things(rng("things"), edges, density, ground)
    things += _shrubs(rng("shrubs"), edges, density, ground) + _grass(rng("grass"), edges, density, ground)
    if density > 0.0:
        things += relief(rng("facades"), list(site.walls), site.houses, ground)
    return things


def _map_barriers(rng: np.random.Generator, map_objects: MapObjects, ground: Ground) -> list[MeshPart]:
    parts: list[MeshPart] = []
    for kind, line, height_m in map_objects.barriers:
        if not line.intersects(ground.frame):
            continue
        if kind == "hedge":
            for piece in ground.take_line(line, 0.4 + HEDGE_TIPS_M):
                parts += hedge(rng, piece, height_m, 0.8, ground.streets)
        elif kind in ("fence", "wall", "railing"):
            like = "picket" if kind == "fence" else kind
            for piece in ground.take_line(line, 0.5 * THICK_M[like]):
                parts += fence(rng, like, piece, height_m, ground.streets)
        else:
            parts += barrier(kind, line, height_m, ground.streets)
    return parts


def _on_islands(rng: np.random.Generator, ground: Ground) -> list[MeshPart]:
    """Return a signal or a sign in the middle of each island, railings or bollards along its edge on large ones."""
    streets, parts = ground.streets, []
    stops = [lane for lane in streets.lanes if lane.stop == "signal" and lane.kind == "road"]
    ends = shapely.STRtree([shapely.Point(lane.line[-1]) for lane in stops])
    for island in rings_of(streets.islands & ground.fine):
        place = np.array(shapely.maximum_inscribed_circle(island).coords[0])
        near = ends.query_nearest(shapely.Point(place), max_distance=_SIGNAL_M, all_matches=False)
        if ground.free(place[None], 0.1, at_kerb=True)[0] and ground.take(place, _SPACE_M):
            if len(near):
                way, make = np.diff(stops[int(near[0])].line[-2:], axis=0)[0], traffic_light()
            else:
                towards = shapely.get_coordinates(shapely.shortest_line(island.centroid, island.boundary))
                way, make = towards[0] - towards[-1], posts.sign(rng)
            parts.append(move(make, foot_at(ground, place), float(np.arctan2(way[1], way[0]))))
        inner = island.buffer(-_INSET_M).boundary
        if island.area >= _RAIL_M2:
            for piece in ground.take_line(inner, 0.5 * THICK_M["railing"], at_kerb=True):
                parts += fence(rng, "railing", piece, float(rng.uniform(*HEIGHT_M["railing"])), streets)
            continue
        for xy in shapely.get_coordinates(shapely.segmentize(inner, 1.5))[::2]:
            if ground.free(xy[None], 0.1, at_kerb=True)[0] and ground.take(xy, _SPACE_M):
                parts.append(move(posts.bollard(rng), foot_at(ground, xy)))
    return parts


def _shrubs(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    small, large = shrub_shapes(rng), shrub_shapes(rng, 48)
    places = scatter(rng, edges, [density * edge.density.shrubs for edge in edges], 0.9, 6.0, 2.0)
    tall = rng.uniform(size=len(places.xy)) < 0.4
    size = np.where(tall[:, None], [1.35, 3.0], [0.9, 1.6]) * rng.uniform(0.55, 1.0, (len(places.xy), 2))
    free = ground.is_fine(places.xy) & ground.free(places.xy, size[:, 0], tall=True)
    chosen = np.array([row for row in np.flatnonzero(free) if ground.take(places.xy[row], 0.5 * size[row, 0])], int)
    parts = []
    for shapes, rows in ((small, chosen[~tall[chosen]]), (large, chosen[tall[chosen]])):
        parts += shrubs_at(rng, places.xy[rows], size[rows], shapes, ground)
    return parts


def _grass(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    places = scatter(rng, edges, [density * edge.density.grass for edge in edges], 0.0, 5.0, 2.0)
    xy = places.xy[ground.is_fine(places.xy) & ground.free(places.xy, 0.45)]
    return [grass(rng, xy, ground.streets.height)]


def _things(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    parts = []
    for name, (make, reach, at_kerb) in THINGS.items():
        counts = [density * edge.density.things.get(name, 0.0) for edge in edges]
        low, high = (-1.0, -1.0) if at_kerb else (reach + 0.2, reach + 0.8)
        places = scatter(rng, edges, counts, low, high, _FROM_CORNER_M)
        free = ground.is_fine(places.xy) & ground.free(places.xy, reach, at_kerb=at_kerb, tall=reach > 1.0)
        for row in np.flatnonzero(free):
            thing = make(rng)
            if ground.take(places.xy[row], reach):
                parts.append(move(thing, foot_at(ground, places.xy[row]), float(places.yaw[row])))
    return parts
