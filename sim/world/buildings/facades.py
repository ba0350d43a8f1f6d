"""Facades: windows and wall colours of houses."""

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.geometry import Array
from sim.mesh.solids import MeshPart, join, mesh_part
from sim.roads.polygons import STOREY_M
from sim.streams import Stream, random_generator

WALLS = ("brick", "plaster", "concrete")
"""Wall materials."""

_EVERY_M = 2.6
_WIDTH_M = 1.3
_SILL_M, _HEAD_M = 1.0, 2.4
_PROUD_M = 0.03
_MARGIN_M = 1.2


def windows(ends: Array, low: Array, high: Array) -> MeshPart:
    """Return rows of window panes on upright rectangular walls, slightly in front of them.

    Args:
        ends: (W, 2, 2) ends of each wall seen from above, the outside on the right from first to second.
        low: (W,) height of the foot, m.
        high: (W,) height of the top, m.
    """
    corners = [_panes(wall, z, top) for wall, z, top in zip(ends, low, high, strict=True)]
    corners = [quad for quad in corners if len(quad)]
    if not corners:
        return join([])
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return mesh_part(quads.reshape(-1, 3), faces, "glass")


def _panes(wall: Array, low: float, high: float) -> Array:
    """Return (P, 4, 3) corners of the panes of one wall, counter-clockwise seen from outside."""
    way = wall[1] - wall[0]
    length = float(np.hypot(*way))
    across, up = int((length - 2.0 * _MARGIN_M) / _EVERY_M), int((high - low) / STOREY_M + 0.2)
    if across < 1 or up < 1:
        return np.zeros((0, 4, 3))
    way = way / length
    outside = np.array([way[1], -way[0]])
    start = 0.5 * (length - across * _EVERY_M) + 0.5 * (_EVERY_M - _WIDTH_M) + _EVERY_M * np.arange(across)
    floor = low + STOREY_M * np.arange(up)
    left, storey = (grid.ravel() for grid in np.meshgrid(start, floor, indexing="ij"))
    along = np.stack([left, left + _WIDTH_M, left + _WIDTH_M, left], axis=1)
    z = np.stack([storey + _SILL_M, storey + _SILL_M, storey + _HEAD_M, storey + _HEAD_M], axis=1)
    z = np.minimum(z, high - 0.1)
    flat = wall[0] + _PROUD_M * outside + along[..., None] * way
    return np.concatenate([flat, z[..., None]], axis=2)


def wall_rectangles(triangles: Array, footprint: shapely.Geometry) -> tuple[Array, Array, Array]:
    """Return the rectangular walls of (F, 3, 3) upright triangles, as arguments of `windows`.

    A wall counts if its triangles fill a rectangle and exactly one of its sides is outside of the footprint.
    """
    group, walls = wall_groups(triangles)
    low, high = np.full(len(walls), np.inf), np.full(len(walls), -np.inf)
    np.minimum.at(low, group, triangles[:, :, 2].min(axis=1))
    np.maximum.at(high, group, triangles[:, :, 2].max(axis=1))
    covered = np.zeros(len(walls))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.add.at(covered, group, 0.5 * np.linalg.norm(normal, axis=1))
    length = np.hypot(*(walls[:, 1] - walls[:, 0]).T)
    filled = np.abs(covered - length * (high - low)) < 0.02 * covered + 0.05
    walls, outside_right = face_outside(walls, length, footprint)
    keep = filled & outside_right
    return walls[keep], low[keep], high[keep]


def wall_groups(triangles: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the wall of each of (F, 3, 3) upright triangles, (F,), and the (W, 2, 2) ends of each wall from above."""
    flat = triangles[:, :, :2]
    pairs = np.stack([flat, np.roll(flat, -1, axis=1)], axis=2)
    longest = np.hypot(*np.moveaxis(pairs[:, :, 1] - pairs[:, :, 0], 2, 0)).argmax(axis=1)
    ends = pairs[np.arange(len(pairs)), longest]
    swap = (ends[:, 0, 0] > ends[:, 1, 0]) | ((ends[:, 0, 0] == ends[:, 1, 0]) & (ends[:, 0, 1] > ends[:, 1, 1]))
    ends[swap] = ends[swap][:, ::-1]
    _, first, group = np.unique(ends.reshape(-1, 4).round(2), axis=0, return_index=True, return_inverse=True)
    return group.ravel(), ends[first]


def face_outside(walls: Array, length: Array, footprint: shapely.Geometry) -> tuple[Array, NDArray[np.bool_]]:
    """Return walls oriented with the outside on their right, and the mask of those with exactly one side outside."""
    way = (walls[:, 1] - walls[:, 0]) / np.maximum(length, 1e-9)[:, None]
    middle, aside = walls.mean(axis=1), 0.4 * np.column_stack([way[:, 1], -way[:, 0]])
    shapely.prepare(footprint)
    right = shapely.contains_xy(footprint, *(middle + aside).T)
    left = shapely.contains_xy(footprint, *(middle - aside).T)
    turned = np.where((right & ~left)[:, None, None], walls[:, ::-1], walls)
    return turned, right != left


def colours(centers: Array, footprint: shapely.Geometry) -> NDArray[np.str_]:
    """Return (N,) wall materials at (N, 2) positions: one per house, independent of the seed."""
    houses = [part for part in shapely.get_parts(footprint) if part.geom_type == "Polygon"]
    if not houses or not len(centers):
        return np.full(len(centers), WALLS[0], dtype="U16")
    chosen = random_generator(len(houses), Stream.FACADES).integers(len(WALLS), size=len(houses))
    nearest = shapely.STRtree(houses).nearest(shapely.points(centers))
    return np.array(WALLS, dtype="U16")[chosen[nearest]]
