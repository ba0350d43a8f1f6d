"""Boundaries of plots and what stands at kerbs: hedges, rows of shrubs, fences and walls along lines."""

import numpy as np
import shapely
from shapely.ops import substring

from sim.geometry import Array
from sim.mesh.solids import MeshPart, move
from sim.world.beside.edges import Edge, yielding
from sim.world.beside.fences import HEIGHT_M, THICK_M, fence
from sim.world.beside.ground import Ground
from sim.world.beside.plants import HEDGE_TIPS_M, hedge, shrub
from sim.world.roads.markings import offset
from sim.world.roads.streets import Streets

_AROUND_CORNER_M = 12.0
_SIGHT_M, _LOW_M = 12.0, (0.6, 0.85)
"""Near where drivers yield, and at the kerb near crossings, boundaries are low, m: sight fields are free above 0.8 m
(RASt 06, 6.3.9.3)."""

_FRONT_M, _FRONT_REACH_M, _LEAST_FRONT_M = 1.05, 30.0, 1.5
"""Distance of the middle of a boundary from the paved ground, that of the farthest street and shortest front, m."""

_SHRUB_VARIANTS = 8
_WIDTH_M = {"hedge": (0.6, 1.0), "shrubs": (0.9, 1.4)}


def boundaries(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    """Return hedges, rows of shrubs, fences and walls along the plots, around the corners of streets too."""
    shapes, sight = shrub_shapes(rng), yielding(ground.streets)
    shapely.prepare(sight)
    parts: list[MeshPart] = []
    for piece, edge in _fronts(rng, edges, ground):
        kind = drawn(rng, edge.density.boundary, density)
        if kind is not None:
            parts += boundary(rng, kind, piece, sight, shapes, ground)
    return parts


def _fronts(rng: np.random.Generator, edges: list[Edge], ground: Ground) -> list[tuple[shapely.LineString, Edge]]:
    """Return the fronts of plots and the edges that they lie at: around all paved ground, off it along fast roads."""
    found: list[tuple[shapely.LineString, Edge]] = []
    for edge in edges:
        if edge.fast:
            line = edge.beside(edge.plot_m + _FRONT_M, _AROUND_CORNER_M)
            found += [(piece, edge) for piece in plots(rng, line)]
    if not edges:
        return found
    paved = shapely.union_all([ground.road, ground.walk]) & ground.fine
    around = paved.buffer(_FRONT_M, quad_segs=2).simplify(0.1).boundary & ground.fine.buffer(-_FRONT_M - 0.1)
    around -= _street_ends(ground.streets)
    lines = shapely.get_parts(shapely.line_merge(around))
    pieces = [piece for line in lines for piece in plots(rng, line)]
    near = shapely.STRtree([edge.line for edge in edges])
    for piece in pieces:
        row = near.query_nearest(piece.centroid, max_distance=_FRONT_REACH_M, all_matches=False)
        if len(row) and not edges[row[0]].fast:
            found.append((piece, edges[row[0]]))
    return found


def _street_ends(streets: Streets) -> shapely.Geometry:
    """Return the ground ahead of the ends of lanes: the end of a lane in the network is not that of its street."""
    ahead = []
    for lane in streets.lanes:
        for end, before in ((lane.line[0], lane.line[1]), (lane.line[-1], lane.line[-2])):
            way = (end - before) / max(float(np.hypot(*(end - before))), 1e-9)
            ahead.append(shapely.LineString([end, end + 3.0 * _FRONT_M * way]).buffer(0.5 * lane.width + _FRONT_M))
    return shapely.union_all(ahead)


def kerbs(rng: np.random.Generator, edges: list[Edge], density: float, ground: Ground) -> list[MeshPart]:
    """Return low hedges, shrubs and railings between the kerb and the pavement."""
    shapes = shrub_shapes(rng)
    crossed = [shapely.LineString(lane.line) for lane in ground.streets.lanes if lane.kind == "crossing"]
    sight = shapely.union_all([yielding(ground.streets), *crossed])
    shapely.prepare(sight)
    parts: list[MeshPart] = []
    for edge in edges:
        for piece in plots(rng, edge.line):
            kind = drawn(rng, edge.density.kerb, density)
            if kind is not None:
                aside = edge.kerb_m + (-0.35 if kind == "railing" else 0.1)
                kerb = shapely.LineString(offset(np.asarray(piece.coords), edge.side * aside))
                parts += boundary(rng, kind, kerb, sight, shapes, ground, at_kerb=True)
    return parts


def plots(rng: np.random.Generator, line: shapely.LineString) -> list[shapely.LineString]:
    """Return the fronts of the plots along a line, with gaps for doors and drives between them."""
    found, at = [], 0.0
    while at < line.length - _LEAST_FRONT_M:
        end = min(at + float(rng.uniform(6.0, 18.0)), line.length)
        found.append(substring(line, at, end))
        at = end + float(rng.uniform(0.5, 1.6))
    return found


def drawn(rng: np.random.Generator, share_of: dict[str, float], density: float) -> str | None:
    """Return a kind by the shares of all, None for the rest."""
    kinds = list(share_of)
    shares = density * np.array([share_of[kind] for kind in kinds])
    bounds = np.cumsum(shares / max(1.0, float(shares.sum())))
    row = int(np.searchsorted(bounds, rng.uniform(), side="right"))
    return kinds[row] if row < len(kinds) else None


def boundary(
    rng: np.random.Generator,
    kind: str,
    line: shapely.LineString,
    sight: shapely.Geometry,
    shapes: list[MeshPart],
    ground: Ground,
    at_kerb: bool = False,
    height_m: tuple[float, float] | None = None,
) -> list[MeshPart]:
    """Return the boundary of one plot, a low one near `sight`, where drivers look across it.

    Args:
        at_kerb: on a strip of pavement, and as narrow and low as there.
        height_m: range of heights of hedges and shrubs; None for the usual one.
    """
    if kind != "noise" and not ground.is_fine(shapely.get_coordinates(line.centroid))[0]:
        return []
    low = bool(shapely.dwithin(sight, line, _SIGHT_M))
    height = float(rng.uniform(*HEIGHT_M.get(kind, height_m or (1.6, 2.4))))
    if low and kind in ("noise", "boards"):
        return []
    height = min(height, float(rng.uniform(*_LOW_M))) if low else height
    width = float(rng.uniform(*_WIDTH_M[kind])) if kind in _WIDTH_M else THICK_M[kind]
    if at_kerb:
        width = min(width, 0.7)
        height = min(height, float(rng.uniform(0.9, 1.6))) if height_m is None else height
    half = 0.5 * width + (HEDGE_TIPS_M if kind == "hedge" else 0.0)
    parts: list[MeshPart] = []
    for piece in ground.take_line(line, half, at_kerb=at_kerb, tall=height > 2.2):
        if kind == "hedge":
            parts += hedge(rng, piece, height, width, ground.streets)
        elif kind == "shrubs":
            parts += _shrub_row(rng, piece, height, width, shapes, ground)
        else:
            parts += fence(rng, kind, piece, height, ground.streets)
    return parts


def shrub_shapes(rng: np.random.Generator, count: int = 20) -> list[MeshPart]:
    """Return shrubs of 1 m in radius and height, to be scaled."""
    return [shrub(rng, count) for _ in range(_SHRUB_VARIANTS)]


def _shrub_row(
    rng: np.random.Generator,
    line: shapely.LineString,
    height: float,
    width: float,
    shapes: list[MeshPart],
    ground: Ground,
) -> list[MeshPart]:
    along = np.arange(0.5 * width, line.length - 0.3, 0.9 * width)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    size = rng.uniform(0.75, 1.0, (len(xy), 2)) * [0.5 * width, height]
    return shrubs_at(rng, xy, size, shapes, ground)


def shrubs_at(
    rng: np.random.Generator, xy: Array, size: Array, shapes: list[MeshPart], ground: Ground
) -> list[MeshPart]:
    """Return shrubs of (N, 2) radii and heights at (N, 2) positions."""
    if not len(xy):
        return []
    z = ground.streets.height(xy)
    return [
        move(
            shapes[int(rng.integers(len(shapes)))],
            [*here, foot],
            float(rng.uniform(0.0, 2.0 * np.pi)),
            [radius, radius, height],
        )
        for here, foot, (radius, height) in zip(xy, z, size, strict=True)
    ]
