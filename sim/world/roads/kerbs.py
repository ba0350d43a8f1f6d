"""Kerbs of worlds of version 2: the step up to the footway, dropped where people, cars and rears of lorries pass it.

Heights as these sources are commonly quoted; their texts were not at hand: kerbs of 12 cm beside footways, of 10 to 15
cm in all, and 3 cm at drives (RASt 06, FGSV); 3 cm at crossings, and ramps of at most 6 % to them (DIN 18040-3).
"""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely.ops import substring

from sim.geometry import Array
from sim.mesh.solids import rings_of
from sim.streams import Stream, random_generator
from sim.world.roads.streets import Streets

KERB_M, DROPPED_M = 0.12, 0.03
"""Height of a footway above the gutter, and where its kerb is dropped, m."""
STONE_M = 0.15
"""Width of a kerb stone, m."""

_RAMP_M = (KERB_M - DROPPED_M) / 0.06
_DRIVE_M, _DRIVE_EVERY_M = 3.5, (30.0, 70.0)
RAMP_STEP_M = 1.0
"""Distance of corners where the height of a kerb changes, m."""

_TOUCH_M, _AHEAD_M = 0.1, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Kerbs:
    """Outlines of carriageways as lines, by how high the ground beside them lies.

    Attributes:
        high: along footways.
        dropped: the same, at crossings, drives and swept corners.
        level: without a footway, and those of tracks.
    """

    high: shapely.Geometry
    dropped: shapely.Geometry
    level: shapely.Geometry

    @property
    def ramps(self) -> shapely.Geometry:
        """Polygon around the places where heights change."""
        return shapely.union_all([self.high.boundary, self.dropped]).buffer(_RAMP_M, quad_segs=2)

    def rise(self, xy: Array) -> Array:
        """Return (N,) heights of the ground at (N, 2) positions above the gutter near it, m: off the carriageway."""
        high, dropped, level = (_distance(line, xy) for line in (self.high, self.dropped, self.level))
        # Behind a dropped kerb the whole footway is low.
        kerbed = np.clip((level - np.minimum(high, dropped)) / _RAMP_M, 0.0, 1.0)
        return kerbed * (DROPPED_M + (KERB_M - DROPPED_M) * np.clip((dropped - high) / _RAMP_M, 0.0, 1.0))


def kerbs_of(streets: Streets, paved: shapely.Geometry, seed: int) -> Kerbs:
    """Return the kerbs wherever footways border carriageways.

    Args:
        streets: on any land.
        paved: polygon of footways and pavements.
        seed: of the drives.
    """
    outline = streets.road.boundary
    beside = paved.buffer(_TOUCH_M, quad_segs=2)
    shapely.prepare(beside)
    # Gaps in the outline of a footway are none in its kerb.
    level = _long(outline - beside, 2.0 * _RAMP_M)
    kerbed = outline - level.buffer(0.01)
    ways = [lane for lane in streets.lanes if lane.kind in ("walk", "crossing", "rail") and not lane.beside_road]
    # Crossings of the network may end some metres before the edge of the carriageway.
    openings = [prolonged(lane.line, _AHEAD_M).buffer(0.5 * lane.width, cap_style="flat") for lane in ways]
    low = shapely.union_all([*openings, streets.swept.buffer(0.05), *_drives(kerbed, seed)])
    return Kerbs(kerbed - low, kerbed & low, shapely.union_all([level, streets.rail.boundary]))


def prolonged(line: Array, ahead_m: float) -> shapely.LineString:
    """Return a (K, 2) line with a straight piece at both ends."""
    first, last = (ahead_m * way / np.hypot(*way) for way in (line[0] - line[1], line[-1] - line[-2]))
    return shapely.LineString([line[0] + first, *line, line[-1] + last])


def _drives(kerbed: shapely.Geometry, seed: int) -> list[shapely.Geometry]:
    """Return ground around dropped kerbs of drives, some tens of metres apart."""
    rng, found = random_generator(seed, Stream.BESIDE, "drives"), []
    for line in shapely.get_parts(shapely.line_merge(kerbed) if kerbed.geom_type == "MultiLineString" else kerbed):
        at = float(rng.uniform(*_DRIVE_EVERY_M))
        while at < line.length - _DRIVE_M:
            found.append(substring(line, at, at + _DRIVE_M).buffer(0.05))
            at += _DRIVE_M + float(rng.uniform(*_DRIVE_EVERY_M))
    return found


def _long(lines: shapely.Geometry, least_m: float) -> shapely.Geometry:
    merged = shapely.line_merge(lines) if lines.geom_type == "MultiLineString" else lines
    return shapely.MultiLineString([part for part in shapely.get_parts(merged) if part.length >= least_m])


def stones(streets: Streets, kerbs: Kerbs) -> shapely.Geometry:
    """Return the polygon of kerb stones."""
    line = kerbs.high | kerbs.dropped
    around = (line.buffer(STONE_M, quad_segs=2) & shapely.box(*streets.window)) - streets.road
    return shapely.MultiPolygon(rings_of(around))


def _distance(line: shapely.Geometry, xy: Array) -> Array:
    points = shapely.get_coordinates(shapely.segmentize(line, 0.5 * RAMP_STEP_M))
    return cKDTree(points).query(xy)[0] if len(points) else np.full(len(xy), 1e6)
