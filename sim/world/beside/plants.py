"""Hedges, shrubs and grass.

Hedges are 0.8 to 2 m high and 0.6 to 1 m thick, as RASt 06 and the neighbour laws of the German states have them at
boundaries (up to 2 m at 0.5 m); beams enter them by one to four decimetres. Shrubs of verges and gardens (Spiraea,
Cornus, Rosa, Buxus: FLL, Guetebestimmungen fuer Baumschulpflanzen) are 0.5 to 3 m high. Grass of verges that are mown
twice a year stands 0.3 to 0.8 m high (RSBB / Merkblatt fuer den Strassenbetriebsdienst, Gruenpflege).
"""

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import Height, MeshPart, join, mesh_part, move, slab
from sim.world.beside.foliage import in_ellipsoid, leaves
from sim.world.roads.streets import Streets

_LEAF_M2 = 0.12
_TIP_M = 0.15
HEDGE_TIPS_M = 0.25
"""How far single leaves stand out of a hedge at most, m."""

_LEAVES_PER_M2 = 7.0
_DEPTH_M = 0.30
"""How deep beams enter a hedge, m: beyond lies its wood and dead leaves."""

_BLADES = 6

_CORE = mesh_part(
    [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
    [[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)],
    "hedge",
)
"""Octahedron of radius 1: the wood and dead leaves within a shrub."""


def hedge(
    rng: np.random.Generator, line: shapely.LineString, height_m: float, width_m: float, streets: Streets
) -> list[MeshPart]:
    """Return a hedge along a line: a dense core in a coat of leaves."""
    half = 0.5 * width_m
    core = line.buffer(max(half - _DEPTH_M - 0.05, 0.06), cap_style="flat", join_style="mitre", mitre_limit=2.0)
    top = max(height_m - _DEPTH_M, 0.3)
    parts = [slab(streets.terrain.follow(core), streets.height, top, "hedge", "hedge", 0.3)]
    count = max(4, int(line.length * (2.0 * height_m + width_m) * _LEAVES_PER_M2))
    on_top = rng.uniform(size=count) < width_m / (2.0 * height_m + width_m)
    deep = (_DEPTH_M - 0.1) * rng.uniform(0.0, 1.0, count)
    side = np.where(rng.uniform(size=count) < 0.5, 1.0, -1.0)
    aside = np.where(on_top, (half - _TIP_M) * rng.uniform(-1.0, 1.0, count), side * (half - _TIP_M - deep))
    up = np.where(on_top, height_m - _TIP_M - deep, rng.uniform(0.1, height_m, count))
    xy = beside_line(line, rng.uniform(0.0, line.length, count), aside)
    middle = np.column_stack([xy, streets.height(xy) + up])
    return [*parts, leaves(rng, middle, rng.uniform(0.6, 1.4, count) * _LEAF_M2, "hedge")]


def beside_line(line: shapely.LineString, along: Array, aside: Array) -> Array:
    """Return (N, 2) points at distances along a line and to its left, m."""
    here = shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(along - 0.1, 0.0, line.length)))
    there = shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(along + 0.1, 0.0, line.length)))
    way = (there - here) / np.maximum(np.hypot(*(there - here).T), 1e-9)[:, None]
    return 0.5 * (here + there) + aside[:, None] * np.column_stack([-way[:, 1], way[:, 0]])


def shrub(rng: np.random.Generator, count: int) -> MeshPart:
    """Return a shrub of 1 m in radius and height at the origin: a dense core and `count` leaves around it."""
    center, radii = np.array([0.0, 0.0, 0.5]), np.array([1.0, 1.0, 0.5])
    core = move(_CORE, [0.0, 0.0, 0.42], float(rng.uniform(0.0, 1.5)), 0.55 * radii)
    area = 0.9 * 4.0 * np.pi * 0.5 / count
    coat = leaves(
        rng, in_ellipsoid(rng, count, center, 0.85 * radii, 0.6), rng.uniform(0.6, 1.4, count) * area, "hedge"
    )
    out = np.hypot(*coat.vertices[:, :2].T)
    coat.vertices[:, :2] *= np.minimum(1.0, 1.0 / np.maximum(out, 1e-9))[:, None]
    return join([core, coat])


def grass(rng: np.random.Generator, xy: Array, height: Height) -> MeshPart:
    """Return tufts of long grass and herbs at (N, 2) positions, each of some upright blades."""
    root = np.repeat(xy, _BLADES, axis=0) + rng.normal(0.0, 0.18, (_BLADES * len(xy), 2))
    count = len(root)
    foot = height(root) if count else np.zeros(0)
    angle, half = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.05, 0.14, count)
    across = half[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    tall = np.repeat(rng.uniform(0.3, 0.75, len(xy)), _BLADES) * rng.uniform(0.6, 1.15, count)
    lean = rng.normal(0.0, 0.15, (count, 2))
    low = foot - 0.1
    corners = np.stack(
        [
            np.column_stack([root - across, low]),
            np.column_stack([root + across, low]),
            np.column_stack([root + lean, foot + tall]),
        ],
        axis=1,
    )
    return mesh_part(corners, np.arange(3 * count), "hedge")
