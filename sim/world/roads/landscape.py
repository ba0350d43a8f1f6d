"""Landscape: uneven land around streets, with crowned carriageways, embankments, ditches and rough ground beside them.

A street is level across, apart from its crown: its height is that of the relief along its axis. At junctions streets go
over into each other, and crowns run out where vehicles turn, so that rigid bodies stand on them. Kerbs raise its
footways and the land behind them; right behind these rise or fall banks to the plots, and the land goes over into the
relief, as an embankment or a cutting. A network with heights of its own keeps them.

Values as these sources are commonly quoted; their texts were not at hand: cross-fall of 2.5 %, also of footways towards
the gutter, and embankments 1 : 1.5 and flatter, RASt 06 and RAL (FGSV); ditches, RAS-Ew (FGSV), as wide as five times
their depth; roughness of ground, random roughness of tilled and grown soil, 6 to 40 mm (Zobeck and Onstad, Tillage and
random roughness effects on surface storage, 1987).
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from sim.geometry import Array, wrap_angle
from sim.streams import Stream, random_generator
from sim.world.roads.kerbs import KERB_M, RAMP_STEP_M, Kerbs
from sim.world.roads.markings import offset
from sim.world.roads.relief import MOTORWAY, PLOTS, TOWN, draw_relief
from sim.world.roads.streets import Lane, Streets, heading
from sim.world.roads.surfaces import TOWN_SPEED_MPS
from sim.world.roads.terrain import CELL_M, Facets, Terrain, grid, land_corners, rim

CROSS_FALL = 0.025
DITCH_M = 0.4
"""Depth of a ditch, m."""
ROUGH_M = 0.035
"""Standard deviation of the heights of unpaved ground, m."""

_CROWN_M = 4.0
_DITCH_BEGINS_M, _DITCH_WIDTH_M = 2.0, 2.5
_ROUGH_FROM_M, _ROUGH_FULL_M = 0.4, 1.5
_BANK_M, _FOOTWAY_M = 2.5, 4.0
"""Width of banks right behind the paved ground, and of footways at most, m."""
_VERGE_M, _APRON_M = 14.0, 45.0
"""Distances from the paved ground to which the land goes over into the relief, and is meshed finely, m."""
_VERGE_CELL_M, _APRON_CELL_M, _FAR_CELL_M = 1.3, 6.5, 25.0
_MOST_NODES = 50_000
"""Most nodes on paved ground, and on the verge."""

_ALONG_M, _NEAREST, _BLEND_M = 2.5, 64, 15.0
"""Distance of points along axes, m; points that blend at a place, and over which distance, m: shorter, and neighbouring
streets of a junction meet in curves below the radius of a crest."""
_RUNS_OUT_M, _TURN_RAD = 16.0, np.radians(20.0)
"""Distance from turning lanes in which a crown rises, m, and the least turn of these."""
_APART_M, _AXES_APART_M, _EDGE_M = 0.9, 6.0, 2.2
"""Distances of nodes, of points that blend, and of nodes along carriageways, m: so dense that no triangle reaches from
a bank or a footway into the carriageway."""


@dataclass(frozen=True, slots=True, eq=False)
class _Axes:
    """Points along the axes of roads: (N, 2) m, and the (N,) speed limit there, m/s."""

    xy: Array
    speed: Array


def uneven_land(streets: Streets, paved: shapely.Geometry, kerbs: Kerbs, seed: int) -> tuple[Terrain, Terrain]:
    """Return the uneven terrain of carriageways, and on the same triangles that of the land beside them.

    Args:
        streets: on their level land, or on that of the heights of their network.
        paved: polygon of footways and pavements.
        kerbs: which raise footways and the land behind them.
        seed: of the relief, the banks and the roughness.
    """
    axes = _axes(streets)
    covered = shapely.union_all([streets.road, streets.rail, paved])
    xy = _nodes(streets, covered, axes, kerbs)
    road, edge = _Region(streets.road), _Region(covered)
    beside_m = edge.outside(xy)
    level = _relief(streets, axes, xy, beside_m, seed)
    level += CROSS_FALL * np.minimum(road.inside(xy), _CROWN_M) * _smooth(_turning(streets).outside(xy) / _RUNS_OUT_M)
    fast = axes.speed[cKDTree(axes.xy).query(xy)[1]] > TOWN_SPEED_MPS
    into = (beside_m - _DITCH_BEGINS_M) / _DITCH_WIDTH_M
    # Beside roads that are too fast for kerbs banks begin behind the ditch.
    bank = _smooth(np.where(fast, beside_m - _DITCH_BEGINS_M - _DITCH_WIDTH_M, beside_m) / _BANK_M)
    level += bank * draw_relief(seed, PLOTS, "plots").height(xy)
    level -= DITCH_M * fast * np.sin(np.pi * np.clip(into, 0.0, 1.0)) ** 2
    rough = np.clip((beside_m - _ROUGH_FROM_M) / (_ROUGH_FULL_M - _ROUGH_FROM_M), 0.0, 1.0)
    level += ROUGH_M * rough * random_generator(seed, Stream.ROUGHNESS).standard_normal(len(xy))
    faces, rise = Delaunay(xy).simplices.astype(np.int64), kerbs.rise(xy)
    rise += rise / KERB_M * CROSS_FALL * np.minimum(road.outside(xy), _FOOTWAY_M)
    road_side, land_side = np.column_stack([xy, level]), np.column_stack([xy, level + rise])
    facets = Facets(road_side, faces)
    return (
        Terrain(road_side, faces, facets),
        Terrain(land_side, faces, Facets(land_side, faces, facets.tree)),
    )


def _smooth(share: Array) -> Array:
    """Return the way from 0 to 1 without corners, of the shares of it."""
    share = np.clip(share, 0.0, 1.0)
    return share**2 * (3.0 - 2.0 * share)


def _relief(streets: Streets, axes: _Axes, xy: Array, beside_m: Array, seed: int) -> Array:
    """Return (N,) heights of streets and of the land between them, without crowns and ditches."""
    if not streets.terrain.flat:
        return streets.terrain.height(xy)
    relief = draw_relief(seed, MOTORWAY if np.median(axes.speed) > TOWN_SPEED_MPS else TOWN)
    natural = relief.height(xy)
    points = _apart(axes.xy, _AXES_APART_M)
    distance, near = cKDTree(points).query(xy, k=min(_NEAREST, len(points)))
    distance, near = distance.reshape(len(xy), -1), near.reshape(len(xy), -1)
    weight = np.exp((distance[:, :1] ** 2 - distance**2) / (2.0 * _BLEND_M**2))
    street = (weight * relief.height(points)[near]).sum(axis=1) / weight.sum(axis=1)
    return streets.terrain.nodes[0, 2] + street + _smooth(beside_m / _VERGE_M) * (natural - street)


def _turning(streets: Streets) -> "_Region":
    """Return the ground of lanes on which vehicles turn at junctions."""
    lanes = [lane for lane in streets.lanes if lane.kind == "road" and lane.internal]
    turns = [lane for lane in lanes if abs(wrap_angle(heading(lane.line[-2:]) - heading(lane.line[:2]))) > _TURN_RAD]
    ways = [shapely.LineString(lane.line).buffer(0.5 * lane.width, cap_style="flat") for lane in turns]
    return _Region(shapely.union_all(ways))


def _axes(streets: Streets) -> _Axes:
    points, speeds = [], []
    for lane in streets.lanes:
        line = _axis(lane)
        if line is not None:
            points.append(_spaced(shapely.LineString(line), _ALONG_M))
            speeds.append(np.full(len(points[-1]), lane.speed))
    if not points:
        x_min, y_min, x_max, y_max = streets.area
        return _Axes(np.array([[0.5 * (x_min + x_max), 0.5 * (y_min + y_max)]]), np.zeros(1))
    return _Axes(np.concatenate(points), np.concatenate(speeds))


def _axis(lane: Lane) -> Array | None:
    """Return the axis of the road of a lane, None where another lane of its road gives it."""
    if lane.kind == "crossing" or (lane.kind != "road" and lane.beside_road):
        return None
    if lane.kind != "road" or lane.internal:
        return lane.line
    if lane.index + 1 < lane.count:
        return None
    # Both directions of a street share their inner border; a road of one direction has its axis in its middle.
    return offset(lane.line, lane.kerb_side * 0.5 * lane.width * (-1.0 if lane.opposite else lane.count - 1.0))


def _nodes(streets: Streets, covered: shapely.Geometry, axes: _Axes, kerbs: Kerbs) -> Array:
    """Return the (N, 2) nodes: dense on the paved ground and beside it, fewer far from it."""
    low, high = land_corners(streets.window)
    frame = shapely.box(*streets.window)
    verge = (covered.buffer(_VERGE_M, quad_segs=2) & frame) - covered
    apron = (covered.buffer(_APRON_M, quad_segs=2) & frame) - covered - verge
    crown = streets.road.buffer(-_CROWN_M, join_style="mitre")
    rings = ((streets.road, _EDGE_M), (covered, CELL_M), (crown, CELL_M))
    edges = np.concatenate([_spaced(shape.boundary, step_m) for shape, step_m in rings])
    ramps = kerbs.ramps & covered
    along = _spaced(streets.road.boundary & ramps, RAMP_STEP_M)
    kept = [rim(low, high), along, edges, axes.xy[:: round(CELL_M / _ALONG_M)]]
    cells = ((ramps - streets.road, _VERGE_CELL_M), (covered, CELL_M), (verge, _VERGE_CELL_M), (apron, _APRON_CELL_M))
    for shape, cell_m in cells:
        kept.append(_inside(shape, low, high, max(cell_m, float(np.sqrt(shape.area / _MOST_NODES)))))
    far = grid(low, high, _FAR_CELL_M)
    shapely.prepare(near := shapely.union_all([covered, verge, apron]))
    kept.append(far[~shapely.contains_xy(near, *far.T)])
    xy = np.concatenate(kept)
    inside = ((xy >= low) & (xy <= high)).all(axis=1)
    return np.unique(_apart(xy[inside], _APART_M), axis=0)


def _inside(shape: shapely.Geometry, low: Array, high: Array, cell_m: float) -> Array:
    if shape.is_empty:
        return np.zeros((0, 2))
    x_min, y_min, x_max, y_max = shape.bounds
    places = grid(np.maximum([x_min, y_min], low), np.minimum([x_max, y_max], high), cell_m)
    shapely.prepare(shape)
    return places[shapely.contains_xy(shape, *places.T)]


def _apart(xy: Array, least_m: float) -> Array:
    """Return points of which none lies close to an earlier one."""
    near = cKDTree(xy).query_pairs(least_m, output_type="ndarray")
    dropped = np.zeros(len(xy), bool)
    for first, second in near[np.lexsort((near[:, 1], near[:, 0]))]:
        if not dropped[first]:
            dropped[second] = True
    return xy[~dropped]


class _Region:
    """Distances from the outline of a polygon."""

    def __init__(self, shape: shapely.Geometry) -> None:
        self._shape = shape
        shapely.prepare(shape)
        self._outline = None if shape.is_empty else cKDTree(_spaced(shape.boundary, 1.0))

    def inside(self, xy: Array) -> Array:
        """Return (N,) distances to the outline of points inside, 0 outside, m."""
        return np.where(self._holds(xy), self._distance(xy), 0.0)

    def outside(self, xy: Array) -> Array:
        """Return (N,) distances to the outline of points outside, 0 inside, m."""
        return np.where(self._holds(xy), 0.0, self._distance(xy))

    def _holds(self, xy: Array) -> NDArray[np.bool_]:
        return np.asarray(shapely.intersects_xy(self._shape, *xy.T))

    def _distance(self, xy: Array) -> Array:
        return np.full(len(xy), np.inf) if self._outline is None else self._outline.query(xy)[0]


def _spaced(line: shapely.Geometry, step_m: float) -> Array:
    """Return (N, 2) points along lines, at most `step_m` apart, their corners included."""
    return np.asarray(shapely.get_coordinates(shapely.segmentize(line, step_m)))
