"""Mesh primitives: closed solids, lifted polygons and strips, with a material per face."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from sim.geometry import Array
from sim.mesh.materials import material_index

if TYPE_CHECKING:
    import trimesh

Height = Callable[[Array], Array]
"""Height field: (N, 2) world positions -> (N,) height of the road, m."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshPart:
    """Triangles with materials.

    Attributes:
        vertices: (V, 3) float64, m.
        faces: (F, 3) int64 rows of `vertices`, counter-clockwise seen from outside.
        material: (F,) uint8 indices into `sim.mesh.materials.MATERIALS`.
    """

    vertices: Array
    faces: NDArray[np.int64]
    material: NDArray[np.uint8]


def mesh_part(vertices: ArrayLike, faces: ArrayLike, material: str) -> MeshPart:
    """Mesh part of one material."""
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    filled = np.full(len(faces), material_index(material), np.uint8)
    return MeshPart(np.asarray(vertices, np.float64).reshape(-1, 3), faces, filled)


def join(parts: Sequence[MeshPart]) -> MeshPart:
    """Concatenate mesh parts; an empty sequence gives an empty part."""
    if not parts:
        return mesh_part(np.zeros((0, 3)), np.zeros((0, 3)), "ground")
    offset = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return MeshPart(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offset, strict=True)]),
        np.concatenate([p.material for p in parts]),
    )


def to_mesh(whole: MeshPart) -> "trimesh.Trimesh":
    """Return the Trimesh of a part, unprocessed, with `face_attributes["material"]`."""
    import trimesh  # takes a second, and bodies that are only drawn do without

    return trimesh.Trimesh(
        vertices=whole.vertices, faces=whole.faces, face_attributes={"material": whole.material}, process=False
    )


def move(part: MeshPart, xyz: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0, scale: ArrayLike = 1.0) -> MeshPart:
    """Scale a mesh part per axis about the origin, rotate it about z and translate it."""
    c, s = np.cos(yaw), np.sin(yaw)
    turned = (part.vertices * np.asarray(scale, np.float64)) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return MeshPart(turned + np.asarray(xyz, np.float64), part.faces, part.material)


def fit(part: MeshPart, size: ArrayLike) -> MeshPart:
    """Scale a mesh part per axis to exactly x and y in [-size / 2, size / 2] and z in [0, size]."""
    size = np.asarray(size, np.float64)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    share = (part.vertices - low) / (high - low)
    return MeshPart((share - np.array([0.5, 0.5, 0.0])) * size, part.faces, part.material)


def box(low: ArrayLike, high: ArrayLike, material: str) -> MeshPart:
    """Return the closed box between two corners."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    profile = np.array([[low[0], low[2]], [high[0], low[2]], [high[0], high[2]], [low[0], high[2]]])
    return prism(profile, low[1], high[1], material)


def prism(profile: ArrayLike, y_low: float, y_high: float, material: str) -> MeshPart:
    """Return the extrusion along y of a convex x-z outline, counter-clockwise in x-z."""
    profile = np.asarray(profile, np.float64)
    n = len(profile)
    rings = [np.column_stack([profile[:, 0], np.full(n, y), profile[:, 1]]) for y in (y_low, y_high)]
    here, there = np.arange(n), np.roll(np.arange(n), -1)
    fan = np.column_stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)])
    # The outline runs counter-clockwise seen from -y, so the cap there keeps its order and the other one turns.
    faces = [fan, fan[:, ::-1] + n, *_band(here, there, here + n, there + n)]
    return mesh_part(np.concatenate(rings), np.concatenate(faces), material)


def _band(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> tuple[NDArray, NDArray]:
    """Return the two triangles of each quad a-b over c-d, facing right of the way from a to b when c is above a."""
    return np.column_stack([a, c, b]), np.column_stack([b, c, d])


def tube(start: ArrayLike, end: ArrayLike, radii: tuple[float, float], material: str, sides: int = 6) -> MeshPart:
    """Return a closed cylinder or cone stump from one point to another.

    Args:
        start: (3,) centre of the first cap, m.
        end: (3,) centre of the last cap, m.
        radii: at the start and at the end, m.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    # Any direction off the axis gives a frame around it.
    first = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    angle = 2.0 * np.pi * np.arange(sides) / sides
    around = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), np.cross(axis, first))
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    fan = np.column_stack([np.zeros(sides - 2, int), np.arange(1, sides - 1), np.arange(2, sides)])
    sides_up = [face[:, ::-1] for face in _band(here, there, here + sides, there + sides)]
    faces = np.concatenate([fan[:, ::-1], fan + sides, *sides_up])
    return mesh_part(np.concatenate([start + radii[0] * around, end + radii[1] * around]), faces, material)


_CORNERS = [[-1, 2, 0], [1, 2, 0], [-1, -2, 0], [1, -2, 0], [0, -1, 2], [0, 1, 2], [0, -1, -2], [0, 1, -2]]
_CORNERS += [[2, 0, -1], [2, 0, 1], [-2, 0, -1], [-2, 0, 1]]
_ICOSAHEDRON = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2]]
_ICOSAHEDRON += [[10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11]]
_ICOSAHEDRON += [[6, 2, 10], [8, 6, 7], [9, 8, 1]]


@lru_cache(maxsize=4)
def _ball(subdivisions: int) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and faces of an icosphere of radius 1, bit for bit those of trimesh, which is slow to import."""
    short, long = 0.5257311121191336, 0.85065080835204
    vertices = np.array([0.0, short, long, -long, -short])[np.array(_CORNERS)]
    faces = np.array(_ICOSAHEDRON, np.int64)
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, first, row = np.unique(edges[:, ::-1], axis=0, return_index=True, return_inverse=True)
        middle = row.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[edges[first]].mean(axis=1)])
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        vertices = _on_unit_sphere(vertices)
    return (vertices if subdivisions else _on_unit_sphere(vertices)), faces


def _on_unit_sphere(vertices: Array) -> Array:
    radius = np.sqrt(np.dot(vertices**2, [1, 1, 1]))[:, None]
    return vertices + vertices / radius * (1.0 - radius)


def ellipsoid(center: ArrayLike, radii: ArrayLike, material: str, subdivisions: int = 1) -> MeshPart:
    """Return a closed ellipsoid along the axes; 1 subdivision is 80 triangles."""
    vertices, faces = _ball(subdivisions)
    return mesh_part(vertices * np.asarray(radii, np.float64) + np.asarray(center, np.float64), faces, material)


def ring(center: ArrayLike, radius: float, thickness: float, material: str, sides: int = 14) -> MeshPart:
    """Return a closed square-section ring in the x-z plane: the tyre and rim of a bicycle."""
    center = np.asarray(center, np.float64)
    angle = 2.0 * np.pi * np.arange(sides) / sides
    half = 0.5 * thickness
    corners = [(radius, -half), (radius, half), (radius - thickness, half), (radius - thickness, -half)]
    loops = [center + np.column_stack([r * np.cos(angle), np.full(sides, y), r * np.sin(angle)]) for r, y in corners]
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    faces: list[NDArray[np.int64]] = []
    for loop in range(4):
        a, b = loop * sides, (loop + 1) % 4 * sides
        faces += _band(here + a, there + a, here + b, there + b)
    return mesh_part(np.concatenate(loops), np.concatenate(faces), material)


def strip(left: Array, right: Array, height: Height, lift_m: float, material: str) -> MeshPart:
    """Return the upward strip between the left and right border lines of a way, (K, 2) each."""
    k = len(left)
    flat = np.concatenate([left, right])
    vertices = np.column_stack([flat, height(flat) + lift_m])
    row = np.arange(k - 1)
    faces = np.concatenate([np.column_stack([row, row + k, row + k + 1]), np.column_stack([row, row + k + 1, row + 1])])
    return mesh_part(vertices, faces, material)


def rings_of(shape: shapely.Geometry) -> list[shapely.Polygon]:
    """Return the polygons of any geometry, without slivers under 1 cm^2."""
    return [p for p in shapely.get_parts(shape) if p.geom_type == "Polygon" and p.area > 1e-4]


def carpet(shape: shapely.Geometry, height: Height, lift_m: float, material: str) -> MeshPart:
    """Return the triangulated surface of polygons, `lift_m` above the road."""
    parts = []
    for polygon in rings_of(shape):
        flat, faces = _triangles(polygon)
        parts.append(mesh_part(np.column_stack([flat, np.full(len(flat), lift_m)]), faces, material))
    whole = join(parts)
    whole.vertices[:, 2] += height(whole.vertices[:, :2])
    return whole


def slab(
    shape: shapely.Geometry,
    height: Height,
    top_m: float,
    wall: str,
    top: str,
    depth_m: float = 0.0,
    upper: shapely.Geometry | None = None,
    lower: Height | None = None,
) -> MeshPart:
    """Return extruded polygons without a floor: kerbs, walls, blocks.

    Args:
        shape: outline in the world, m.
        top_m: of the upper face above the road.
        top: material of the upper face.
        depth_m: how far the sides reach below the road.
        upper: the outline in parts that the upper face is made of; left out: the outline itself.
        lower: height field below which the sides reach; left out: the same.
    """
    parts = [carpet(shape if upper is None else upper, height, top_m, top)]
    for polygon in rings_of(shape):
        polygon = shapely.geometry.polygon.orient(polygon)
        for line in (polygon.exterior, *polygon.interiors):
            around = np.asarray(line.coords)[:, :2]
            base = height(around)
            foot = base if lower is None else lower(around)
            k = np.arange(len(around) - 1)
            vertices = np.concatenate(
                [np.column_stack([around, foot - depth_m]), np.column_stack([around, base + top_m])]
            )
            faces = _band(k, k + 1, k + len(around), k + 1 + len(around))
            # Outlines run with the inside on their left, so the right of the way is outside.
            parts.append(mesh_part(vertices, np.concatenate(faces)[:, ::-1], wall))
    return join(parts)


def _triangles(polygon: shapely.Polygon) -> tuple[Array, NDArray[np.int64]]:
    """Return (V, 2) vertices and upward (F, 3) faces of one polygon."""
    corners = shapely.get_coordinates(polygon)
    if len(corners) == 4:
        # A triangle, as most parts of uneven ground are: what earcut makes of it, in a tenth of the time.
        (ax, ay), (bx, by), (cx, cy), _ = corners.tolist()
        left = (bx - ax) * (cy - ay) > (by - ay) * (cx - ax)
        return corners, np.array([[2, 0, 1] if left else [1, 3, 2]], np.int64)
    import trimesh

    flat, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
    flat, faces = np.asarray(flat, np.float64)[:, :2], np.asarray(faces, np.int64)
    a, b, c = (flat[faces[:, k]] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    return flat, faces[np.abs(turn) > 1e-9]
