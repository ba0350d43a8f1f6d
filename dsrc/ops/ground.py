"""Surface of the ground below a sweep: heights in square cells, fitted to its lowest points.

The lowest twentieth of the points of a cell is its ground, unless a neighbour lies much lower: then the cell holds a
roof, a bonnet or a crown. What is left is smoothed, and holes take the height of the nearest cell that is known. The
same for simulated and for real clouds; no plane is assumed, so slopes and dips stay in it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, minimum_filter

CELL_M = 2.0
REACH_M = 80.0
"""Half the side of the square that is fitted, m; beyond it the heights of its border hold."""

_QUANTILE = 0.05
_FEWEST = 4
"""Fewest points of a cell whose lowest are taken for ground."""
_STEP_M = 0.4
"""Height over the lowest neighbour from which on a cell holds something that stands."""
_SMOOTH_M = 3.0
"""Standard deviation of the smoothing."""
_LEAST_WEIGHT = 0.05
"""Least smoothed share of known cells at a cell that counts as known itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Heights of the ground in the frame of the points that it was fitted to.

    Attributes:
        heights: (n, n) float64 heights at the centres of the cells, rows along x, m; holes are filled.
        known: (n, n) whether points near by lie on the ground of a cell.
        cell_m: side of a cell.
    """

    heights: NDArray[np.float64]
    known: NDArray[np.bool_]
    cell_m: float = CELL_M

    def at(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (P,) heights at (P, 2) places, m: linear between the centres of cells."""
        return map_coordinates(self.heights, self._cells(xy), order=1, mode="nearest")

    def knows(self, xy: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (P,) whether the ground is known at (P, 2) places, and not filled in."""
        rows, columns = np.rint(self._cells(xy)).astype(np.intp).clip(0, len(self.heights) - 1)
        return self.known[rows, columns]

    def _cells(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (2, P) places in cells from the centre of the first."""
        return np.asarray(xy[:, :2], np.float64).T / self.cell_m + 0.5 * (len(self.heights) - 1)


def fit_ground(points: NDArray[np.floating], reach_m: float = REACH_M) -> Ground:
    """Return the ground below points (P, 3 or more: x, y, z, m) around the origin; flat at 0 without any ground."""
    side = 2 * int(np.ceil(reach_m / CELL_M))
    lowest = _lowest(points, side)
    around = minimum_filter(np.where(np.isfinite(lowest), lowest, np.inf), 3)
    ground = np.isfinite(lowest) & (lowest < around + _STEP_M)
    if not ground.any():
        return Ground(np.zeros((side, side)), np.zeros((side, side), bool))
    sigma = _SMOOTH_M / CELL_M
    weight = gaussian_filter(ground.astype(np.float64), sigma)
    known = weight > _LEAST_WEIGHT
    heights = gaussian_filter(np.where(ground, lowest, 0.0), sigma) / np.maximum(weight, 1e-9)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return Ground(heights[tuple(nearest)], known)


def _lowest(points: NDArray[np.floating], side: int) -> NDArray[np.float64]:
    """Return (n, n) the low quantile of heights in each cell; NaN for cells with too few points."""
    inside = np.all(np.abs(points[:, :2]) < 0.5 * side * CELL_M, axis=1) & np.isfinite(points[:, 2])
    cell = np.floor(points[inside, :2] / CELL_M).astype(np.int64) + side // 2
    number, height = cell @ np.array([side, 1]), points[inside, 2].astype(np.float64)
    order = np.lexsort((height, number))
    number, height = number[order], height[order]
    cells, first, count = np.unique(number, return_index=True, return_counts=True)
    full = count >= _FEWEST
    cells, first, count = cells[full], first[full], count[full]
    place = _QUANTILE * (count - 1)
    below = first + place.astype(np.intp)
    above = np.minimum(below + 1, first + count - 1)
    lowest = np.full(side * side, np.nan)
    lowest[cells] = height[below] + (place % 1.0) * (height[above] - height[below])
    return lowest.reshape(side, side)
