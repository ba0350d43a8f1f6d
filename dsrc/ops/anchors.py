"""Anchors: two boxes of a typical car, along and across, in every cell of the output map."""

import numpy as np
from numpy.typing import NDArray

from dsrc.ops.grid import GridSpec
from sim.errors import SettingsError

ANCHOR_LWH = (3.9, 1.6, 1.56)
"""Length, width and height of an anchor, m."""
ANCHOR_Z = -1.0
"""Height of the anchors' centres in the LiDAR's frame, m."""
ANCHOR_YAW = (0.0, np.pi / 2)
"""Headings of the two anchors of a cell, rad."""


def anchor_grid(grid: GridSpec, stride: int = 2, size: tuple[float, float, float] | None = None) -> NDArray[np.float64]:
    """Return (height / stride, width / stride, 2, 7) float64 anchors x, y, z, l, w, h, yaw in the ego LiDAR's frame.

    Centres spread evenly from one input cell inside the range to one input cell inside the other end. At stride 2
    these are the centres of the output cells; at stride 4 the spread is the released code's, a little too wide.

    Raises:
        SettingsError: the stride does not divide the grid.
    """
    if grid.width % stride or grid.height % stride:
        raise SettingsError(
            f"grid: range_m: expected a multiple of {stride} cells, found {grid.width} x {grid.height} cells"
        )
    x_min, y_min, _, x_max, y_max, _ = grid.range_m
    x = np.linspace(x_min + grid.cell_m, x_max - grid.cell_m, grid.width // stride)
    y = np.linspace(y_min + grid.cell_m, y_max - grid.cell_m, grid.height // stride)
    anchors = np.zeros((len(y), len(x), len(ANCHOR_YAW), 7))
    anchors[..., 0] = x[None, :, None]
    anchors[..., 1] = y[:, None, None]
    anchors[..., 2] = ANCHOR_Z
    anchors[..., 3:6] = ANCHOR_LWH if size is None else size
    anchors[..., 6] = ANCHOR_YAW
    return anchors
