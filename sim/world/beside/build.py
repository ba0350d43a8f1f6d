"""What stands beside the road in worlds of version 2: placed by rules from the map, and a seed.

Each purpose draws from a stream of its own, so that more of one thing moves no other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import shapely
from shapely.ops import substring

from sim.geometry import Array
from sim.mesh.solids import MeshPart, move
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.world.beside import posts
from sim.world.beside.edges import Edge, Places, edges_of, scatter, yielding
from sim.world.beside.facades import relief
from sim.world.beside.fences import HEIGHT_M, THICK_M, fence
from sim.world.beside.ground import Ground
from sim.world.beside.plants import HEDGE_TIPS_M, grass, hedge, shrub
from sim.world.beside.trees import SPECIES, Tree, pruned, tree
from sim.world.furniture.barriers import barrier
from sim.world.furniture.kerbside import fixtures
from sim.world.furniture.map_objects import MapObjects
from sim.world.roads.markings import offset
from sim.world.roads.streets import Streets

_FROM_CORNER_M = 6.0
_AROUND_CORNER_M = 12.0
_SIGHT_M, _LOW_M = 12.0, (0.6, 0.85)
"""Near where drivers yield, and at the kerb near crossings, boundaries are low, m: sight fields are free above 0.8 m
(RASt 06, 6.3.9.3)."""

_FRONT_M, _FRONT_REACH_M, _LEAST_FRONT_M = 1.05, 30.0, 1.5
"""Distance of the middle of a boundary from the paved ground, that of the farthest street and shortest front, m."""

_BEHIND_BAY_M, _TALL_M = (0.15, 0.8), (1.5, 3.0)
"""Free ground between parking bays and what is planted or built right behind them, and how high that is, m."""
_PLANTED_BAYS, _TREE_EVERY_M, _OVER_BAY_M = 0.75, (5.0, 10.0), (1.5, 2.7)
"""Share of the bays with a row of trees behind them, distance between these, m, and height where their crowns begin, m.

Cities plant a tree for every two to four bays; young ones are not pruned over them."""

_OVER_ROAD_M, _OVER_WALK_M = 4.8, 2.6
_VARIANTS = 4
_TRUNK_M = 0.35
_SHRUB_VARIANTS = 8
_WIDTH_M = {"hedge": (0.6, 1.0), "shrubs": (0.9, 1.4)}

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
    nursery = _Nursery(rng("species"))
    things += _behind_bays(rng("bays"), edges, density, nursery, ground)
    things += _boundaries(rng("boundaries"), edges, density, ground) + _kerbs(rng("kerbs"), edges, density, ground)
    things += _map_trees(rng("map trees"), site.map_objects, edges, nursery, ground)
    if "tree" not in site.map_objects.points:
        things += _rows(rng("rows"), edges, density, nursery, ground) + _trees(
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


def _boundaries(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    """Return hedges, rows of shrubs, fences and walls along the plots, around the corners of streets too."""
    shapes, sight = _shrub_shapes(rng), yielding(ground.streets)
    shapely.prepare(sight)
    parts: list[MeshPart] = []
    for piece, edge in _fronts(rng, edges, ground):
        kind = _drawn(rng, edge.density.boundary, density)
        if kind is not None:
            parts += _boundary(rng, kind, piece, sight, shapes, ground)
    return parts


def _fronts(rng: np.random.Generator, edges: list[Edge], ground: Ground) -> list[tuple[shapely.LineString, Edge]]:
    """Return the fronts of plots and the edges that they lie at: around all paved ground, off it along fast roads."""
    found: list[tuple[shapely.LineString, Edge]] = []
    for edge in edges:
        if edge.fast:
            line = edge.beside(edge.plot_m + _FRONT_M, _AROUND_CORNER_M)
            found += [(piece, edge) for piece in _plots(rng, line)]
    if not edges:
        return found
    paved = shapely.union_all([ground.road, ground.walk]) & ground.fine
    around = paved.buffer(_FRONT_M, quad_segs=2).simplify(0.1).boundary & ground.fine.buffer(-_FRONT_M - 0.1)
    around -= _street_ends(ground.streets)
    lines = shapely.get_parts(shapely.line_merge(around))
    pieces = [piece for line in lines for piece in _plots(rng, line)]
    near = shapely.STRtree([edge.line for edge in edges])
    for piece in pieces:
        row = near.query_nearest(piece.centroid, max_distance=_FRONT_REACH_M, all_matches=False)
        if len(row) and not edges[row[0]].fast:
            found.append((piece, edges[row[0]]))
    return found


def _street_ends(streets: Streets) -> shapely.Geometry:
    """Return the ground ahead of the ends of lanes: the end of a lane in the network is not that of its street."""
    ahead = []
    for lane in streets.lanes:
        for end, before in ((lane.line[0], lane.line[1]), (lane.line[-1], lane.line[-2])):
            way = (end - before) / max(float(np.hypot(*(end - before))), 1e-9)
            ahead.append(shapely.LineString([end, end + 3.0 * _FRONT_M * way]).buffer(0.5 * lane.width + _FRONT_M))
    return shapely.union_all(ahead)


def _kerbs(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    """Return low hedges, shrubs and railings between the kerb and the pavement."""
    shapes = _shrub_shapes(rng)
    crossed = [shapely.LineString(lane.line) for lane in ground.streets.lanes if lane.kind == "crossing"]
    sight = shapely.union_all([yielding(ground.streets), *crossed])
    shapely.prepare(sight)
    parts: list[MeshPart] = []
    for edge in edges:
        for piece in _plots(rng, edge.line):
            kind = _drawn(rng, edge.density.kerb, density)
            if kind is not None:
                aside = edge.kerb_m + (-0.35 if kind == "railing" else 0.1)
                kerb = shapely.LineString(offset(np.asarray(piece.coords), edge.side * aside))
                parts += _boundary(rng, kind, kerb, sight, shapes, ground, at_kerb=True)
    return parts


def _behind_bays(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: "_Nursery", ground: Ground
) -> list[MeshPart]:
    """Return hedges, shrubs, walls, fences and trees right behind parking bays: parked cars stand close to tall things.

    Crowns hang over the bays, and not over the carriageway.
    """
    bays = [part for part in shapely.get_parts(ground.streets.bays & ground.frame) if part.area > 1.0]
    if not bays or not edges:
        return []
    shapes, sight = _shrub_shapes(rng), yielding(ground.streets)
    carriageway = ground.road - ground.streets.bays.buffer(0.01)
    for shape in (sight, carriageway):
        shapely.prepare(shape)
    lines = shapely.STRtree([edge.line for edge in edges])
    parts: list[MeshPart] = []
    for bay in bays:
        shares = edges[int(lines.nearest(bay.centroid))].density
        away = float(rng.uniform(*_BEHIND_BAY_M)) + 0.5
        near = ground.road & bay.buffer(2.0 * away)
        behind = bay.buffer(away, join_style="mitre").boundary - near.buffer(away - 0.05, join_style="mitre")
        pieces = shapely.get_parts(shapely.line_merge(behind) if behind.geom_type[0] == "M" else behind)
        if shares.bay and rng.uniform() < density * _PLANTED_BAYS:
            for line in pieces:
                parts += _avenue(rng, line, shares.species, carriageway, nursery, ground)
        for line in pieces:
            for piece in _plots(rng, line):
                kind = _drawn(rng, shares.bay, density)
                if kind is not None:
                    parts += _boundary(rng, kind, piece, sight, shapes, ground, at_kerb=True, height_m=_TALL_M)
    return parts


def _avenue(
    rng: np.random.Generator,
    line: shapely.LineString,
    species: tuple[str, ...],
    carriageway: shapely.Geometry,
    nursery: "_Nursery",
    ground: Ground,
) -> list[MeshPart]:
    """Return a row of young trees along a line, with their crowns above parked cars."""
    every = float(rng.uniform(*_TREE_EVERY_M))
    along = np.arange(float(rng.uniform(0.5, every)), line.length - 0.5, every)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along + rng.uniform(-0.5, 0.5, len(along))))
    parts = []
    for place in xy[ground.is_fine(xy) & ground.free(xy, 0.1, at_kerb=True, tall=True)] if len(xy) else xy:
        whole = nursery.choose(rng, species, True)
        yaw, size, tall = (
            float(rng.uniform(0.0, 2.0 * np.pi)),
            float(rng.uniform(0.5, 0.9)),
            float(rng.uniform(0.5, 1.0)),
        )
        foot, point = float(rng.uniform(*_OVER_BAY_M)), shapely.Point(place)
        if shapely.dwithin(carriageway, point, size * whole.reach_m + 0.3):
            foot = _OVER_ROAD_M
        young = replace(whole, part=move(whole.part, scale=[1.0, 1.0, tall]), foot_m=tall * whole.foot_m)
        grown = pruned(young, foot)
        if not shapely.dwithin(ground.houses, point, size * whole.reach_m + 0.1) and ground.take(place, 0.5):
            parts.append(move(grown.part, _foot(ground, place), yaw, [size, size, 1.0]))
    return parts


def _plots(rng: np.random.Generator, line: shapely.LineString) -> list[shapely.LineString]:
    """Return the fronts of the plots along a line, with gaps for doors and drives between them."""
    found, at = [], 0.0
    while at < line.length - _LEAST_FRONT_M:
        end = min(at + float(rng.uniform(6.0, 18.0)), line.length)
        found.append(substring(line, at, end))
        at = end + float(rng.uniform(0.5, 1.6))
    return found


def _drawn(rng: np.random.Generator, share_of: dict[str, float], density: float) -> str | None:
    """Return a kind by the shares of all, None for the rest."""
    kinds = list(share_of)
    shares = density * np.array([share_of[kind] for kind in kinds])
    bounds = np.cumsum(shares / max(1.0, float(shares.sum())))
    row = int(np.searchsorted(bounds, rng.uniform(), side="right"))
    return kinds[row] if row < len(kinds) else None


def _boundary(
    rng: np.random.Generator,
    kind: str,
    line: shapely.LineString,
    sight: shapely.Geometry,
    shapes: list[MeshPart],
    ground: Ground,
    at_kerb: bool = False,
    height_m: tuple[float, float] | None = None,
) -> list[MeshPart]:
    """Return the boundary of one plot, a low one near `sight`, where drivers look across it.

    Args:
        at_kerb: on a strip of pavement, and as narrow and low as there.
        height_m: range of heights of hedges and shrubs; None for the usual one.
    """
    if kind != "noise" and not ground.is_fine(shapely.get_coordinates(line.centroid))[0]:
        return []
    low = bool(shapely.dwithin(sight, line, _SIGHT_M))
    height = float(rng.uniform(*HEIGHT_M.get(kind, height_m or (1.6, 2.4))))
    if low and kind in ("noise", "boards"):
        return []
    height = min(height, float(rng.uniform(*_LOW_M))) if low else height
    width = float(rng.uniform(*_WIDTH_M[kind])) if kind in _WIDTH_M else THICK_M[kind]
    if at_kerb:
        width = min(width, 0.7)
    if at_kerb and height_m is None:
        height = min(height, float(rng.uniform(0.9, 1.6)))
    half = 0.5 * width + (HEDGE_TIPS_M if kind == "hedge" else 0.0)
    parts: list[MeshPart] = []
    for piece in ground.take_line(line, half, at_kerb=at_kerb, tall=height > 2.2):
        if kind == "hedge":
            parts += hedge(rng, piece, height, width, ground.streets)
        elif kind == "shrubs":
            parts += _shrub_row(rng, piece, height, width, shapes, ground)
        else:
            parts += fence(rng, kind, piece, height, ground.streets)
    return parts


def _shrub_shapes(rng: np.random.Generator, count: int = 20) -> list[MeshPart]:
    """Return shrubs of 1 m in radius and height, to be scaled."""
    return [shrub(rng, count) for _ in range(_SHRUB_VARIANTS)]


def _shrub_row(
    rng: np.random.Generator,
    line: shapely.LineString,
    height: float,
    width: float,
    shapes: list[MeshPart],
    ground: Ground,
) -> list[MeshPart]:
    along = np.arange(0.5 * width, line.length - 0.3, 0.9 * width)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    size = rng.uniform(0.75, 1.0, (len(xy), 2)) * [0.5 * width, height]
    return _planted(rng, xy, size, shapes, ground)


def _planted(
    rng: np.random.Generator, xy: Array, size: Array, shapes: list[MeshPart], ground: Ground
) -> list[MeshPart]:
    """Return shrubs of (N, 2) radii and heights at (N, 2) positions."""
    if not len(xy):
        return []
    z = ground.streets.height(xy)
    return [
        move(
            shapes[int(rng.integers(len(shapes)))],
            [*here, foot],
            float(rng.uniform(0.0, 2.0 * np.pi)),
            [radius, radius, height],
        )
        for here, foot, (radius, height) in zip(xy, z, size, strict=True)
    ]


def _shrubs(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    small, large = _shrub_shapes(rng), _shrub_shapes(rng, 48)
    places = scatter(rng, edges, [density * edge.density.shrubs for edge in edges], 0.9, 6.0, 2.0)
    tall = rng.uniform(size=len(places.xy)) < 0.4
    size = np.where(tall[:, None], [1.35, 3.0], [0.9, 1.6]) * rng.uniform(0.55, 1.0, (len(places.xy), 2))
    free = ground.is_fine(places.xy) & ground.free(places.xy, size[:, 0], tall=True)
    chosen = np.array([row for row in np.flatnonzero(free) if ground.take(places.xy[row], 0.5 * size[row, 0])], int)
    parts = []
    for shapes, rows in ((small, chosen[~tall[chosen]]), (large, chosen[tall[chosen]])):
        parts += _planted(rng, places.xy[rows], size[rows], shapes, ground)
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
                parts.append(move(thing, _foot(ground, places.xy[row]), float(places.yaw[row])))
    return parts


def _foot(ground: Ground, xy: Array) -> Array:
    return np.array([*xy, float(ground.streets.height(xy[None])[0])])


class _Nursery:
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
    rng: np.random.Generator, places: Places, edges: list[Edge], trunk_apart_m: float, nursery: _Nursery, ground: Ground
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
            parts.append(move(grown.part, _foot(ground, places.xy[row]), yaw, [size, size, 1.0]))
    return parts


def _fitting(whole: Tree, xy: Array, ground: Ground) -> Tree | None:
    """Return a tree pruned where its crown hangs over a road or a footway; None where there is no room for it."""
    place = shapely.Point(xy)
    if shapely.dwithin(ground.houses, place, whole.reach_m + 0.1):
        return None
    if shapely.dwithin(ground.road, place, whole.reach_m + 0.3):
        return pruned(whole, _OVER_ROAD_M)
    return pruned(whole, _OVER_WALK_M) if shapely.dwithin(ground.walk, place, whole.reach_m) else whole


def _rows(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: _Nursery, ground: Ground
) -> list[MeshPart]:
    """Return rows of trees behind the pavement."""
    places = scatter(rng, edges, [density * edge.density.row for edge in edges], 0.9, 1.5, 8.0)
    return _plant(rng, places, edges, 1.6, nursery, ground)


def _trees(
    rng: np.random.Generator, edges: list[Edge], density: float, nursery: _Nursery, ground: Ground
) -> list[MeshPart]:
    """Return trees scattered over gardens, verges and woods."""
    places = scatter(rng, edges, [density * edge.density.trees for edge in edges], 2.0, 16.0, 5.0)
    return _plant(rng, places, edges, 1.3, nursery, ground)


def _map_trees(
    rng: np.random.Generator, map_objects: MapObjects, edges: list[Edge], nursery: _Nursery, ground: Ground
) -> list[MeshPart]:
    """Return the trees of a map, in species of its places."""
    xy = map_objects.points.get("tree", np.zeros((0, 2)))
    if not len(xy) or not edges:
        return []
    xy = xy[shapely.contains_xy(ground.frame, *xy.T)]
    lines = shapely.STRtree([edge.line for edge in edges])
    nearest = np.asarray(lines.nearest(shapely.points(xy)), np.int64)
    return _plant(rng, Places(xy, np.zeros(len(xy)), nearest), edges, 0.5, nursery, ground)
