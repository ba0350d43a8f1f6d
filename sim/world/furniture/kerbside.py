"""Roadside furniture: lamp posts, traffic lights, signs and trees."""

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.materials import material_index
from sim.mesh.solids import MeshPart, box, join, mesh_part, move, tube
from sim.world.furniture.barriers import barrier
from sim.world.furniture.map_objects import MapObjects
from sim.world.roads.markings import cut_line, offset
from sim.world.roads.streets import Lane, Streets
from sim.world.roads.surfaces import TOWN_SPEED_MPS

_LAMP_EVERY_M = 32.0
_TREE_EVERY_M = 11.0
_LEAVES_PER_TREE = 110
_UNIT_CLEAR_M = 12.0
_FROM_CORNER_M = 14.0
_BEYOND = ((0.9, False), (1.4, False), (2.0, False))
_ON_PAVEMENT = ((1.0, True), (3.0, True), (4.5, True))
"""Candidate positions of a traffic light: distance from the edge of its approach, m, and whether footways count."""
_CROWN_OVER_ROAD_M = 4.8
_POLES = {"pole": (8.0, 0.12), "bollard": (0.9, 0.08)}
"""Height and radius of posts, m."""


class _Places:
    """Free ground: off lanes, buildings and other objects."""

    def __init__(self, streets: Streets, footprint: shapely.Geometry, units: Array) -> None:
        self.road = streets.road | streets.rail
        if not streets.swept.is_empty:  # worlds of version 1 keep their bytes
            self.road |= streets.swept
        self.walk = streets.walk
        self.footprint = footprint
        self.frame = shapely.box(*streets.window)
        self.units = units
        self.taken: list[Array] = []
        for shape in (self.road, self.walk, self.footprint):
            shapely.prepare(shape)

    def free(
        self,
        xy: Array,
        from_road_m: float,
        from_house_m: float,
        apart_m: float,
        from_unit_m: float,
        *,
        on_walk: bool = False,
    ) -> bool:
        """Occupy a (2,) position; False if it is not free."""
        point = shapely.Point(xy)
        if not self.frame.contains(point) or (not on_walk and shapely.dwithin(self.walk, point, 0.3)):
            return False
        if shapely.dwithin(self.road, point, from_road_m) or shapely.dwithin(self.footprint, point, from_house_m):
            return False
        if len(self.units) and np.hypot(*(self.units[:, :2] - xy).T).min() < from_unit_m:
            return False
        if self.taken and np.hypot(*(np.array(self.taken) - xy).T).min() < apart_m:
            return False
        self.taken.append(xy)
        return True


def furniture(
    streets: Streets,
    footprint: shapely.Geometry,
    units: Array,
    rng: np.random.Generator,
    clear: shapely.Geometry | None = None,
    map_objects: MapObjects | None = None,
    front_gardens: float = 0.0,
) -> list[MeshPart]:
    """Return the furniture beside the road, none of it on or above a lane.

    Args:
        units: (U, 3) roadside sensors, which get a mast and a clear view.
        clear: ground without lamps and trees.
        map_objects: objects of a map; lamps and trees are generated only if it has none.
        front_gardens: share of the street fronts with a hedge or a fence.
    """
    map_objects = map_objects or MapObjects()
    places = _Places(streets, footprint, units)
    things = [*(_mast(unit, streets) for unit in units), *_signals(streets, places)]
    if clear is not None:
        places.footprint |= clear
        shapely.prepare(places.footprint)
    for kind, line, height_m in map_objects.barriers:
        things += barrier(kind, line, height_m, streets)
    things += _of_points(streets, places, map_objects.points, rng)
    if "lamp" not in map_objects.points:
        things += _lamps(streets, places)
    if front_gardens > 0:
        things += _gardens(streets, places, front_gardens, rng)
    return things if "tree" in map_objects.points else [*things, *_trees(streets, places, rng)]


def fixtures(
    streets: Streets, houses: shapely.Geometry, clear: shapely.Geometry, units: Array, points: dict[str, Array]
) -> tuple[list[MeshPart], list[Array]]:
    """Return masts of roadside sensors, traffic lights, a map's posts, lamps, and the (2,) positions of all but masts.

    Args:
        clear: ground without lamps.
        points: of a map, see `MapObjects`.
    """
    places = _Places(streets, houses, units)
    things = [*(_mast(unit, streets) for unit in units), *_signals(streets, places)]
    places.footprint = houses | clear
    shapely.prepare(places.footprint)
    things += _map_posts(streets, places, points)
    return things if "lamp" in points else [*things, *_lamps(streets, places)], places.taken


def _map_posts(streets: Streets, places: _Places, points: dict[str, Array]) -> list[MeshPart]:
    """Return the lamps, poles and bollards of a map, off lanes and houses."""
    parts = []
    for xy in points.get("lamp", np.zeros((0, 2))):
        near = shapely.get_coordinates(shapely.shortest_line(shapely.Point(xy), places.road))
        if len(near) and places.free(xy, 0.3, 0.2, 0.5, 2.0, on_walk=True):
            yaw = float(np.arctan2(*(near[1] - near[0])[::-1]))
            parts.append(move(lamp_post(), base(streets, xy), yaw))
    for kind, (height_m, radius_m) in _POLES.items():
        for xy in points.get(kind, np.zeros((0, 2))):
            if places.free(xy, 0.3, 0.1, 0.3, 1.0, on_walk=True):
                foot = base(streets, xy)
                top = [foot[0], foot[1], foot[2] + height_m]
                parts.append(tube(foot, top, (radius_m, radius_m), "metal", 8))
    return parts


def _of_points(streets: Streets, places: _Places, points: dict[str, Array], rng: np.random.Generator) -> list[MeshPart]:
    """Return the lamps, poles, bollards and trees of a map, off lanes and houses."""
    parts = _map_posts(streets, places, points)
    for xy in points.get("tree", np.zeros((0, 2))):
        size = rng.uniform(0.8, 1.25)
        shape = tree(rng, size)
        if places.free(xy, 0.5, 0.5, 1.0, 3.0, on_walk=True):
            # Crowns at the kerb are pruned to let lorries pass.
            over = shapely.dwithin(places.road, shapely.Point(xy), 2.1 * size + 0.3)
            leaves = shape.faces[shape.material == material_index("leaves")]
            tall = _CROWN_OVER_ROAD_M / float(shape.vertices[leaves, 2].min()) if over else 1.0
            parts.append(move(shape, base(streets, xy), scale=(1.0, 1.0, max(tall, 1.0))))
    return parts


def _gardens(streets: Streets, places: _Places, share: float, rng: np.random.Generator) -> list[MeshPart]:
    """Return seeded hedges, fences and walls in front of houses, away from sight lines at junctions."""
    parts = []
    for lane, side in street_edges(streets):
        if lane.speed > TOWN_SPEED_MPS:
            continue
        behind = 0.6 if lane.verge > 0 and side == lane.kerb_side else 3.0
        line = offset(lane.line, side * (0.5 * lane.width + lane.verge + behind))
        at = _FROM_CORNER_M
        while at < _length(line) - _FROM_CORNER_M - 5.0:
            length, gap, lot = rng.uniform(7.0, 18.0), rng.uniform(1.5, 5.0), rng.uniform()
            kind = str(rng.choice(["hedge", "fence", "wall"], p=[0.55, 0.3, 0.15]))
            height_m = float(rng.uniform(0.9, 1.9))
            end = min(at + length, _length(line) - _FROM_CORNER_M)
            if lot < share:
                part = shapely.LineString(cut_line(line, at, end)) - places.footprint.buffer(0.6)
                parts += barrier(kind, part, height_m, streets)
            at = end + gap
    return parts


def base(streets: Streets, xy: Array) -> Array:
    """Return (3,) the ground at a (2,) position."""
    return np.array([xy[0], xy[1], float(streets.height(xy[None])[0])])


def _mast(unit: Array, streets: Streets) -> MeshPart:
    foot = base(streets, unit[:2])
    return tube(foot, foot + np.array([0.0, 0.0, max(unit[2] - 0.25, 0.3)]), (0.09, 0.06), "metal", 8)


def _signals(streets: Streets, places: _Places) -> list[MeshPart]:
    """Return a traffic light on the kerb side of each approach that ends at one."""
    parts = []
    for lane in streets.lanes:
        if lane.kind != "road" or lane.internal or lane.stop != "signal" or lane.index != 0 or lane.speed < 8.0:
            continue
        end, way = lane.line[-1], lane.line[-1] - lane.line[-2]
        way = way / max(float(np.hypot(*way)), 1e-9)
        # Beyond the footway, else on its side towards the road.
        for aside, on_walk in (*_BEYOND, (0.4 - lane.verge, True), *_ON_PAVEMENT):
            xy = end + lane.kerb_side * (0.5 * lane.width + lane.verge + aside) * np.array([-way[1], way[0]])
            if places.free(xy, 0.3 if on_walk else 0.6, 0.3 if on_walk else 0.5, 1.0, 1.0, on_walk=on_walk):
                parts.append(move(traffic_light(), base(streets, xy), float(np.arctan2(way[1], way[0]))))
                break
    return parts


def traffic_light() -> MeshPart:
    """Return a traffic light at the origin that faces drivers who come along +x."""
    post = tube([0.0, 0.0, 0.0], [0.0, 0.0, 3.45], (0.07, 0.06), "metal", 8)
    head = box([-0.30, -0.16, 2.45], [-0.08, 0.16, 3.40], "dark_metal")
    lamps = [tube([-0.36, 0.0, z], [-0.30, 0.0, z], (0.11, 0.11), "signal_lamp", 8) for z in (2.62, 2.92, 3.22)]
    return join([post, head, *lamps])


def lamp_post() -> MeshPart:
    """Return a street lamp at the origin with its head towards +x."""
    post = tube([0.0, 0.0, 0.0], [0.0, 0.0, 6.4], (0.09, 0.05), "metal", 8)
    return join([post, box([-0.15, -0.12, 6.4], [0.40, 0.12, 6.52], "dark_metal")])


def sign() -> MeshPart:
    """Return a road sign at the origin that faces drivers who come along +x."""
    post = tube([0.0, 0.0, 0.0], [0.0, 0.0, 2.7], (0.035, 0.035), "metal", 6)
    return join([post, box([-0.06, -0.3, 2.05], [-0.04, 0.3, 2.65], "sign")])


def _lamps(streets: Streets, places: _Places) -> list[MeshPart]:
    """Return lamps, with signs between some of them, along the kerb of each street of a town."""
    parts = []
    for lane, side in street_edges(streets):
        if side != lane.kerb_side or lane.speed > TOWN_SPEED_MPS:
            continue
        line = offset(lane.line, side * (0.5 * lane.width + lane.verge + 0.8))
        for number, at in enumerate(np.arange(8.0, _length(line) - 4.0, 0.5 * _LAMP_EVERY_M)):
            here, ahead = cut_line(line, at, at + 0.5)[[0, -1]]
            if not places.free(here, 0.6, 0.8, 3.0, 6.0):
                continue
            yaw = float(np.arctan2(*(ahead - here)[::-1]))
            if number % 2 == 0:
                parts.append(move(lamp_post(), base(streets, here), yaw + np.pi))
            elif number % 8 == 1:
                parts.append(move(sign(), base(streets, here), yaw))
    return parts


def _trees(streets: Streets, places: _Places, rng: np.random.Generator) -> list[MeshPart]:
    """Return a row of trees along the streets and scattered ones behind it."""
    parts = []
    for lane, side in street_edges(streets):
        for row, chance in ((3.4, 0.55), (9.0, 0.35), (16.0, 0.35)):
            line = offset(lane.line, side * (0.5 * lane.width + lane.verge + row))
            for at in np.arange(5.0, _length(line) - 5.0, _TREE_EVERY_M):
                shake, lot, size = rng.uniform(-1.5, 1.5, 2), rng.uniform(), rng.uniform(0.8, 1.25)
                xy = cut_line(line, at, at + 0.5)[0] + shake
                radius = 2.1 * size
                if lot < chance and places.free(xy, radius + 0.5, radius + 0.4, 2.0 * radius, _UNIT_CLEAR_M):
                    parts.append(move(tree(rng, size), base(streets, xy)))
    return parts


def tree(rng: np.random.Generator, size: float) -> MeshPart:
    """Return a tree of about 7 m times `size` at the origin: a trunk and scattered leaves, with gaps for rays."""
    trunk = tube([0.0, 0.0, -0.1], [0.0, 0.0, 4.6 * size], (0.17 * size, 0.08 * size), "bark", 6)
    direction = rng.normal(size=(_LEAVES_PER_TREE, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    reach = rng.uniform(0.25, 1.0, (_LEAVES_PER_TREE, 1)) ** 0.5
    center = np.array([0.0, 0.0, 4.9]) * size + direction * reach * np.array([1.75, 1.75, 2.1]) * size
    corner = rng.normal(size=(_LEAVES_PER_TREE, 3, 3))
    corner *= 0.55 * size / np.linalg.norm(corner, axis=2, keepdims=True)
    leaves = center[:, None, :] + corner
    flat = np.hypot(leaves[..., 0], leaves[..., 1])
    # No leaf reaches beyond the crown, whose radius decides on the position of a tree.
    leaves[..., :2] *= np.minimum(1.0, 2.1 * size / np.maximum(flat, 1e-9))[..., None]
    return join([trunk, mesh_part(leaves, np.arange(3 * _LEAVES_PER_TREE), "leaves")])


def street_edges(streets: Streets) -> list[tuple[Lane, float]]:
    """Return the outer lanes of all streets and the side of the kerb: -1 right, 1 left."""
    lanes = [lane for lane in streets.lanes if lane.kind == "road" and not lane.internal and lane.speed >= 8.0]
    outer = [(lane, lane.kerb_side) for lane in lanes if lane.index == 0]
    inner = [(lane, -lane.kerb_side) for lane in lanes if lane.index == lane.count - 1 and not lane.opposite]
    return outer + inner


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())
