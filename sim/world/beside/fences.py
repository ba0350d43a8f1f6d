"""Fences, walls, railings and noise barriers along lines.

Garden walls and fences are 0.8 to 2 m high (building codes of the German states, such as BauO NRW §6: up to 2 m at
boundaries), pickets 0.06 to 0.1 m wide; railings 1.0 m high with bars at most 0.12 m apart (DIN 18065); noise barriers
2 to 5 m high between posts 4 m apart (ZTV-Lsw 22).
"""

from itertools import pairwise

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.solids import MeshPart, join, mesh_part, slab
from sim.world.beside.plants import beside_line
from sim.world.roads.streets import Streets

HEIGHT_M = {
    "picket": (0.8, 1.3),
    "boards": (1.5, 1.9),
    "mesh": (1.0, 1.8),
    "wall": (1.0, 2.1),
    "railing": (0.9, 1.1),
    "noise": (2.0, 4.5),
}
"""Range of heights by kind of fence, m."""

THICK_M = {"picket": 0.06, "boards": 0.06, "mesh": 0.06, "wall": 0.24, "railing": 0.06, "noise": 0.24}
"""Thickness with its posts by kind of fence, m."""

_POST_EVERY_M = {"picket": 2.2, "boards": 2.0, "mesh": 2.5, "wall": 6.0, "railing": 2.0, "noise": 4.0}
_SOLID = {"boards": ("bark", 0.03), "wall": ("brick", 0.2), "noise": ("concrete", 0.12)}
_COPING_M = 0.06
_UPRIGHTS = {"picket": (0.16, 0.09, "bark"), "railing": (0.14, 0.03, "metal")}
_RAILS = {"picket": (0.09, "bark"), "mesh": (0.05, "metal"), "railing": (0.06, "metal")}


def fence(
    rng: np.random.Generator, kind: str, line: shapely.LineString, height_m: float, streets: Streets
) -> list[MeshPart]:
    """Return a fence of a kind of `HEIGHT_M` along a line."""
    parts = [posts(line, _POST_EVERY_M[kind], height_m + 0.05, THICK_M[kind], _material(kind), streets)]
    if kind in _SOLID:
        material, thick = _SOLID[kind]
        material = "concrete" if kind == "wall" and rng.uniform() < 0.4 else material
        parts.append(_panel(line, thick, height_m, material, streets))
        if kind == "wall":
            parts.append(_panel(line, THICK_M[kind], height_m, material, streets, height_m - _COPING_M))
        return parts
    wide, material = _RAILS[kind]
    for top in (height_m, 0.5 * height_m) if kind == "mesh" else (0.9 * height_m, 0.3 * height_m):
        parts.append(_panel(line, 0.04, top, material, streets, top - wide))
    if kind in _UPRIGHTS:
        every, across, material = _UPRIGHTS[kind]
        parts.append(_uprights(line, every, across, height_m, material, streets))
    return parts


def _material(kind: str) -> str:
    return {"picket": "bark", "boards": "bark", "wall": "brick", "noise": "concrete"}.get(kind, "metal")


def _panel(
    line: shapely.LineString, thick_m: float, top_m: float, material: str, streets: Streets, low_m: float = -0.3
) -> MeshPart:
    band = line.buffer(0.5 * thick_m, cap_style="flat", join_style="mitre", mitre_limit=2.0)
    return slab(streets.terrain.follow(band), streets.height, top_m, material, material, -low_m)


def _uprights(
    line: shapely.LineString, every_m: float, wide_m: float, height_m: float, material: str, streets: Streets
) -> MeshPart:
    """Return flat upright bars, with gaps for rays."""
    along = np.arange(0.5 * every_m, line.length, every_m)
    left, right = (beside_line(line, along + step, np.zeros(len(along))) for step in (-0.5 * wide_m, 0.5 * wide_m))
    return quads(_upright(left, right, streets, 0.05, height_m), material)


def _upright(left: Array, right: Array, streets: Streets, low_m: float, high_m: float) -> Array:
    """Return (N, 4, 3) corners of upright quads between (N, 2) feet."""
    feet = np.stack([left, right, right, left], axis=1)
    ground = streets.height(0.5 * (left + right))[:, None] + np.array([low_m, low_m, high_m, high_m])
    return np.concatenate([feet, ground[..., None]], axis=2)


def quads(corners: Array, material: str) -> MeshPart:
    """Return two triangles for each of (N, 4, 3) quads."""
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])
    return mesh_part(corners.reshape(-1, 3), faces, material)


def posts(
    line: shapely.LineString, every_m: float, height_m: float, thick_m: float, material: str, streets: Streets
) -> MeshPart:
    """Return square posts along a line, its ends included."""
    along = np.linspace(0.0, line.length, 2 + int(line.length / every_m))
    half = np.full(len(along), 0.5 * thick_m)
    corners = [beside_line(line, along + step, aside) for step, aside in
               ((-half[0], -half), (half[0], -half), (half[0], half), (-half[0], half))]  # fmt: skip
    around = [*corners, corners[0]]
    sides = [_upright(a, b, streets, -0.3, height_m) for a, b in pairwise(around)]
    top = np.stack([side[:, 3] for side in sides], axis=1)
    return join([quads(np.concatenate([*sides, top]), material)])
