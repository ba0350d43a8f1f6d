"""Terrain: one triangulated surface below roads, paint, kerbs, houses and trees."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from sim.geometry import Array
from sim.mesh.solids import rings_of

BEYOND_M = 250.0
"""Margin of the terrain beyond the built window, m."""

CELL_M = 4.0
"""Distance of nodes on and beside roads on uneven terrain, m."""

_BESIDE_M = 8.0
_RIM_M = 50.0
_MOST_NODES = 40_000
_FLAT_M = 0.05

Window = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Height field over the plane, equal to the height of roads.

    Attributes:
        nodes: (N, 3) m, the corner of least x and y first, that of greatest last.
        faces: (F, 3) rows of `nodes`, counter-clockwise seen from above.
        slopes: height interpolation between the nodes; None for level terrain.
    """

    nodes: Array
    faces: NDArray[np.int64]
    slopes: Callable[[Array], Array] | None

    @property
    def flat(self) -> bool:
        """Whether the terrain is level."""
        return self.slopes is None

    def height(self, xy: Array) -> Array:
        """Return (N,) height at (N, 2) positions; beyond the terrain that of its rim."""
        if self.slopes is None:
            return np.full(len(xy), self.nodes[0, 2])
        return self.slopes(np.clip(xy, self.nodes[0, :2], self.nodes[-1, :2]))

    def cut(self, shape: shapely.Geometry) -> shapely.Geometry:
        """Return polygons split along the edges of the terrain, each part on one triangle."""
        if self.slopes is None or shape.is_empty:
            return shape
        whole = shapely.make_valid(np.array(rings_of(shape)))
        tree = self.slopes.tree if isinstance(self.slopes, Facets) else _tree(self.nodes, self.faces)
        shapely.prepare(whole)
        of, face = tree.query(whole, predicate="intersects")
        parts = tree.geometries[face]
        inside = shapely.contains(whole[of], parts)
        parts[~inside] = shapely.intersection(whole[of][~inside], parts[~inside])
        found = [ring for part in parts for ring in rings_of(part)]
        # A sliver may meet triangles in points and lines alone.
        return shapely.multipolygons(found) if found else shapely.MultiPolygon()

    def follow(self, shape: shapely.Geometry) -> shapely.Geometry:
        """Return a shape with added corners, so that its outline follows the terrain."""
        return shape if self.slopes is None else shapely.segmentize(shape, CELL_M)

    def upper(self, shape: shapely.Geometry) -> shapely.Geometry | None:
        """Return the parts of the upper face of what is built along the ground, as `cut`; None in version 1.

        Triangulation drops the corners that `follow` adds to straight outlines, so that faces of long straight shapes
        would span hollows. Worlds of version 1 keep them so.
        """
        return self.cut(shape) if isinstance(self.slopes, Facets) else None


def level_land(window: Window, height_m: float) -> Terrain:
    """Return level terrain around a window: two triangles."""
    low, high = land_corners(window)
    nodes = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    return Terrain(np.column_stack([nodes, np.full(4, height_m)]), np.array([[0, 2, 3], [0, 3, 1]]), None)


def land(window: Window, lines: list[Array], covered: shapely.Geometry) -> Terrain:
    """Return the terrain around a window with the heights of the lanes.

    On and beside roads its nodes lie `CELL_M` apart, farther where there would be too many, and have the height of the
    nearest point of a lane. Elsewhere it interpolates linearly between roads and the rim.

    Args:
        window: x_min, y_min, x_max, y_max of the built window, m.
        lines: (K, 3) centre lines of lanes.
        covered: polygon of lanes and footways.
    """
    heights = np.concatenate([line[:, 2] for line in lines]) if lines else np.zeros(1)
    if np.ptp(heights) < _FLAT_M:
        return level_land(window, float(heights[0]))
    near = covered.buffer(_BESIDE_M)
    shapely.prepare(near)
    cell_m = max(CELL_M, float(np.sqrt(near.area / _MOST_NODES)))
    low, high = land_corners(window)
    places = grid(low, high, cell_m)
    flat = np.unique(np.concatenate([places[shapely.contains_xy(near, *places.T)], rim(low, high)]), axis=0)
    mesh, level = Delaunay(flat), _lane_heights(lines, flat)
    faces = mesh.simplices.astype(np.int64)
    return Terrain(np.column_stack([flat, level]), faces, LinearNDInterpolator(mesh, level))


class Facets:
    """Heights on triangles that are found by a tree: graded ones, which scipy's walk from one to the next gets lost in.

    Args:
        nodes: (N, 3) m.
        faces: (F, 3) rows of `nodes`, none upright.
        tree: the triangles seen from above, where they are at hand.

    Attributes:
        tree: the triangles seen from above.
    """

    def __init__(self, nodes: Array, faces: NDArray[np.int64], tree: shapely.STRtree | None = None) -> None:
        self.tree = tree or _tree(nodes, faces)
        self._corner = nodes[faces[:, 0]]
        edges = nodes[faces[:, 1:]] - self._corner[:, None]
        self._slope = np.linalg.solve(edges[:, :, :2], edges[:, :, 2:])[:, :, 0]

    def __call__(self, xy: Array) -> Array:
        """Return (N,) heights at (N, 2) positions, beyond all triangles on the plane of the nearest."""
        places = shapely.points(xy)
        place, face = self.tree.query(places, predicate="intersects")
        below = np.full(len(xy), -1)
        below[place[::-1]] = face[::-1]  # of two on a common edge the first
        lost = np.flatnonzero(below < 0)
        below[lost] = self.tree.nearest(places[lost])
        return self._corner[below, 2] + ((xy - self._corner[below, :2]) * self._slope[below]).sum(axis=1)


def _tree(nodes: Array, faces: NDArray[np.int64]) -> shapely.STRtree:
    """Return the triangles seen from above, by their places."""
    return shapely.STRtree(shapely.polygons(nodes[faces, :2]))


def land_corners(window: Window) -> tuple[Array, Array]:
    """Return the corners of the terrain around a window, of least and of greatest x and y."""
    return np.array(window[:2]) - BEYOND_M, np.array(window[2:]) + BEYOND_M


def rim(low: Array, high: Array) -> Array:
    """Return (N, 2) nodes around the rectangle between two corners, which are among them."""
    places = grid(low, high, _RIM_M)
    return places[((places == low) | (places == high)).any(axis=1)]


def grid(low: Array, high: Array, cell_m: float) -> Array:
    """Return an (N, 2) grid between two corners, included, at most `cell_m` apart along x and y."""
    count = np.ceil((high - low) / cell_m).astype(int) + 1
    x, y = np.linspace(low[0], high[0], count[0]), np.linspace(low[1], high[1], count[1])
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _lane_heights(lines: list[Array], xy: Array) -> Array:
    """Return (N,) heights of the lane points nearest to (N, 2) positions."""
    lanes, places = np.array([shapely.LineString(line) for line in lines]), shapely.points(xy)
    nearest = lanes[shapely.STRtree(lanes).nearest(places)]
    return shapely.get_z(shapely.line_interpolate_point(nearest, shapely.line_locate_point(nearest, places)))
