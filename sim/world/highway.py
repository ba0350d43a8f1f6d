"""Static world along the roads of highway-env: lanes, paint, buildings and roadside furniture."""

import numpy as np
import shapely
import trimesh

from sim.geometry import Array
from sim.mesh.solids import MeshPart, join, to_mesh
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.highway.roads import LaneNetwork, RoadLane, read_roads
from sim.world.beside.build import Site, beside, density_of
from sim.world.buildings.houses import blocks, guard_rails
from sim.world.furniture.kerbside import furniture
from sim.world.furniture.map_objects import MapObjects
from sim.world.roads.markings import cut_line, dashes, offset, paint
from sim.world.roads.streets import NOTHING, Lane, Streets
from sim.world.roads.surfaces import surfaces
from sim.world.roads.terrain import level_land

_MARGIN_M = 120.0
_ON_M = 300.0
"""Length of road without traffic beyond the lanes of the environment, m."""

_MOTORWAY_MPS = 30.0
_LINE_M = 0.12
_DASH_M, _GAP_M = 3.0, 6.0
_ISLAND_M2 = 3000.0


def highway_world(scenario: Scenario, seed: int, streets: Streets) -> trimesh.Trimesh:
    """Build the static world along the roads of an environment, without SUMO.

    Args:
        seed: root seed of houses and trees.
        streets: of the environment, on their ground.

    Returns:
        As `sim.world.build.build_world`.

    Raises:
        ScenarioError: the environment is unknown, or highway-env is not installed.
    """
    roads = read_roads(scenario.network.highway_env)
    units = np.array([unit.xyz_m for unit in scenario.agents.roadside], np.float64).reshape(-1, 3)
    town = blocks(streets, units, random_generator(seed, Stream.BUILDING_BLOCKS), _islands(streets))
    if scenario.uneven:
        site = Site(streets, town.footprint, town.parts, NOTHING, units, MapObjects())
        things = beside(site, seed, density_of(scenario))
    else:
        things = furniture(streets, town.footprint, units, random_generator(seed, Stream.FURNITURE))
    return to_mesh(join([*surfaces(streets), *_paint(roads, streets), *town.parts, guard_rails(streets), *things]))


def highway_streets(roads: LaneNetwork, area: tuple[float, float, float, float] | None) -> Streets:
    """Return the lanes of an environment and the ground they cover, on level terrain."""
    lanes = (*roads.lanes, *roads.unused)
    points = np.concatenate([lane.line for lane in lanes])
    low, high = (np.array(area[:2]), np.array(area[2:])) if area else (points.min(axis=0), points.max(axis=0))
    window = (*(low - _MARGIN_M).tolist(), *(high + _MARGIN_M).tolist())
    frame = shapely.box(*window)
    strips = [_strip(line, lane.width) for lane in lanes for line in [_drawn(number_of(roads, lane), lane, roads)]]
    gaps = [
        shapely.LineString([lane.line[-1], roads.lanes[after].line[0]]).buffer(0.5 * lane.width)
        for lane in roads.lanes
        for after in lane.after
        if np.hypot(*(lane.line[-1] - roads.lanes[after].line[0])) > 0.1
    ]
    road = shapely.unary_union([*strips, *gaps])
    road = (road.buffer(0.4, join_style="mitre").buffer(-0.4, join_style="mitre").simplify(0.03).buffer(0)) & frame
    nothing = shapely.Polygon()
    drawn = tuple(_lane(number, lane, roads) for number, lane in enumerate(roads.lanes))
    area = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return Streets(area, window, drawn, road, nothing, nothing, level_land(window, 0.0))


def number_of(roads: LaneNetwork, lane: RoadLane) -> int | None:
    """Return the number of a lane, None for an unused one."""
    return roads.number(lane.index)


def _drawn(number: int | None, lane: RoadLane, roads: LaneNetwork) -> Array:
    """Return the line of a lane, extended straight where the roads begin and end."""
    line = lane.line
    if number is None or number in roads.entries:
        line = np.concatenate([[line[0] - _ON_M * _unit(line[1] - line[0])], line])
    if number is None or number in roads.exits:
        line = np.concatenate([line, [line[-1] + _ON_M * _unit(line[-1] - line[-2])]])
    return line


def _lane(number: int, lane: RoadLane, roads: LaneNetwork) -> Lane:
    line = _drawn(number, lane, roads)
    middle = len(lane.line) // 2
    left = offset(lane.line, 0.5 * lane.width + 1.0)[middle]
    return Lane(
        kind="road",
        line=line,
        width=lane.width,
        edge=lane.edge,
        index=lane.count - 1 - lane.index[2],
        count=lane.count,
        verge=0.0,
        internal=lane.through_junction,
        speed=max(lane.limit, _MOTORWAY_MPS) if roads.motorway else lane.limit,
        stop="",
        opposite=any(_holds(other, left) for other in roads.lanes if other.edge != lane.edge),
        beside_road=not lane.through_junction,
    )


def _holds(lane: RoadLane, xy: Array) -> bool:
    return bool(np.hypot(*(lane.line - xy).T).min() < 0.5 * lane.width)


def _unit(way: Array) -> Array:
    return way / max(float(np.hypot(*way)), 1e-9)


def _strip(line: Array, width: float) -> shapely.Geometry:
    return shapely.LineString(line).buffer(0.5 * width, cap_style="flat")


def _islands(streets: Streets) -> shapely.Geometry:
    """Return the traffic islands: small areas enclosed by roads, with grass and trees, without houses."""
    rings = [ring for part in shapely.get_parts(streets.road) for ring in getattr(part, "interiors", ())]
    return shapely.unary_union([shapely.Polygon(ring) for ring in rings if shapely.Polygon(ring).area < _ISLAND_M2])


def _paint(roads: LaneNetwork, streets: Streets) -> list[MeshPart]:
    """Return the lane lines as highway-env draws them, except across other lanes."""
    frame = shapely.box(*streets.window).buffer(-1.0)
    lanes = [(number_of(roads, lane), lane) for lane in (*roads.lanes, *roads.unused)]
    lines = [_drawn(number, lane, roads) for number, lane in lanes]
    inner = [
        shapely.LineString(line).buffer(0.5 * lane.width - 0.3) for line, (_, lane) in zip(lines, lanes, strict=True)
    ]
    bands: list[tuple[Array, Array]] = []
    for row, (line, (_, lane)) in enumerate(zip(lines, lanes, strict=True)):
        others = shapely.unary_union([shape for other, shape in enumerate(inner) if other != row])
        for kind, side in zip(lane.borders, (1.0, -1.0), strict=True):
            border = shapely.LineString(offset(line, side * (0.5 * lane.width - 0.5 * _LINE_M)))
            for part in shapely.get_parts((border & frame) - others):
                if part.geom_type == "LineString" and part.length > 1.0:
                    bands += _bands(np.asarray(part.coords), kind)
    return paint(bands, streets)


def _bands(line: Array, kind: str) -> list[tuple[Array, Array]]:
    """Return the left and right lines of the paint along a border."""
    length = float(np.hypot(*np.diff(line, axis=0).T).sum())
    cuts = {"none": [], "solid": [cut_line(line, 0.0, length)], "dashed": dashes(line, _DASH_M, _GAP_M)}[kind]
    return [(offset(cut, 0.5 * _LINE_M), offset(cut, -0.5 * _LINE_M)) for cut in cuts]
