"""Compiled loop of `points_in_boxes`: boxes listed by cells of the plane."""

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled

CELL_M, CELLS = 2.0, 128
"""Side of a cell, m, and cells along each axis before they repeat."""
GROWN_M = 1e-3
"""Growth of the boxes before they are listed: more than any rounding."""


@compiled(forceinline=True)
def _cell(place: float) -> np.int64:
    """Return the number of the cell of a coordinate; cells a period apart share it."""
    return np.int64(np.floor(place / CELL_M)) & (CELLS - 1)


@compiled()
def pairs_inside(
    points: NDArray[np.float32],
    matrix: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    margin: float,
    center: NDArray[np.float64],
    reach: NDArray[np.float64],
    turn: NDArray[np.float64],
    hull: bool,
    pairs: NDArray[np.int32],
) -> int:
    """List the pairs of a point and a box around it.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        matrix: (4, 4) from the points' frame to the boxes'.
        low: (N, 3) least coordinates of the boxes' corners.
        high: (N, 3) greatest ones.
        margin: growth of the boxes, m.
        center: (N, 3).
        reach: (N, 3) half sizes along the boxes' own axes, with the margin.
        turn: (N, 2) cosine and sine of the headings.
        hull: test against `low` and `high` only.
        pairs: (K, 2) int32 room for rows of points and of boxes.

    Returns:
        The number of pairs; the first K of them are in `pairs`.
    """
    # A turned box grows by more along the axes: up to the root of 2.
    grown = 1.5 * max(margin, 0.0) + GROWN_M
    start = np.zeros(CELLS * CELLS + 1, np.int64)
    boxes = np.zeros(0, np.int64)
    for filling in (False, True):
        # First count the boxes of each cell, then list them; the starts of the cells are their ends at first.
        for box in range(len(low)):
            x, y = low[box, 0] - grown, low[box, 1] - grown
            columns, rows = (high[box, 0] + grown - x) / CELL_M, (high[box, 1] + grown - y) / CELL_M
            for column in range(min(int(columns) + 2, CELLS)):
                for row in range(min(int(rows) + 2, CELLS)):
                    cell = _cell(x + column * CELL_M) * CELLS + _cell(y + row * CELL_M)
                    if filling:
                        start[cell] -= 1
                        boxes[start[cell]] = box
                    else:
                        start[cell] += 1
        if not filling:
            for cell in range(CELLS * CELLS):
                start[cell + 1] += start[cell]
            boxes = np.zeros(start[-1], np.int64)
    found = 0
    for point in range(len(points)):
        a, b, c = np.float64(points[point, 0]), np.float64(points[point, 1]), np.float64(points[point, 2])
        x = matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c + matrix[0, 3]
        y = matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c + matrix[1, 3]
        cell = _cell(x) * CELLS + _cell(y)
        if start[cell] == start[cell + 1]:
            continue
        z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
        for k in range(start[cell], start[cell + 1]):
            box = boxes[k]
            if hull:
                inside = low[box, 0] <= x <= high[box, 0] and low[box, 1] <= y <= high[box, 1]
                inside = inside and low[box, 2] <= z <= high[box, 2]
            else:
                dx, dy, dz = x - center[box, 0], y - center[box, 1], z - center[box, 2]
                along = abs(turn[box, 0] * dx + turn[box, 1] * dy)
                across = abs(turn[box, 0] * dy - turn[box, 1] * dx)
                inside = along <= reach[box, 0] and across <= reach[box, 1] and abs(dz) <= reach[box, 2]
            if inside:
                if found < len(pairs):
                    pairs[found, 0] = point
                    pairs[found, 1] = box
                found += 1
    return found
