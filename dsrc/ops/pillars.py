"""Voxeliser: points to pillars (or cubes) in first-come order, as the released pipeline's compiled one does."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dsrc.ops.pillars_kernel import sort_voxels


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Voxels of a cloud of P points; V voxels in the order of their first points.

    Attributes:
        order: (K,) int64 rows of the kept points, voxel by voxel, in a voxel in order of arrival. Dropped are points
            out of range, beyond the cap of their voxel, or in a voxel that came after the cap on voxels.
        coords_zyx: (V, 3) int64 cell indices.
        count: (V,) int64 points kept in the voxel.
    """

    order: NDArray[np.int64]
    coords_zyx: NDArray[np.int64]
    count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.count)


def grid_shape(range_m: ArrayLike, cell_xyz: ArrayLike) -> NDArray[np.int64]:
    """Return the (3,) number of cells along x, y and z of a range (6,) with cells (3,), both in metres."""
    range_m, cell = np.asarray(range_m, np.float64), np.asarray(cell_xyz, np.float64)
    return np.rint((range_m[3:] - range_m[:3]) / cell).astype(np.int64)


def voxelise(
    points: NDArray[np.float32],
    range_m: ArrayLike,
    cell_xyz: ArrayLike,
    max_points: int = 32,
    max_voxels: int = 70_000,
) -> Voxels:
    """Sort points into voxels, first come, first served.

    Lower faces of the range belong to it, upper faces do not; cells are float32 quotients, rounded down. A voxel keeps
    its first `max_points` points. After `max_voxels` voxels no new one is opened, the open ones still fill. Points
    that are not finite are out of range.

    Args:
        points: (P, D) float32, D >= 3, xyz first, m.
        range_m: (6,) x_min, y_min, z_min, x_max, y_max, z_max, m.
        cell_xyz: (3,) sides of a voxel, m.

    Raises:
        ValueError: points are not (P, 3 or more).
    """
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"voxelise: points must have shape (P, D >= 3), got {points.shape}")
    shape = grid_shape(range_m, cell_xyz)
    low, size = np.asarray(range_m, np.float32)[:3], np.asarray(cell_xyz, np.float32)
    order, cells, count = sort_voxels(points, low, size, shape, max_points, max_voxels)
    return Voxels(order, np.stack(np.unravel_index(cells, shape[::-1]), axis=1), count)
