"""Buildings: a real city mesh, or seeded houses along the streets of a town."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.geometry import Array
from sim.mesh.meshfiles import read_3ds
from sim.mesh.solids import MeshPart, join, mesh_part, slab
from sim.roads.polygons import STOREY_M
from sim.world.buildings.facades import WALLS, colours, wall_rectangles, windows
from sim.world.roads.markings import cut_line, offset
from sim.world.roads.streets import Lane, Streets
from sim.world.roads.surfaces import TOWN_SPEED_MPS

CLEARANCE_M = 4.5
"""Clearance above lanes, m."""

_PAVED_BELOW_M = 0.02
"""Depth of the mesh's yards and car parks below the road, m, to avoid coplanar surfaces."""

_UNIT_CLEAR_M = 8.0
_NO_HOUSE_M = 60.0
"""Distance of generated houses from motorways, m."""


@dataclass(frozen=True, slots=True)
class MeshPlacement:
    """Placement of a city mesh (y up): counter-clockwise rotation about the vertical, then translation."""

    x_m: float
    y_m: float
    yaw_deg: float
    materials: tuple[tuple[str, str], ...]


# Placement as in tools/game/bs3d/view_B.xml of SUMO; its numbered materials were identified by areas, heights and
# slopes. Its roads are narrower than SUMO's lanes, so ours lie above them.
PLACEMENTS = {
    "bs3.3ds": MeshPlacement(
        660.0, 679.0, 1.30,
        (
            ("Material - 19", "brick"), ("Material - 20", "roof"), ("Material - 15", "kerb"),
            ("Material - 17", "hedge"), ("Material - 18", "hedge"), ("Material - 11", "concrete"),
            ("Material - 0", "asphalt"), ("Material - 14", "pavement"),
        ),
    )
}  # fmt: skip
"""City meshes by file name; others keep their origin, with plaster on every face."""


@dataclass(frozen=True, slots=True, eq=False)
class Buildings:
    """Buildings and their footprint.

    Attributes:
        pieces: their triangles.
        footprint: polygon of all of them.
    """

    parts: tuple[MeshPart, ...]
    footprint: shapely.Geometry


def city_mesh(path: Path, streets: Streets) -> Buildings:
    """Return the buildings, hedges and kerbs of a mesh within the window and off the lanes.

    Raises:
        ScenarioError: the file is not a readable mesh.
    """
    triangles, material = _placed(path)
    low_x, low_y, high_x, high_y = streets.window
    x, y = triangles[:, :, 0], triangles[:, :, 1]
    near = (x.min(1) < high_x) & (x.max(1) > low_x) & (y.min(1) < high_y) & (y.max(1) > low_y)
    triangles, material = triangles[near], material[near]
    footprints = _footprints(triangles)
    shapely.prepare(streets.road)
    # Roofs over the street stay, walls across it are removed, since lanes carry traffic. Of the paved surfaces only
    # yards and car parks remain, as the mesh's roads lie under ours.
    paved = np.isin(material, ["asphalt", "pavement"])
    low = triangles[:, :, 2].min(axis=1) < CLEARANCE_M
    keep = ~(low & shapely.intersects(streets.road, footprints))
    triangles, material, footprints, paved = triangles[keep], material[keep], footprints[keep], paved[keep]
    footprint = shapely.unary_union(footprints[np.isin(material, ["roof", "brick", "concrete"])])
    centers = triangles[:, :, :2].mean(axis=1)
    rise = streets.height(centers) - _PAVED_BELOW_M * paved
    triangles = triangles + rise[:, None, None] * np.array([0.0, 0.0, 1.0])
    walls = material == "brick"
    panes = windows(*wall_rectangles(triangles[walls], footprint))
    material[walls] = colours(centers[walls], footprint)
    parts = [panes]
    for name in sorted(set(material)):
        chosen = triangles[material == name]
        parts.append(mesh_part(chosen, np.arange(3 * len(chosen)), name))
    return Buildings(tuple(parts), footprint)


@lru_cache(maxsize=1)
def _placed(path: Path) -> tuple[Array, NDArray[np.str_]]:
    """Return the used triangles of a mesh file, (F, 3, 3) in the world, and their (F,) materials."""
    file = read_3ds(path)
    placement = PLACEMENTS.get(path.name)
    if placement is None:
        name_of = dict.fromkeys(map(str, set(file.group)), "plaster")
        placement = MeshPlacement(0.0, 0.0, 0.0, tuple(name_of.items()))
    yaw = np.radians(placement.yaw_deg)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = file.vertices[:, 0], -file.vertices[:, 2], file.vertices[:, 1]
    world = np.column_stack([c * x - s * y + placement.x_m, s * x + c * y + placement.y_m, z])
    triangles = world[file.faces]
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    ours = dict(placement.materials)
    used = np.isin(file.group, list(ours)) & (area > 1e-6)
    return triangles[used], np.array([ours[str(group)] for group in file.group[used]], dtype="U16")


def _footprints(triangles: Array) -> NDArray[np.object_]:
    """Return (F,) footprints of triangles seen from above; thin polygons for upright walls."""
    flat = triangles[:, :, :2]
    hull = shapely.convex_hull(shapely.multipoints([shapely.points(row) for row in flat]))
    return shapely.buffer(hull, 0.02, quad_segs=1)


def blocks(
    streets: Streets, units: Array, rng: np.random.Generator, clear: shapely.Geometry | None = None
) -> Buildings:
    """Return seeded houses along the streets of a town, off lanes, footways and junctions.

    Args:
        units: (U, 3) roadside sensors, whose surroundings stay clear.
        rng: generator of positions, sizes and walls.
    """
    fast = [shapely.LineString(lane.line) for lane in streets.lanes if lane.speed > TOWN_SPEED_MPS]
    near_fast = shapely.unary_union(fast).buffer(_NO_HOUSE_M)
    blocked = (streets.road | streets.walk | streets.rail).buffer(2.0) | near_fast
    blocked |= shapely.unary_union(shapely.points(units[:, :2]).reshape(-1)).buffer(_UNIT_CLEAR_M)
    blocked = blocked if clear is None else blocked | clear
    shapely.prepare(blocked)
    taken: list[shapely.Polygon] = []
    parts: list[MeshPart] = []
    for front in _fronts(streets):
        length = shapely.LineString(front).length
        at = float(rng.uniform(4.0, 10.0))
        while at + 9.0 < length:
            width, depth = float(rng.uniform(9.0, 26.0)), float(rng.uniform(9.0, 14.0))
            storeys, wall = int(rng.integers(2, 6)), WALLS[int(rng.integers(len(WALLS)))]
            setback, gap = float(rng.uniform(0.5, 5.0)), float(rng.choice([0.0, 0.0, 4.0, 12.0]))
            house = _rectangle(front, at, min(width, length - at), setback, depth)
            at += width + gap
            if house.intersects(blocked) or not shapely.box(*streets.window).contains(house):
                continue
            tree = shapely.STRtree(taken)
            if any((taken[row] & house).area > 0.5 for row in tree.query(house)):
                continue
            taken.append(house)
            parts += walled(house, streets, STOREY_M * storeys + 0.8, wall)
    return Buildings(tuple(parts), shapely.unary_union(taken))


def walled(house: shapely.Polygon, streets: Streets, height_m: float, wall: str) -> list[MeshPart]:
    """Return walls, a flat roof and windows over a footprint."""
    corners = np.asarray(shapely.geometry.polygon.orient(house).exterior.coords)
    ends = np.stack([corners[:-1], corners[1:]], axis=1)
    foot = streets.height(corners[:-1])
    return [
        slab(house, streets.height, height_m, wall, "roof", 0.6),
        windows(ends, foot, foot + height_m),
    ]


def _fronts(streets: Streets) -> list[Array]:
    """Return the front lines of houses, each with its street on the right."""
    fronts = []
    for lane in streets.lanes:
        if lane.kind != "road" or lane.internal or not 8.0 <= lane.speed <= TOWN_SPEED_MPS:
            continue
        reach = 0.5 * lane.width + 5.0
        if lane.index == 0:
            fronts.append(_with_street_right(lane, lane.kerb_side, reach + lane.verge))
        if lane.index == lane.count - 1 and not lane.opposite:
            fronts.append(_with_street_right(lane, -lane.kerb_side, reach))
    return fronts


def _with_street_right(lane: Lane, side: float, reach_m: float) -> Array:
    line = offset(lane.line, side * reach_m)
    return line if side > 0 else line[::-1]


def _rectangle(front: Array, start_m: float, width_m: float, setback_m: float, depth_m: float) -> shapely.Polygon:
    """Return a house footprint left of a front line, its street side along the chord of `width_m`."""
    cut = cut_line(front, start_m, start_m + width_m)
    way = cut[-1] - cut[0]
    way /= max(float(np.hypot(*way)), 1e-9)
    side = np.array([-way[1], way[0]])
    near, far = cut[[0, -1]] + setback_m * side, cut[[0, -1]] + (setback_m + depth_m) * side
    return shapely.Polygon([*near, *far[::-1]])


def guard_rails(streets: Streets) -> MeshPart:
    """Return the guard rails along roads that are too fast for kerbs."""
    fast = [lane for lane in streets.lanes if lane.kind == "road" and lane.speed > TOWN_SPEED_MPS]
    if not fast:
        return join([])
    reach = shapely.unary_union([shapely.LineString(lane.line).buffer(0.5 * lane.width + 1.5) for lane in fast])
    ring = streets.road.buffer(1.1) - streets.road.buffer(1.0)
    bars = streets.terrain.follow((ring & reach & shapely.box(*streets.window)).simplify(0.03))
    return slab(bars, streets.height, 0.75, "metal", "metal", -0.45, streets.terrain.upper(bars))
