"""Line drawings of boxes: TP, FP and FN differ in form as well as in colour."""

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.geometry import pose_matrix, transform_points

# Corners 0..3 are the bottom (front right, front left, rear left, rear right), 4..7 the top.
_EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])
_ROOF_CROSS = np.array([[4, 6], [5, 7]])

CUBE_VERTICES = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
CUBE_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    np.uint32,
)  # fmt: skip


def edges(boxes: Boxes) -> NDArray[np.float32]:
    """(13 N, 2, 3) lines: the twelve edges and a tick forward from the front, which shows the heading."""
    return np.concatenate([_pick(boxes, _EDGES), _ticks(boxes)]).astype(np.float32)


def crossed(boxes: Boxes) -> NDArray[np.float32]:
    """(15 N, 2, 3) lines: as `edges`, with a cross on the roof."""
    return np.concatenate([edges(boxes), roof_crosses(boxes)])


def roof_crosses(boxes: Boxes) -> NDArray[np.float32]:
    """(2 N, 2, 3) lines: the diagonals of the roofs."""
    return _pick(boxes, _ROOF_CROSS).astype(np.float32)


def dashed(boxes: Boxes, dash_m: float = 0.45) -> NDArray[np.float32]:
    """(K, 2, 3) lines of `edges` as dashes of about `dash_m` with gaps of the same length."""
    return dashed_lines(edges(boxes), dash_m)


def dashed_lines(lines: NDArray[np.float32], dash_m: float) -> NDArray[np.float32]:
    """(K, 2, 3) dashes of (N, 2, 3) lines, about `dash_m` long, with gaps of the same length."""
    if len(lines) == 0:
        return lines
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    number = np.maximum(np.round((length / dash_m + 1.0) / 2.0), 1).astype(np.intp)
    of_line = np.repeat(np.arange(len(lines)), number)
    first = np.concatenate([np.arange(n) for n in number])
    # n dashes and n - 1 gaps of one length fill the line and end it on both sides with a dash.
    start = 2.0 * first / (2.0 * number[of_line] - 1.0)
    end = start + 1.0 / (2.0 * number[of_line] - 1.0)
    origin, along = lines[of_line, 0], lines[of_line, 1] - lines[of_line, 0]
    return np.stack([origin + start[:, None] * along, origin + end[:, None] * along], axis=1).astype(np.float32)


def polyline(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """(K - 1, 2, 3) lines between (K, 3) points in their order."""
    return np.stack([points[:-1], points[1:]], axis=1).astype(np.float32).reshape(-1, 2, 3)


def quaternions(yaw: NDArray[np.float64]) -> NDArray[np.float32]:
    """(N, 4) w, x, y, z quaternions of turns about z."""
    zero = np.zeros_like(yaw)
    return np.stack([np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)], axis=1).astype(np.float32)


def _pick(boxes: Boxes, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    return boxes.corners()[:, pairs].reshape(-1, 2, 3)


def _ticks(boxes: Boxes) -> NDArray[np.float64]:
    half = 0.5 * boxes.size
    local = np.zeros((len(boxes), 2, 3))
    local[:, 0, 0], local[:, 1, 0] = half[:, 0], half[:, 0] + np.maximum(0.8, 0.35 * half[:, 0])
    local[:, :, 2] = -half[:, 2:3]
    return np.asarray(transform_points(pose_matrix(boxes.center, boxes.yaw), local), np.float64)
