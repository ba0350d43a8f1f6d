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

from sensors.compiled import compiled

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
        return heights_at(self.heights, self.cell_m, np.ascontiguousarray(xy, np.float32))

    def knows(self, xy: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (P,) whether the ground is known at (P, 2) places, and not filled in."""
        cells = np.asarray(xy[:, :2], np.float64).T / self.cell_m + 0.5 * (len(self.heights) - 1)
        rows, columns = np.rint(cells).astype(np.intp).clip(0, len(self.heights) - 1)
        return self.known[rows, columns]


def fit_ground(points: NDArray[np.floating], reach_m: float = REACH_M) -> Ground:
    """Return the ground below points (P, 3 or more: x, y, z, m) around the origin; flat at 0 without any ground."""
    side = 2 * int(np.ceil(reach_m / CELL_M))
    by_cell, start = sort_cells(np.ascontiguousarray(points, np.float32), CELL_M, side)
    lowest = heights_of_rank(by_cell[:, 2].copy(), start, _LOWEST, _FEWEST)
    ground = low_cells(lowest, int(_NEAR_M / CELL_M), _STEP_M, _SLOPE * CELL_M, _PIT_M)
    if not ground.any():
        return Ground(np.zeros((side, side)), np.zeros((side, side), bool))
    heights, weight = _smoothed(lowest, ground, _SMOOTH_M[0])
    from scipy.ndimage import distance_transform_edt  # a third of a second, and few processes fit a ground

    known = weight > _LEAST_WEIGHT[0]
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    heights = heights[tuple(nearest)]
    middle = heights_of_rank(heights_above(heights, CELL_M, by_cell, _BAND_M), start, _MIDDLE, _FEWEST)
    change, weight = _smoothed(middle, np.isfinite(middle), _SMOOTH_M[1])
    return Ground(heights + np.where(weight > _LEAST_WEIGHT[1], change, 0.0), known)


def _smoothed(
    heights: NDArray[np.float64], chosen: NDArray[np.bool_], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (n, n) smoothed heights of the chosen cells, and the share of chosen cells that they come from."""
    from scipy.ndimage import gaussian_filter

    weight = gaussian_filter(chosen.astype(np.float64), sigma_m / CELL_M)
    return gaussian_filter(np.where(chosen, heights, 0.0), sigma_m / CELL_M) / np.maximum(weight, 1e-9), weight


@compiled()
def heights_at(heights: NDArray[np.float64], cell_m: float, places: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (P,) heights of an (n, n) map around the origin at (P, 2 or more) places, those of its border beyond."""
    found = np.zeros(len(places))
    for k in range(len(places)):
        found[k] = _height_at(heights, cell_m, places[k, 0], places[k, 1])
    return found


@compiled()
def heights_above(
    heights: NDArray[np.float64], cell_m: float, points: NDArray[np.float32], band_m: float
) -> NDArray[np.float32]:
    """Return (P,) heights of (P, 3 or more) points above a map; NaN for those farther from it than `band_m`."""
    found = np.full(len(points), np.nan, np.float32)
    for k in range(len(points)):
        above = points[k, 2] - _height_at(heights, cell_m, points[k, 0], points[k, 1])
        if np.abs(above) < band_m:
            found[k] = above
    return found


@compiled(inline="always")
def _height_at(heights: NDArray[np.float64], cell_m: float, x_m: float, y_m: float) -> float:
    last = len(heights) - 1
    x: float = x_m / cell_m + 0.5 * last
    y: float = y_m / cell_m + 0.5 * last
    # A comparison with NaN is false: a NaN has the height of a border and reads no other memory.
    x = (x if x < last else float(last)) if x > 0.0 else 0.0
    y = (y if y < last else float(last)) if y > 0.0 else 0.0
    i, j = min(int(x), last - 1), min(int(y), last - 1)
    u, v = x - i, y - j
    low = heights[i, j] + v * (heights[i, j + 1] - heights[i, j])
    high = heights[i + 1, j] + v * (heights[i + 1, j + 1] - heights[i + 1, j])
    return low + u * (high - low)


@compiled()
def sort_cells(points: NDArray[np.float32], cell_m: float, side: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Sort the points of a square of n x n cells around the origin by cell; those without a finite height are left out.

    Args:
        points: (P, 3 or more) x, y, z, m.
        cell_m: side of a cell.
        side: cells n of a side of the square.

    Returns:
        (K, 3) x, y, z, cell by cell, and (n * n + 1,) where the points of each cell begin.
    """
    cell = np.full(len(points), -1, np.int32)
    start = np.zeros(side * side + 1, np.int64)
    for k in range(len(points)):
        x, y = np.floor(points[k, 0] / cell_m) + side // 2, np.floor(points[k, 1] / cell_m) + side // 2
        if x >= 0 and x < side and y >= 0 and y < side and np.isfinite(points[k, 2]):
            cell[k] = np.int32(x) * side + np.int32(y)
            start[cell[k] + 1] += 1
    start = np.cumsum(start)
    place = start[:-1].copy()
    found = np.zeros((start[-1], 3), np.float32)
    for k in range(len(points)):
        if cell[k] >= 0:
            row = place[cell[k]]
            found[row, 0], found[row, 1], found[row, 2] = points[k, 0], points[k, 1], points[k, 2]
            place[cell[k]] += 1
    return found, start


@compiled()
def heights_of_rank(
    height: NDArray[np.float32], start: NDArray[np.int64], share: float, fewest: int
) -> NDArray[np.float64]:
    """Return the (n, n) heights below which a share of the points of each cell lies; NaN for cells with too few.

    Args:
        height: (K,) heights, cell by cell; NaN does not count. It is overwritten.
        start: (n * n + 1,) where the heights of each cell begin.
        share: between 0 and 1.
        fewest: points that a cell needs.
    """
    found = np.full(len(start) - 1, np.nan)
    for cell in range(len(found)):
        first, after = start[cell], start[cell]
        for k in range(start[cell], start[cell + 1]):
            if not np.isnan(height[k]):
                height[after] = height[k]
                after += 1
        if after - first < fewest:
            continue
        wanted, last = first + np.int64(share * (after - first - 1)), after - 1
        # Hoare's selection; its result depends on the values alone, not on their order.
        while first < last:
            pivot = height[(first + last) // 2]
            i, j = first, last
            while i <= j:
                while height[i] < pivot:
                    i += 1
                while height[j] > pivot:
                    j -= 1
                if i <= j:
                    height[i], height[j] = height[j], height[i]
                    i += 1
                    j -= 1
            if wanted <= j:
                last = j
            elif wanted >= i:
                first = i
            else:
                break
        found[cell] = height[wanted]
    side = round(np.sqrt(len(found)))
    return found.reshape(side, side)


@compiled()
def low_cells(lowest: NDArray[np.float64], near: int, step_m: float, rise_m: float, pit_m: float) -> NDArray[np.bool_]:
    """Return the (n, n) cells that hold ground: neither high above another cell near by nor a pit.

    Args:
        lowest: (n, n) low heights of cells, NaN for none.
        near: cells within which another one counts.
        step_m: height over a lower cell that is still ground.
        rise_m: what is allowed on top of it per cell of distance.
        pit_m: depth below the median of the 3 x 3 cells from which on a cell is a pit.
    """
    side = len(lowest)
    heights = np.full((side, side), np.inf)
    around = np.zeros(9)
    for i in range(side):
        for j in range(side):
            if not np.isfinite(lowest[i, j]):
                continue
            found = 0
            for a in range(max(i - 1, 0), min(i + 2, side)):
                for b in range(max(j - 1, 0), min(j + 2, side)):
                    if np.isfinite(lowest[a, b]):
                        around[found] = lowest[a, b]
                        found += 1
            if lowest[i, j] >= np.median(around[:found]) - pit_m:
                heights[i, j] = lowest[i, j]
    ground = np.zeros((side, side), np.bool_)
    for i in range(side):
        for j in range(side):
            ground[i, j] = np.isfinite(heights[i, j]) and not _stands(heights, i, j, near, step_m, rise_m)
    return ground


@compiled()
def _stands(heights: NDArray[np.float64], i: int, j: int, near: int, step_m: float, rise_m: float) -> bool:
    for a in range(max(i - near, 0), min(i + near + 1, len(heights))):
        for b in range(max(j - near, 0), min(j + near + 1, len(heights))):
            lower = heights[i, j] - heights[a, b] - step_m
            if lower > 0.0:
                away = np.float64((a - i) ** 2 + (b - j) ** 2)
                if away <= near * near and lower * lower > rise_m * rise_m * away:
                    return True
    return False
