"""Foliage: leaves as small triangles in random attitudes, between which rays pass.

A ray through leaves of density L (m2 of leaf per m3) meets none along a way s with probability exp(-s L / 2), as
surfaces of random attitude hide half their area. Source: J. Ross, The Radiation Regime and Architecture of Plant Stands
(1981), spherical distribution of leaf angles.
"""

import numpy as np
from numpy.typing import ArrayLike

from sim.geometry import Array
from sim.mesh.solids import MeshPart, mesh_part

_AREA = 0.75 * np.sqrt(3.0)
"""Area of an equilateral triangle on a circle of radius 1."""


def leaf_reach(area_m2: ArrayLike) -> Array:
    """Return how far a leaf's corners lie from its middle, m."""
    return np.sqrt(np.asarray(area_m2, np.float64) / _AREA)


def leaves(rng: np.random.Generator, middle: Array, area_m2: ArrayLike, material: str = "leaves") -> MeshPart:
    """Return a triangle in a random attitude at each of (N, 3) positions.

    Args:
        area_m2: of each triangle, one number or (N,).
    """
    count = len(middle)
    first = _directions(rng, count)
    second = np.cross(first, _directions(rng, count))
    second /= np.maximum(np.linalg.norm(second, axis=1), 1e-9)[:, None]
    angle = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    around = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    reach = np.broadcast_to(leaf_reach(area_m2), (count,))
    return mesh_part(middle[:, None] + reach[:, None, None] * around, np.arange(3 * count), material)


def in_ellipsoid(rng: np.random.Generator, count: int, center: ArrayLike, radii: ArrayLike, inner: float) -> Array:
    """Return (count, 3) random positions in an ellipsoid, beyond `inner` of its radii: most leaves grow outside."""
    share = rng.uniform(inner**3, 1.0, (count, 1)) ** (1.0 / 3.0)
    return np.asarray(center, np.float64) + _directions(rng, count) * share * np.asarray(radii, np.float64)


def in_cone(rng: np.random.Generator, count: int, low_m: float, high_m: float, radius_m: float) -> Array:
    """Return (count, 3) random positions in an upright cone about z, most of them near its mantle."""
    down = rng.uniform(0.0, 1.0, count) ** 0.5
    angle, out = rng.uniform(0.0, 2.0 * np.pi, count), radius_m * down * rng.uniform(0.25, 1.0, count) ** 0.5
    return np.column_stack([out * np.cos(angle), out * np.sin(angle), high_m - down * (high_m - low_m)])


def _directions(rng: np.random.Generator, count: int) -> Array:
    way = rng.normal(size=(count, 3))
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
