"""Barriers: hedges, fences and walls along lines."""

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import MeshPart, slab, tube
from sim.world.roads.streets import Streets

HEIGHT_M = {"hedge": 1.5, "fence": 1.2, "wall": 1.8, "retaining_wall": 1.1, "guard_rail": 0.75, "railing": 1.1}
"""Default heights of barriers by supported kind, m."""

_HALF_M = {"hedge": 0.35, "wall": 0.12, "retaining_wall": 0.2, "guard_rail": 0.1}
_MATERIAL = {"hedge": "hedge", "wall": "brick", "retaining_wall": "concrete", "guard_rail": "metal"}
_POST_EVERY_M = 2.5
_RAIL_M = (0.02, 0.06)
_RAILS_EVERY_M = 0.22
_FROM_LANE_M = 0.4
_LEAST_M = 1.0


def barrier(kind: str, line: shapely.Geometry, height_m: float, streets: Streets) -> list[MeshPart]:
    """Return a barrier, clipped at lanes, footways and tracks.

    Args:
        line: along which it stands, m.
    """
    frame = shapely.box(*streets.window)
    if line.is_empty or not frame.intersects(line):
        return []
    around = shapely.bounds(line) + np.array([-1.0, -1.0, 1.0, 1.0])
    taken = shapely.union_all([shapely.clip_by_rect(c, *around) for c in (streets.road, streets.walk, streets.rail)])
    free = (line - taken.buffer(_FROM_LANE_M)) & frame
    parts = []
    for part in shapely.get_parts(shapely.line_merge(free) if free.geom_type == "MultiLineString" else free):
        if part.geom_type == "LineString" and part.length >= _LEAST_M:
            open_work = kind in ("fence", "railing")
            parts += _rails(part, height_m, streets) if open_work else _solid(kind, part, height_m, streets)
    return parts


def _solid(kind: str, line: shapely.LineString, height_m: float, streets: Streets) -> list[MeshPart]:
    band = streets.terrain.follow(line.buffer(_HALF_M[kind], cap_style="flat", join_style="mitre", mitre_limit=2.0))
    material = _MATERIAL[kind]
    foot = -0.45 if kind == "guard_rail" else 0.3
    return [slab(band, streets.height, height_m, material, material, foot, streets.terrain.upper(band))]


def _rails(line: shapely.LineString, height_m: float, streets: Streets) -> list[MeshPart]:
    """Return a fence of posts and rails, with gaps for rays."""
    half, thick = _RAIL_M
    band = streets.terrain.follow(line.buffer(half, cap_style="flat", join_style="mitre", mitre_limit=2.0))
    tops = np.arange(height_m, 0.1, -_RAILS_EVERY_M)
    rails = [slab(band, streets.height, float(top), "metal", "metal", thick - float(top)) for top in tops]
    places = shapely.get_coordinates(
        shapely.line_interpolate_point(line, np.linspace(0.0, line.length, 2 + int(line.length / _POST_EVERY_M)))
    )
    return [*rails, *(_post(place, height_m, streets) for place in places)]


def _post(xy: Array, height_m: float, streets: Streets) -> MeshPart:
    ground = float(streets.height(xy[None])[0])
    return tube([*xy, ground - 0.1], [*xy, ground + height_m + 0.05], (0.03, 0.03), "metal", 4)
