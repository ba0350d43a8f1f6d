"""Box coding: what the regression head predicts, relative to an anchor.

A delta is (dx, dy, dz, log l, log w, log h, dyaw): offsets in the plane in units of the anchor's diagonal, in height in
units of the anchor's height, logarithms of the size ratios, and the plain difference of the headings.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = TypeVar("Array", NDArray[np.floating], Any)

REFERENCE_ORDER = (0, 1, 2, 5, 4, 3, 6)
"""The released models' deltas and boxes have h, w, l where ours have l, w, h: index with this, either way."""

_LOG_LIMIT = 5.0
"""Size ratios beyond e^5 are a network gone astray; without a limit they overflow into NaN overlaps."""


def _library(array: object) -> Any:
    """Return the module whose functions take this array: numpy, or torch without importing it for numpy users."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def encode(boxes: Array, anchors: Array) -> Array:
    """Return (..., 7) deltas of boxes (..., 7) to anchors (..., 7), numpy or torch; sizes must be positive."""
    lib = _library(boxes)
    diagonal = lib.sqrt(anchors[..., 3] ** 2 + anchors[..., 4] ** 2)
    return lib.stack(
        [
            (boxes[..., 0] - anchors[..., 0]) / diagonal,
            (boxes[..., 1] - anchors[..., 1]) / diagonal,
            (boxes[..., 2] - anchors[..., 2]) / anchors[..., 5],
            lib.log(boxes[..., 3] / anchors[..., 3]),
            lib.log(boxes[..., 4] / anchors[..., 4]),
            lib.log(boxes[..., 5] / anchors[..., 5]),
            boxes[..., 6] - anchors[..., 6],
        ],
        -1,
    )


def decode(deltas: Array, anchors: Array) -> Array:
    """Return (..., 7) boxes of deltas (..., 7) on anchors (..., 7), the inverse of `encode`; yaw is not wrapped."""
    lib = _library(deltas)
    diagonal = lib.sqrt(anchors[..., 3] ** 2 + anchors[..., 4] ** 2)
    size = lib.exp(lib.clip(deltas[..., 3:6], -_LOG_LIMIT, _LOG_LIMIT)) * anchors[..., 3:6]
    return lib.stack(
        [
            deltas[..., 0] * diagonal + anchors[..., 0],
            deltas[..., 1] * diagonal + anchors[..., 1],
            deltas[..., 2] * anchors[..., 5] + anchors[..., 2],
            size[..., 0],
            size[..., 1],
            size[..., 2],
            deltas[..., 6] + anchors[..., 6],
        ],
        -1,
    )


def headed(deltas: NDArray[np.floating], against: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Return (B, 14, h, w) deltas with the boxes turned round that do not head as they should.

    A box overlaps its mirror image, so that no loss of overlap or of a heading's sine tells them apart. What does is
    which way a box heads along its anchor: 45 degrees to either side is as far as a box is from the nearest anchor, so
    the answer is never near a boundary. (SECOND, Sensors 2018, 18, 3337, and PointPillars put the boundary of their two
    bins at 45 degrees, where a small error of the heading flips the box.)

    Args:
        deltas: headings at 6 and 13.
        against: (B, 2, h, w) whether the box of an anchor heads against it.
    """
    turned = deltas.copy()
    yaw = turned[:, 6::7]
    yaw[(np.cos(yaw) < 0) != against] += np.pi
    return turned
