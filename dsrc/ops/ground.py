"""Surface of the ground below a sweep: heights in square cells, fitted to its points in two steps.

First the lowest twentieth of the points of a cell is its ground, unless the cell lies high above another near by: then
it holds a roof, a bonnet, a crown or a bank; or far below all around it: then it holds reflections. What is left is
smoothed, and holes take the height of the nearest cell that is known. Then the middle of the points near this surface
corrects it, so that neither the noise of the points nor their spread over a slope pulls it down. The same for simulated
and for real clouds; no plane is assumed, so slopes and dips stay in it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL_M = 2.0
LIDAR_M = 1.9
"""Height above the ground of the LiDAR in a levelled cloud: the mount of our vehicles' sensors, for which detectors are
trained."""
REACH_M = 80.0
"""Half the side of the square that is fitted, m; beyond it the heights of its border hold."""

_LOWEST = 0.05
_FEWEST = 4
"""Fewest points of a cell whose lowest are taken for ground."""
_NEAR_M = 8.0
"""Distance within which lower ground rules out a cell: more than half the length of a lorry."""
_STEP_M = 0.3
_SLOPE = 0.2
"""Rise over lower ground near by, and rise per metre of distance to it, from which on a cell holds what stands; few
streets are steeper."""
_PIT_M = 0.4
"""Depth below the median of the cells around from which on a cell holds reflections or a ditch."""
_SMOOTH_M = (3.0, 2.0)
"""Standard deviations of the smoothing: of the first heights and of their corrections."""
_LEAST_WEIGHT = (0.05, 0.02)
"""Least smoothed share of known cells at a cell that counts as known itself, in the first step and in the second."""
_BAND_M = 0.25
"""Distance from the surface within which points are ground for its correction."""
_MIDDLE = 0.4
"""Share of these points that lie below the corrected surface: of what is no ground among them, most lies above it."""


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
        """Return (P,) heights at (P, 2 or more) places, m: linear between the centres of cells."""
        from dsrc.ops import ground_kernel as kernel  # numba takes a third of a second, and few processes fit a ground

        return kernel.heights_at(self.heights, self.cell_m, np.ascontiguousarray(xy, np.float32))

    def knows(self, xy: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (P,) whether the ground is known at (P, 2) places, and not filled in."""
        cells = np.asarray(xy[:, :2], np.float64).T / self.cell_m + 0.5 * (len(self.heights) - 1)
        rows, columns = np.rint(cells).astype(np.intp).clip(0, len(self.heights) - 1)
        return self.known[rows, columns]


def fit_ground(points: NDArray[np.floating], reach_m: float = REACH_M) -> Ground:
    """Return the ground below points (P, 3 or more: x, y, z, m) around the origin; flat at 0 without any ground."""
    from dsrc.ops import ground_kernel as kernel

    side = 2 * int(np.ceil(reach_m / CELL_M))
    by_cell, start = kernel.sort_cells(np.ascontiguousarray(points, np.float32), CELL_M, side)
    lowest = kernel.heights_of_rank(by_cell[:, 2].copy(), start, _LOWEST, _FEWEST)
    ground = kernel.low_cells(lowest, int(_NEAR_M / CELL_M), _STEP_M, _SLOPE * CELL_M, _PIT_M)
    if not ground.any():
        return Ground(np.zeros((side, side)), np.zeros((side, side), bool))
    heights, weight = _smoothed(lowest, ground, _SMOOTH_M[0])
    from scipy.ndimage import distance_transform_edt  # a third of a second, and few processes fit a ground

    known = weight > _LEAST_WEIGHT[0]
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    heights = heights[tuple(nearest)]
    middle = kernel.heights_of_rank(kernel.heights_above(heights, CELL_M, by_cell, _BAND_M), start, _MIDDLE, _FEWEST)
    change, weight = _smoothed(middle, np.isfinite(middle), _SMOOTH_M[1])
    return Ground(heights + np.where(weight > _LEAST_WEIGHT[1], change, 0.0), known)


def _smoothed(
    heights: NDArray[np.float64], chosen: NDArray[np.bool_], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (n, n) smoothed heights of the chosen cells, and the share of chosen cells that they come from."""
    from scipy.ndimage import gaussian_filter

    weight = gaussian_filter(chosen.astype(np.float64), sigma_m / CELL_M)
    return gaussian_filter(np.where(chosen, heights, 0.0), sigma_m / CELL_M) / np.maximum(weight, 1e-9), weight
