"""Road surfaces: carriageway, pavement, kerb, track and surrounding ground."""

import shapely

from sim.mesh.solids import MeshPart, carpet, mesh_part, rings_of, slab
from sim.world.roads.kerbs import RAMP_STEP_M
from sim.world.roads.streets import Streets

GROUND_BELOW_M = 0.05
"""Depth of the ground below the road, m."""

TOWN_SPEED_MPS = 21.0
"""Highest speed limit of roads with kerbs and pavements, m/s; faster ones have guard rails."""

_PAVEMENT_WIDTH_M = 2.5
_KERB_WIDTH_M = 0.15
_KERB_HEIGHT_M = 0.10
_GAUGE_M = 1.435
_GRID_M = 1e-6


def surfaces(streets: Streets) -> list[MeshPart]:
    """Return carriageways, pavements with kerbs, tracks and the ground."""
    height, cut = streets.terrain.height, streets.terrain.cut
    walk = pavement(streets)
    if streets.land is None:
        beside, footway = height, walk
        kerbs = slab(streets.terrain.follow(_kerbs(streets)), height, _KERB_HEIGHT_M, "kerb", "kerb", GROUND_BELOW_M)
    else:
        beside, footway = streets.land.height, walk - streets.kerbs
        sides = shapely.segmentize(streets.kerbs, RAMP_STEP_M)
        kerbs = slab(sides, beside, 0.0, "kerb", "kerb", GROUND_BELOW_M, cut(streets.kerbs), height)
    return [
        carpet(cut(streets.road), height, 0.0, "asphalt"),
        carpet(cut(footway), beside, 0.0, "pavement"),
        carpet(cut(streets.rail - walk), beside, -0.01, "gravel"),
        kerbs,
        *_tracks(streets),
        *ground(streets, walk),
    ]


def pavement(streets: Streets) -> shapely.Geometry:
    """Return the polygon of footways, of a strip along the carriageways of a town, of islands and of swept corners."""
    strips = [
        shapely.LineString(lane.line).buffer(-0.5 * lane.width - _PAVEMENT_WIDTH_M, single_sided=True)
        for lane in streets.lanes
        if lane.kind == "road" and not lane.internal and lane.index == 0 and _in_town(lane.speed)
    ]
    strips.append(streets.bays.buffer(_PAVEMENT_WIDTH_M, join_style="mitre"))
    around = shapely.unary_union(strips).buffer(0.2).buffer(-0.2) & shapely.box(*streets.window)
    for more in (streets.islands, streets.swept):
        if not more.is_empty:  # worlds of version 1 keep their bytes
            around |= more
    return ((around | streets.walk) - streets.road - streets.rail).simplify(0.05).buffer(0)


def _in_town(speed: float) -> bool:
    # A footpath has a walking pace and a service road none of its own pavement.
    return 8.5 <= speed <= TOWN_SPEED_MPS


def _kerbs(streets: Streets) -> shapely.Geometry:
    """Return the kerbs along the carriageways of a town, with gaps at crossings."""
    town = [lane for lane in streets.lanes if lane.kind == "road" and _in_town(lane.speed)]
    reach = shapely.unary_union([shapely.LineString(lane.line).buffer(0.5 * lane.width + 1.0) for lane in town])
    outline = streets.road.buffer(_KERB_WIDTH_M, join_style="mitre") - streets.road
    ways = [lane for lane in streets.lanes if lane.kind in ("walk", "crossing", "rail") and not lane.beside_road]
    openings = [shapely.LineString(lane.line).buffer(0.5 * lane.width) for lane in ways]
    # The end of a lane in the network is not the end of the street.
    openings += [
        shapely.LineString(lane.line).buffer(0.5 * lane.width - 0.05, cap_style="square")
        for lane in streets.lanes
        if lane.kind in ("road", "bicycle")
    ]
    return (outline & reach & shapely.box(*streets.window)) - shapely.unary_union(openings)


def _tracks(streets: Streets) -> list[MeshPart]:
    lines = [shapely.LineString(lane.line) for lane in streets.lanes if lane.kind == "rail" and not lane.internal]
    rails = [
        rail.buffer(0.04, cap_style="flat")
        for line in lines
        for rail in (line.offset_curve(0.5 * _GAUGE_M), line.offset_curve(-0.5 * _GAUGE_M))
    ]
    bars = streets.terrain.follow((shapely.unary_union(rails) & streets.rail) - streets.road.buffer(0.2))
    if bars.is_empty:
        return []
    return [slab(bars, streets.height, 0.12, "metal", "metal", 0.02, streets.terrain.upper(bars))]


def ground(streets: Streets, walk: shapely.Geometry) -> list[MeshPart]:
    """Return the ground below everything.

    Args:
        walk: polygon of footways and pavements.
    """
    terrain, land = streets.terrain, streets.land
    if land is None:
        return [mesh_part(terrain.nodes - [0.0, 0.0, GROUND_BELOW_M], terrain.faces, "ground")]
    shapely.prepare(streets.road)
    triangles = shapely.polygons(terrain.nodes[terrain.faces, :2])
    under_road = shapely.intersects(streets.road, triangles)
    stepped = under_road & (land.nodes[land.faces, 2] - terrain.nodes[terrain.faces, 2] > 1e-9).any(axis=1)
    # A triangle below a kerb is low as the gutter; what it has behind a narrow footway is high.
    # Without a grid the union of valid shapes whose edges nearly meet may be none.
    covered = shapely.union_all([streets.road, streets.rail, walk, streets.kerbs], grid_size=_GRID_M)
    shapely.prepare(covered)
    behind = shapely.difference(triangles[stepped][~shapely.covers(covered, triangles[stepped])], covered)
    return [
        mesh_part(land.nodes - [0.0, 0.0, GROUND_BELOW_M], land.faces[~stepped], "ground"),
        carpet(
            shapely.MultiPolygon(rings_of(shapely.geometrycollections(behind))), land.height, -GROUND_BELOW_M, "ground"
        ),
        mesh_part(terrain.nodes - [0.0, 0.0, 2.0 * GROUND_BELOW_M], terrain.faces[stepped], "ground"),
    ]
