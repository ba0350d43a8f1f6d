"""Compiled loops of `dsrc.ops.ground`."""

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled


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
