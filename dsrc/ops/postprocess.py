"""Post-processing of the heads' maps: threshold, decoding, filters, non-maximum suppression."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.ops.coding import decode
from dsrc.ops.detections import Detections
from dsrc.ops.iou import rotated_nms
from sim.boxes import Boxes


class PostSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Post-processing settings.

    Attributes:
        score_threshold: confidence that detections exceed.
        nms_iou: overlap above which the less confident of two detections is dropped.
        max_boxes: number of most confident candidates that are considered.
        range_m: (x_min, y_min, z_min, x_max, y_max, z_max), m: boxes with all corners inside, faces included, are kept,
            as of the ground truth; None keeps all.
        max_extent_m: extent of the axis-aligned hull along x or y above which boxes are dropped. The released code has
            6.0, which drops every bus, and a long car depending on its heading; None keeps all.
    """

    score_threshold: float = 0.25
    nms_iou: float = 0.15
    max_boxes: int = 1000
    range_m: tuple[float, float, float, float, float, float] | None = None
    max_extent_m: float | None = None


def decode_detections(
    cls_logits: NDArray[np.float32],
    regression: NDArray[np.float32],
    anchors: NDArray[np.float64],
    settings: PostSettings,
    label: NDArray[np.int64] | None = None,
) -> Detections:
    """Decode the detections of one sample, in the frame of the anchors (the ego LiDAR's).

    Args:
        cls_logits: (2, H, W) logits per anchor.
        regression: (14, H, W) deltas, 7 per anchor.
        anchors: (H, W, 2, 7).
        label: (2,) classes of boxes by anchor; None for cars.
    """
    boxes, scores = candidates(cls_logits, regression, anchors, settings.score_threshold, label)
    return suppressed(boxes, scores, settings)


def candidates(
    cls_logits: NDArray[np.float32],
    regression: NDArray[np.float32],
    anchors: NDArray[np.float64],
    score_threshold: float,
    label: NDArray[np.int64] | None = None,
) -> tuple[Boxes, NDArray[np.float32]]:
    """Decode the anchors above the threshold.

    Returns:
        K boxes in the order of the anchors (row, column, anchor), and their (K,) float32 scores.
    """
    logits = np.moveaxis(np.asarray(cls_logits, np.float32), 0, -1)
    with np.errstate(over="ignore"):
        scores = 1.0 / (1.0 + np.exp(-logits))
    row, column, anchor = np.nonzero(scores > np.float32(score_threshold))
    maps = np.asarray(regression, np.float32).reshape(logits.shape[-1], 7, *logits.shape[:2])
    boxes = decode(maps[anchor, :, row, column].astype(np.float64), anchors[row, column, anchor])
    finite = np.isfinite(boxes).all(axis=1)
    labels = None if label is None else label[anchor][finite]
    return Boxes.from_array(boxes[finite], labels), scores[row, column, anchor][finite]


def suppressed(boxes: Boxes, scores: NDArray[np.float32], settings: PostSettings) -> Detections:
    """Filter and suppress candidates of one frame, from one agent or, for late fusion, from several."""
    keep = _plausible(boxes, settings)
    boxes, scores = boxes[keep], np.asarray(scores, np.float32)[keep]
    kept = rotated_nms(boxes.array, scores, settings.nms_iou, settings.max_boxes)
    boxes, scores = boxes[kept], scores[kept]
    if settings.range_m is not None:
        low, high = np.array(settings.range_m[:2]), np.array(settings.range_m[3:5])
        plane = boxes.corners()[:, :, :2]
        inside = np.all((plane >= low) & (plane <= high), axis=(1, 2))
        boxes, scores = boxes[inside], scores[inside]
    return Detections(boxes, scores)


def _plausible(boxes: Boxes, settings: PostSettings) -> NDArray[np.bool_]:
    """Return the (N,) mask of candidates with a volume that pass the filters before the suppression."""
    keep: NDArray[np.bool_] = np.all(boxes.size > 0, axis=1)
    half_height = 0.5 * boxes.size[:, 2]
    if settings.range_m is not None:
        keep &= boxes.center[:, 2] - half_height >= settings.range_m[2]
        keep &= boxes.center[:, 2] + half_height <= settings.range_m[5]
    if settings.max_extent_m is not None:
        plane = boxes.corners()[:, :4, :2]
        keep &= np.all(np.ptp(plane, axis=1) <= settings.max_extent_m, axis=1)
    return keep
