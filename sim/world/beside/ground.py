"""Free ground beside the road: off lanes, footways, tracks, houses, sight lines and what already stands."""

from collections.abc import Iterable

import numpy as np
import shapely
import shapely.ops
from numpy.typing import ArrayLike, NDArray

from sim.geometry import Array
from sim.world.roads.streets import Streets
from sim.world.roads.surfaces import pavement

UNIT_CLEAR_M = 12.0
"""Distance of tall things from roadside sensors, m."""
_UNIT_LOW_M = 3.0
_FINE_M = 40.0
_CELL_M = 4.0
_TILE_M = 30.0
_LEAST_M = 1.2
_WALK_CLEAR_M = 0.1


class _Tiled:
    """Polygon in square tiles, so that few of its corners are looked at near a place."""

    def __init__(self, shape: shapely.Geometry, frame: shapely.Geometry) -> None:
        low_x, low_y, high_x, high_y = frame.bounds
        x, y = np.meshgrid(np.arange(low_x, high_x, _TILE_M), np.arange(low_y, high_y, _TILE_M))
        tiles = shapely.intersection(shape, shapely.box(x, y, x + _TILE_M, y + _TILE_M).ravel())
        self._tree = shapely.STRtree(tiles[~shapely.is_empty(tiles)])

    def near(self, around: Array) -> NDArray[np.object_]:
        """Return the tiles that touch (4,) bounds."""
        return self._tree.geometries[self._tree.query(shapely.box(*around))]


class Ground:
    """Ground on which things may stand, and what they take of it.

    Args:
        houses: polygon of buildings and of structures of an encounter.
        clear: ground that an encounter keeps free.
        units: (U, 3) roadside sensors.
        taken: (N, 2) positions of what already stands.
    """

    def __init__(
        self,
        streets: Streets,
        houses: shapely.Geometry,
        clear: shapely.Geometry,
        units: Array,
        taken: Iterable[Array] = (),
    ) -> None:
        self.streets = streets
        self.road = shapely.unary_union([streets.road, streets.rail, streets.swept])
        self.footways = streets.walk
        self.walk = shapely.unary_union([streets.walk, pavement(streets)])
        self.houses = shapely.unary_union([houses, clear])
        self.frame = shapely.box(*streets.window).buffer(-1.0)
        self.fine = shapely.box(*streets.area).buffer(_FINE_M)
        self.units = units
        for shape in (self.road, self.footways, self.walk, self.houses, self.frame, self.fine):
            shapely.prepare(shape)
        self._tiled = [_Tiled(shape, self.frame) for shape in (self.road, self.footways, self.walk, self.houses)]
        self._taken: dict[tuple[int, int], list[tuple[float, float, float]]] = {}
        for xy in taken:
            self._add(xy, 0.3)

    def free(self, xy: Array, reach_m: ArrayLike, *, at_kerb: bool = False, tall: bool = False) -> NDArray[np.bool_]:
        """Return which (N, 2) positions keep `reach_m` from all that must stay free.

        Args:
            reach_m: one number or (N,).
            at_kerb: strips of pavement without a footway in the network count as free: posts stand there.
            tall: it would hide the view of a roadside sensor.
        """
        reach = np.broadcast_to(np.asarray(reach_m, np.float64), (len(xy),))
        places = shapely.points(xy)
        free = shapely.contains(self.frame, places)
        for shape, more in (
            (self.road, 0.25),
            (self.footways if at_kerb else self.walk, _WALK_CLEAR_M),
            (self.houses, 0.15),
        ):
            free[free] = ~shapely.dwithin(shape, places[free], reach[free] + more)
        return free & self.sees(xy, tall)

    def sees(self, xy: Array, tall: bool) -> NDArray[np.bool_]:
        """Return which (N, 2) positions keep away from roadside sensors."""
        if not len(self.units):
            return np.ones(len(xy), bool)
        away = np.hypot(*np.moveaxis(xy[:, None] - self.units[None, :, :2], 2, 0)).min(axis=1)
        return away > (UNIT_CLEAR_M if tall else _UNIT_LOW_M)

    def is_fine(self, xy: Array) -> NDArray[np.bool_]:
        """Return which (N, 2) positions lie so near the agents' area that details are seen."""
        return shapely.contains_xy(self.fine, *xy.T)

    def take(self, xy: Array, reach_m: float) -> bool:
        """Occupy a (2,) position; False if something stands there. Reaches add up to at most 4 m."""
        if not self._empty(xy, reach_m):
            return False
        self._add(xy, reach_m)
        return True

    def _add(self, xy: Array, reach_m: float) -> None:
        cell = (int(np.floor(xy[0] / _CELL_M)), int(np.floor(xy[1] / _CELL_M)))
        self._taken.setdefault(cell, []).append((float(xy[0]), float(xy[1]), reach_m))

    def take_line(
        self, line: shapely.Geometry, half_m: float, *, at_kerb: bool = False, tall: bool = False
    ) -> list[shapely.LineString]:
        """Occupy the free parts of a line along which something `2 half_m` thick may stand, and return them.

        Other arguments as `free`.
        """
        around = shapely.bounds(line) + np.array([-2.0, -2.0, 2.0, 2.0])
        if not np.isfinite(around).all():
            return []
        road, footways, walk, houses = self._tiled
        free = line & self.frame
        for shape, more in ((road, 0.1 if at_kerb else 0.25), (footways if at_kerb else walk, 0.1), (houses, 0.15)):
            tiles = shape.near(around)
            for piece in tiles[shapely.dwithin(tiles, line, half_m + more)]:
                free -= piece.buffer(half_m + more, quad_segs=2)
        if len(self.units):
            away = UNIT_CLEAR_M if tall else _UNIT_LOW_M
            free -= shapely.union_all(shapely.points(self.units[:, :2])).buffer(away)
        parts = []
        for part in shapely.get_parts(shapely.line_merge(free) if free.geom_type == "MultiLineString" else free):
            if part.geom_type == "LineString":
                parts += self._apart(part, half_m)
        return parts

    def _apart(self, line: shapely.LineString, half_m: float) -> list[shapely.LineString]:
        """Return the pieces of a line where nothing stands yet, and occupy them."""
        if line.length < _LEAST_M:
            return []
        along = np.linspace(0.0, line.length, 2 + int(line.length / 0.6))
        places = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
        free = np.array([self._empty(xy, half_m) for xy in places])
        for xy in places[free]:
            self._add(xy, half_m)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], free.astype(int), [0]])))
        runs = zip(along[edges[::2]], along[edges[1::2] - 1], strict=True)
        return [shapely.ops.substring(line, low, high) for low, high in runs if high - low >= _LEAST_M]

    def _empty(self, xy: Array, reach_m: float) -> bool:
        i, j = (int(k) for k in np.floor(xy / _CELL_M))
        near = [one for a in (i - 1, i, i + 1) for b in (j - 1, j, j + 1) for one in self._taken.get((a, b), ())]
        return all((x - xy[0]) ** 2 + (y - xy[1]) ** 2 >= (reach_m + other) ** 2 for x, y, other in near)
