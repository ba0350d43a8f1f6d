"""Box coding: residuals of boxes relative to anchors, which the regression head predicts.

A delta is (dx, dy, dz, log l, log w, log h, dyaw): offsets in the plane in units of the anchor's diagonal, in height in
units of the anchor's height, logarithms of the size ratios, and the plain difference of the headings.
"""

import numpy as np
from numpy.typing import NDArray

REFERENCE_ORDER = (0, 1, 2, 5, 4, 3, 6)
"""Index that swaps our l, w, h and the released models' h, w, l in deltas and boxes, either way."""

_LOG_LIMIT = 5.0
"""Logarithm of the largest size ratio; without a limit, a diverged network's sizes overflow into NaN overlaps."""


def encode(boxes: NDArray[np.floating], anchors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (..., 7) deltas of boxes (..., 7) to anchors (..., 7); sizes must be positive."""
    moved = boxes[..., :3] - anchors[..., :3]
    size = np.log(boxes[..., 3:6] / anchors[..., 3:6])
    return np.concatenate([moved / _units(anchors), size, boxes[..., 6:] - anchors[..., 6:]], axis=-1)


def decode(deltas: NDArray[np.floating], anchors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (..., 7) boxes of deltas (..., 7) on anchors (..., 7), the inverse of `encode`; yaw is not wrapped."""
    centre = deltas[..., :3] * _units(anchors) + anchors[..., :3]
    size = np.exp(np.clip(deltas[..., 3:6], -_LOG_LIMIT, _LOG_LIMIT)) * anchors[..., 3:6]
    return np.concatenate([centre, size, deltas[..., 6:] + anchors[..., 6:]], axis=-1)


def _units(anchors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the (..., 3) units of offsets: diagonal, diagonal, height."""
    diagonal = np.sqrt(anchors[..., 3] ** 2 + anchors[..., 4] ** 2)
    return np.stack([diagonal, diagonal, anchors[..., 5]], axis=-1)


def headed(deltas: NDArray[np.floating], against: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Turn the boxes of (B, 14, h, w) deltas by half a turn where their direction along the anchor is wrong.

    A box overlaps its mirror image, so that no loss of overlap or of a heading's sine tells them apart. The direction
    along the anchor does: the nearest anchor is at most 45 degrees away, so that it is never near a boundary. (SECOND,
        Sensors 2018, 18, 3337, and PointPillars put the boundary of their two bins at 45 degrees, where a small error
        of the heading flips the box.)

    Args:
        deltas: headings at 6 and 13.
        against: (B, 2, h, w) bool, True where a box heads against its anchor.
    """
    turned = deltas.copy()
    yaw = turned[:, 6::7]
    yaw[(np.cos(yaw) < 0) != against] += np.pi
    return turned


def in_half_turn(
    deltas: NDArray[np.floating], second: NDArray[np.bool_], anchors: NDArray[np.floating], start: float
) -> NDArray[np.floating]:
    """Turn the boxes of (B, 14, h, w) deltas into one of the two half turns that follow a heading.

    Source: the direction classes of SECOND, Sensors 2018, 18, 3337, Section 3.2.3, as PointPillars and CoAlign have
    them.

    Args:
        deltas: headings at 6 and 13.
        second: (B, 2, h, w) bool, True where a box heads into the second half turn.
        anchors: (h, w, 2, 7).
        start: heading at which the first half turn begins, rad.
    """
    turned = deltas.copy()
    anchor_yaw = np.moveaxis(anchors[..., 6], -1, 0)
    turned[:, 6::7] = (turned[:, 6::7] + anchor_yaw - start) % np.pi + start + np.pi * second - anchor_yaw
    return turned
