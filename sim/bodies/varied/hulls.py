"""Hulls of road users: closed solids through cross-sections, panels and pillars, of few triangles."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.mesh.solids import MeshPart, box, mesh_part, tube

Point = tuple[float, float, float]


def loft(sections: ArrayLike, material: str) -> MeshPart:
    """Return the closed solid through (S, K, 3) convex sections of equal corners, capped at both ends."""
    rings = np.asarray(sections, np.float64)
    count, k, _ = rings.shape
    here, there = np.arange(k), np.roll(np.arange(k), -1)
    fan = np.column_stack([np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)])
    faces = [fan[:, ::-1], fan + (count - 1) * k]
    for row in range(count - 1):
        a, b, c, d = here + row * k, there + row * k, here + (row + 1) * k, there + (row + 1) * k
        faces += [np.column_stack([a, b, d]), np.column_stack([a, d, c])]
    return _outwards(rings.reshape(-1, 3), np.concatenate(faces), material)


def hull(stations: Sequence[tuple[float, float, float, float, float]], material: str, crease: float = 0.10) -> MeshPart:
    """Return a body through stations along x: (x, half width, bottom, shoulder, top), narrower above the shoulder.

    Args:
        crease: how much narrower the top is than the shoulder on each side, m.
    """
    sections = [
        [
            (x, -half, low),
            (x, half, low),
            (x, half, shoulder),
            (x, max(half - crease, 0.5 * half), top),
            (x, -max(half - crease, 0.5 * half), top),
            (x, -half, shoulder),
        ]
        for x, half, low, shoulder, top in stations
    ]
    return loft(sections, material)


def panel(corners: Sequence[Point], thickness: float, material: str) -> MeshPart:
    """Return the closed panel of a quadrilateral, its corners in order, thick towards the middle plane y = 0."""
    outer = np.asarray(corners, np.float64)
    normal = np.cross(outer[2] - outer[0], outer[3] - outer[1])
    normal /= max(float(np.linalg.norm(normal)), 1e-9)
    towards = np.array([0.0, 0.0, 0.6]) - outer.mean(axis=0)
    towards[0] *= 0.5
    inward = normal * (1.0 if normal @ towards > 0.0 else -1.0) * thickness
    return loft([outer, outer + inward], material)


def post(start: Point, end: Point, material: str, half: float = 0.045) -> MeshPart:
    """Return a square bar from one point to another."""
    return tube(start, end, (half, half), material, 4)


def both(corners: Sequence[Point], thickness: float, material: str) -> list[MeshPart]:
    """Return a panel and its mirror image on the other side."""
    return [panel([(x, side * y, z) for x, y, z in corners], thickness, material) for side in (1.0, -1.0)]


def pair(low: Point, high: Point, material: str) -> list[MeshPart]:
    """Return a box on the left, of positive y, and its mirror image."""
    return [box(low, high, material), box((low[0], -high[1], low[2]), (high[0], -low[1], high[2]), material)]


def wheels(axles: Sequence[float], half_width: float, radius: float, width: float = 0.22) -> list[MeshPart]:
    """Return a tyre with a disc of metal on each side of each axle, standing on the road."""
    parts = []
    for x in axles:
        for side in (1.0, -1.0):
            inner, outer = side * (half_width - width), side * half_width
            parts.append(tube((x, inner, radius), (x, outer, radius), (radius, radius), "tyre", 14))
            hub = side * (half_width + 0.012)
            parts.append(tube((x, inner, radius), (x, hub, radius), (0.62 * radius, 0.55 * radius), "metal", 8))
    return parts


def seat(x: float, y: float, floor: float, top: float, width: float, *, head: bool = True) -> list[MeshPart]:
    """Return a seat that faces forward: cushion, back and head rest; `x` is the front of its back."""
    half, hip = 0.5 * width, floor + 0.55 * (top - floor) * 0.62
    lean = 0.22 * (top - hip)
    back = loft(
        [
            [(x, y - half, hip), (x, y + half, hip), (x - 0.12, y + half, hip), (x - 0.12, y - half, hip)],
            [
                (x - lean, y - half, top),
                (x - lean, y + half, top),
                (x - lean - 0.09, y + half, top),
                (x - lean - 0.09, y - half, top),
            ],
        ],
        "seat",
    )
    parts = [box((x - 0.05, y - half, hip - 0.14), (x + 0.48, y + half, hip), "seat"), back]
    if head:
        parts.append(box((x - lean - 0.10, y - 0.13, top + 0.02), (x - lean, y + 0.13, top + 0.19), "seat"))
    return parts


def lamps(front: float, rear: float, half: float, at: tuple[float, float]) -> list[MeshPart]:
    """Return head lamps at x = `front`, tail lamps at x = `rear`, and a plate on each end.

    Args:
        half: half width of the body at its ends, m.
        at: height of head and tail lamps, m.
    """
    parts = pair((front - 0.20, half - 0.36, at[0] - 0.07), (front + 0.008, half - 0.02, at[0] + 0.06), "head_lamp")
    parts += pair((rear - 0.008, half - 0.28, at[1] - 0.08), (rear + 0.12, half - 0.01, at[1] + 0.08), "tail_lamp")
    parts.append(box((front - 0.03, -0.26, 0.38), (front + 0.012, 0.26, 0.49), "plate"))
    parts.append(box((rear - 0.012, -0.26, at[1] - 0.16), (rear + 0.03, 0.26, at[1] - 0.05), "plate"))
    return parts


def _outwards(vertices: NDArray[np.float64], faces: NDArray[np.int64], material: str) -> MeshPart:
    """Return a closed solid whose faces look outwards, whichever way they were given."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum()
    return mesh_part(vertices, faces if volume >= 0.0 else faces[:, ::-1], material)
