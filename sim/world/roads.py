"""Surfaces to drive and walk on: carriageway, pavement, kerb, track and the ground around them."""

import numpy as np
import shapely

from sim.world.solids import Array, Piece, carpet, piece, rings_of, slab
from sim.world.streets import Streets

GROUND_BELOW_M = 0.05
"""How far the ground lies below the road."""

TOWN_SPEED_MPS = 21.0
"""Roads up to this limit have kerbs and pavements; faster ones have guard rails."""

_GROUND_BEYOND_M = 250.0
_PAVEMENT_WIDTH_M = 2.5
_KERB_WIDTH_M = 0.15
_KERB_HEIGHT_M = 0.10
_GAUGE_M = 1.435
_CELL_M = 4.0


def surfaces(streets: Streets) -> list[Piece]:
    """Return carriageways, pavements with kerbs, tracks and the ground."""
    height = streets.height
    walk, kerbs = pavement(streets), _kerbs(streets)
    kerbs = kerbs if streets.flat else shapely.segmentize(kerbs, _CELL_M)
    return [
        carpet(_cells(streets, streets.road), height, 0.0, "asphalt"),
        carpet(_cells(streets, walk), height, 0.0, "pavement"),
        carpet(_cells(streets, streets.rail - walk), height, -0.01, "gravel"),
        slab(kerbs, height, _KERB_HEIGHT_M, "kerb", "kerb", GROUND_BELOW_M),
        *_tracks(streets),
        ground(streets),
    ]


def pavement(streets: Streets) -> shapely.Geometry:
    """Return the polygon of footways and of a strip along the carriageways of a town."""
    strips = [
        shapely.LineString(lane.line).buffer(-0.5 * lane.width - _PAVEMENT_WIDTH_M, single_sided=True)
        for lane in streets.lanes
        if lane.kind == "road" and not lane.internal and lane.index == 0 and _in_town(lane.speed)
    ]
    around = shapely.unary_union(strips).buffer(0.2).buffer(-0.2) & shapely.box(*streets.window)
    return ((around | streets.walk) - streets.road - streets.rail).simplify(0.05).buffer(0)


def _in_town(speed: float) -> bool:
    # A footpath has a walking pace and a service road none of its own pavement.
    return 8.5 <= speed <= TOWN_SPEED_MPS


def _kerbs(streets: Streets) -> shapely.Geometry:
    """Return the stones along the carriageways of a town; none where somebody walks or drives across."""
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


def _tracks(streets: Streets) -> list[Piece]:
    """Return the two rails of each track off the road."""
    lines = [shapely.LineString(lane.line) for lane in streets.lanes if lane.kind == "rail" and not lane.internal]
    rails = [
        rail.buffer(0.04, cap_style="flat")
        for line in lines
        for rail in (line.offset_curve(0.5 * _GAUGE_M), line.offset_curve(-0.5 * _GAUGE_M))
    ]
    bars = (shapely.unary_union(rails) & streets.rail) - streets.road.buffer(0.2)
    return [slab(bars, streets.height, 0.12, "metal", "metal", 0.02)] if not bars.is_empty else []


def ground(streets: Streets) -> Piece:
    """Return the ground below everything: two triangles when the network is flat, else cells of 20 m."""
    low_x, low_y, high_x, high_y = streets.window
    low = np.array([low_x, low_y]) - _GROUND_BEYOND_M
    high = np.array([high_x, high_y]) + _GROUND_BEYOND_M
    cells = np.array([1, 1]) if streets.flat else np.ceil((high - low) / 20.0).astype(int)
    x, y = np.linspace(low[0], high[0], cells[0] + 1), np.linspace(low[1], high[1], cells[1] + 1)
    flat: Array = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    # Between the knots a slope may rise above a coarse cell: the ground of hilly country lies a little deeper.
    lift = -GROUND_BELOW_M if streets.flat else -0.5
    corner = (np.arange(cells[0])[:, None] * (cells[1] + 1) + np.arange(cells[1])).ravel()
    right = corner + cells[1] + 1
    faces = np.concatenate(
        [np.column_stack([corner, right, right + 1]), np.column_stack([corner, right + 1, corner + 1])]
    )
    return piece(np.column_stack([flat, streets.height(flat) + lift]), faces, "ground")


def _cells(streets: Streets, shape: shapely.Geometry) -> shapely.Geometry:
    """Return a shape cut into cells that can follow the heights of the streets; a flat one stays whole."""
    if streets.flat or shape.is_empty:
        return shape
    low_x, low_y, high_x, high_y = shape.bounds
    x, y = np.meshgrid(np.arange(low_x, high_x, _CELL_M), np.arange(low_y, high_y, _CELL_M), indexing="ij")
    cells = shapely.box(x.ravel(), y.ravel(), x.ravel() + _CELL_M, y.ravel() + _CELL_M)
    shapely.prepare(shape)
    parts = shapely.intersection(cells[shapely.intersects(shape, cells)], shape)
    return shapely.multipolygons([part for whole in parts for part in rings_of(whole)])
