"""Ground points of a sweep: by material, or by a plane fitted below the sensor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import UNKNOWN_MATERIAL, Sweep
from sim.mesh.materials import material_index

MATERIALS_OF_GROUND = tuple(
    material_index(name) for name in ("asphalt", "marking", "pavement", "kerb", "gravel", "ground")
)

_NEAR_M = 40.0
_LEAST_BELOW_M = 0.3
_LEVEL_BIN_M = 0.1
_STEEPEST = 0.3
_SEARCH = ((0.2, 0.6), (0.4, 0.5), (0.7, 0.4), (1.0, 0.3), (1.0, 0.2), (1.0, 0.2))
_LEAST_WIDTH_M = 0.5
_THICKNESS_M, _THICKNESS_PER_M = 0.15, 0.005
_LEAST_POINTS, _LEAST_SHARE = 30, 0.02
_MOST_POINTS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Ground points of a sweep.

    Attributes:
        rows: (G,) rows of the points.
        cosine: (G,) float32 |cos| of the angle between ray and ground, in [0, 1].
    """

    rows: NDArray[np.intp]
    cosine: NDArray[np.float32]


def find_ground(sweep: Sweep) -> Ground:
    """Return the ground points of a sweep, empty where no ground is found.

    Without materials it is searched below the sensor, within 40 m: the most frequent height of the nearest points, then
    the plane through points near it, farther and farther out and in narrowing bands. Refused are planes steeper than 17
    degrees, less than 0.3 m below the sensor, narrow as the foot of a wall or with few points. Points on objects are
    excluded.
    """
    if (sweep.material != UNKNOWN_MATERIAL).any():
        table = np.zeros(UNKNOWN_MATERIAL + 1, bool)
        table[list(MATERIALS_OF_GROUND)] = True
        rows = np.flatnonzero(table[sweep.material])
        cosine = sweep.cosine[rows]
        if not cosine.all():
            points = sweep.points[rows]
            cosine = np.where(cosine > 0.0, cosine, _incidence(points, _plane(points)))
        return Ground(rows, cosine)
    rows = np.flatnonzero(sweep.object_id < 0)
    points = sweep.points[rows]
    plane = _plane(points)
    if plane is None:
        return Ground(rows[:0], np.zeros(0, np.float32))
    near = np.hypot(points[:, 0], points[:, 1])
    above = points @ np.array([-plane[0], -plane[1], 1.0], np.float32) - np.float32(plane[2])
    on = np.flatnonzero(np.abs(above) < _THICKNESS_M + _THICKNESS_PER_M * near)
    return Ground(rows[on], _incidence(points[on], plane))


def _incidence(points: NDArray[np.float32], plane: NDArray[np.float64] | None) -> NDArray[np.float32]:
    """Return (G,) cosines of incidence of (G, 3) points on a plane, on level ground without one."""
    a, b, _ = np.zeros(3) if plane is None else plane
    normal = (np.array([-a, -b, 1.0]) / np.sqrt(1.0 + a * a + b * b)).astype(np.float32)
    reach = np.sqrt(np.einsum("gi,gi->g", points, points))
    return np.minimum(np.abs(points @ normal) / np.maximum(reach, np.float32(1e-6)), np.float32(1.0))


def _plane(points: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """Return (a, b, c) of the ground z = a x + b y + c below the sensor; None without ground."""
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    x, y, z = points.T.astype(np.float64)
    distance = np.hypot(x, y)
    below = np.flatnonzero((distance < _NEAR_M) & (z < -_LEAST_BELOW_M))
    if len(below) < _LEAST_POINTS:
        return None
    below = below[np.argsort(distance[below], kind="stable")]
    near = np.stack([x[below], y[below], np.ones(len(below))], axis=1)
    z = z[below]
    nearest = -z[: max(_LEAST_POINTS, int(_SEARCH[0][0] * len(z)))]
    level = np.convolve(np.bincount((nearest / _LEVEL_BIN_M).astype(np.int64)), np.ones(3), "same")
    plane = np.array([0.0, 0.0, -(level.argmax() + 0.5) * _LEVEL_BIN_M])
    for share, band in _SEARCH:
        some = slice(0, max(_LEAST_POINTS, int(share * len(z))))
        close = np.flatnonzero(np.abs(z[some] - near[some] @ plane) < band)
        if len(close) < _LEAST_POINTS:
            return None
        # A weak prior of level ground for points on one line.
        pull = np.diag([1e-3 * len(close), 1e-3 * len(close), 0.0])
        plane = np.linalg.solve(near[close].T @ near[close] + pull, near[close].T @ z[close])
    width = np.sqrt(np.linalg.eigvalsh(np.cov(near[close, :2].T))[0])
    is_ground = (
        len(close) >= _LEAST_SHARE * len(points)
        and width > _LEAST_WIDTH_M
        and plane[2] < -_LEAST_BELOW_M
        and np.hypot(*plane[:2]) < _STEEPEST
    )
    return plane if is_ground else None
