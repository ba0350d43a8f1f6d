"""Voxeliser: points to pillars (or cubes) in first-come order, as the released pipeline's compiled one does.

Compiled loops over the points of a cloud: voxels in first-come order, sums of cells, maxima of pillars.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.compiled import compiled

Cells = NDArray[np.int64]


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
    range_m = np.asarray(range_m, np.float64)
    shape = np.rint((range_m[3:] - range_m[:3]) / np.asarray(cell_xyz, np.float64)).astype(np.int64)
    low, size = np.asarray(range_m, np.float32)[:3], np.asarray(cell_xyz, np.float32)
    order, cells, count = sort_voxels(points, low, size, shape, max_points, max_voxels)
    return Voxels(order, np.stack(np.unravel_index(cells, shape[::-1]), axis=1), count)


@compiled()
def sort_voxels(
    points: NDArray[np.float32],
    low: NDArray[np.floating],
    size: NDArray[np.floating],
    shape: Cells,
    max_points: int,
    max_voxels: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Sort points into voxels in first-come order; see `dsrc.ops.pillars.voxelise`.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        low: (3,) float32 lower corner of the range.
        size: (3,) float32 sides of a voxel.
        shape: (3,) int64 voxels along x, y and z.

    Returns:
        (K,) int64 rows of the kept points, voxel by voxel; (V,) int64 flat cells of the voxels in z, y, x order and
        (V,) int64 numbers of their points.
    """
    opened = 0
    voxel_at = np.full(shape[0] * shape[1] * shape[2], -1, np.int32)
    cells = np.zeros(min(len(points), max_voxels), np.int64)
    count = np.zeros(len(cells), np.int64)
    voxel_of = np.full(len(points), -1, np.int32)
    for point in range(len(points)):
        x = np.floor((points[point, 0] - low[0]) / size[0])
        y = np.floor((points[point, 1] - low[1]) / size[1])
        z = np.floor((points[point, 2] - low[2]) / size[2])
        if not (x >= 0 and x < shape[0] and y >= 0 and y < shape[1] and z >= 0 and z < shape[2]):
            continue
        cell = (np.int64(z) * shape[1] + np.int64(y)) * shape[0] + np.int64(x)
        voxel = voxel_at[cell]
        if voxel < 0:
            if opened == max_voxels:
                continue
            voxel = np.int32(opened)
            voxel_at[cell] = voxel
            cells[opened] = cell
            opened += 1
        if count[voxel] < max_points:
            voxel_of[point] = voxel
            count[voxel] += 1
    place = np.cumsum(count[:opened]) - count[:opened]
    order = np.zeros(count.sum(), np.int64)
    for point in range(len(points)):
        voxel = voxel_of[point]
        if voxel >= 0:
            order[place[voxel]] = point
            place[voxel] += 1
    return order, cells[:opened], count[:opened]


@compiled()
def sum_cells(
    points: NDArray[np.float32], low: NDArray[np.floating], size: NDArray[np.floating], shape: Cells
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Sum the points of each cell; points beyond the range count in its outermost cells.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        low: (3,) float64 lower corner of the range.
        size: (3,) float64 sides of a cell.
        shape: (3,) int64 cells along x, y and z.

    Returns:
        (V,) int64 flat cells with a point, in z, y, x order, ascending; (V,) int64 numbers of their points and (V, 3)
        float64 their sums.
    """
    found = 0
    row_of = np.full(shape[0] * shape[1] * shape[2], -1, np.int32)
    # Sums of a row for each cell with points stay in a processor's cache, those of all cells do not.
    count = np.zeros(min(len(points), len(row_of)), np.int64)
    sums = np.zeros((len(count), 3))
    for point in range(len(points)):
        cell = 0
        for axis in (2, 1, 0):
            place = (np.float64(points[point, axis]) - low[axis]) / size[axis]
            # A comparison with NaN is false: a NaN counts in the first cell, not outside of the arrays.
            place = place if place > 0.0 else 0.0
            cell = cell * shape[axis] + np.int64(min(place, np.float64(shape[axis] - 1)))
        row = row_of[cell]
        if row < 0:
            row = np.int32(found)
            row_of[cell] = row
            found += 1
        count[row] += 1
        for axis in range(3):
            sums[row, axis] += np.float64(points[point, axis])
    cells = np.flatnonzero(row_of >= 0)
    rows = row_of[cells]
    return cells, count[rows], sums[rows]


@compiled(fastmath={"contract"})
def pillar_maxima(
    points: NDArray[np.float32], count: NDArray[np.int64], centre: NDArray[np.float32], weight: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the (V, C) float32 maxima of a linear layer over the points of each pillar.

    The layer reads a point's own D features, its offset to the mean of the pillar's points, and that to the pillar's
    centre. Around the centre these are one matrix for the point and one sum for the pillar.

    Args:
        points: (P, D) float32 x, y, z, intensity(, paint), pillar by pillar; D is 4 or 5.
        count: (V,) int64 points of each pillar, at least 1.
        centre: (V, 3) float32 centres of the pillars.
        weight: (D + 6, C) float32.
    """
    features, channels = points.shape[1], weight.shape[1]
    by_mean, by_centre = weight[features : features + 3], weight[features + 3 :]
    near = weight[:3] + by_mean + by_centre
    glow = weight[3]
    paint = weight[4] if features > 4 else np.zeros(channels, np.float32)
    maxima = np.full((len(count), channels), -np.inf, np.float32)
    first = 0
    for pillar in range(len(count)):
        after = first + count[pillar]
        x0, y0, z0 = centre[pillar, 0], centre[pillar, 1], centre[pillar, 2]
        x_sum, y_sum, z_sum = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        best = maxima[pillar]
        for point in range(first, after):
            x, y, z = points[point, 0] - x0, points[point, 1] - y0, points[point, 2] - z0
            bright, painted = points[point, 3], points[point, features - 1]
            x_sum += x
            y_sum += y
            z_sum += z
            for c in range(channels):
                value = near[0, c] * x + near[1, c] * y + near[2, c] * z + glow[c] * bright + paint[c] * painted
                best[c] = value if value > best[c] else best[c]
        share = np.float32(1.0) / np.float32(count[pillar])
        x, y, z = x_sum * share, y_sum * share, z_sum * share
        for c in range(channels):
            best[c] += weight[0, c] * x0 + weight[1, c] * y0 + weight[2, c] * z0
            best[c] -= by_mean[0, c] * x + by_mean[1, c] * y + by_mean[2, c] * z
        first = after
    return maxima
