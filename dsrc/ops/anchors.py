"""Anchors: two boxes in every cell of the output map, of the size of what is detected."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.ops.grid import GridSpec
from sim.boxes import CLASSES, VEHICLES
from sim.errors import SettingsError

Users = Literal["vehicles", "vulnerable"]
"""Road users that a network detects: vehicles, or pedestrians and two-wheelers, `sim.boxes.VULNERABLE`."""


class Anchors(NamedTuple):
    """Two anchors of a cell.

    Attributes:
        box: (2, 5) heights of the centres in the LiDAR's frame, lengths, widths, heights, m, and headings, rad.
        label: (2,) classes of boxes that are found with them, indices into `CLASSES`.
        takes: (C, 2) bool whether boxes of each of `CLASSES` are learned with each.
        positive_iou: (2,) least overlaps of positive anchors with their boxes.
        headed: (2,) bool whether the headings of boxes are learned with each; the others keep the anchor's.
    """

    box: NDArray[np.float64]
    label: NDArray[np.int64]
    takes: NDArray[np.bool_]
    positive_iou: NDArray[np.float64]
    headed: NDArray[np.bool_]


def _takes(*anchors: tuple[str, ...]) -> NDArray[np.bool_]:
    return np.array([[name in names for names in anchors] for name in CLASSES])


ANCHORS: dict[Users, Anchors] = {
    # A typical car, along and across. The overlap is about the 0.6 of the released code, which adds a metre to every
    # side; the class of a vehicle is not told.
    "vehicles": Anchors(
        np.array([(-1.0, 3.9, 1.6, 1.56, 0.0), (-1.0, 3.9, 1.6, 1.56, np.pi / 2)]),
        np.array([0, 0]),
        _takes(VEHICLES, VEHICLES),
        np.array([0.5, 0.5]),
        np.array([True, True]),
    ),
    # Squares: a two-wheeler overlaps its own as much along as across. Its anchor heads between them: headings are
    # learned by their sine, which has no slope at a right angle, where either sign is the same line. A person's box is
    # nearly a square and no cloud shows its heading, so that learning it would be noise in the loss. People are little
    # larger than an output cell, 0.4 m, so they have the lower bound. On average a child has 2.6 positive anchors, an
    # adult 3.5, a cyclist 2.9 to 4.0 and a motorcycle 5; with 0.35 for both, people had one.
    "vulnerable": Anchors(
        np.array([(-1.0, 0.6, 0.6, 1.75, 0.0), (-1.05, 1.2, 1.2, 1.6, np.pi / 4)]),
        np.array([CLASSES.index("pedestrian"), CLASSES.index("bicycle")]),
        _takes(("pedestrian",), ("bicycle", "motorcycle")),
        np.array([0.15, 0.35]),
        np.array([False, True]),
    ),
}


def anchor_grid(
    grid: GridSpec, stride: int = 2, users: Users = "vehicles", size: tuple[float, float, float] | None = None
) -> NDArray[np.float64]:
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
    anchors = np.zeros((len(y), len(x), 2, 7))
    anchors[..., 0] = x[None, :, None]
    anchors[..., 1] = y[:, None, None]
    anchors[..., 2:] = ANCHORS[users].box
    if size is not None:
        anchors[..., 3:6] = size
    return anchors
