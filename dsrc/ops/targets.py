"""Target assignment: positive anchors of each ground-truth box, and their box residuals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dsrc.ops.coding import encode

_LEGACY_POSITIVE = 0.6
_TIE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class AnchorAssignment:
    """Assignment of the (H, W, 2) anchors of one sample to its boxes.

    Attributes:
        positive: (H, W, 2) bool positive anchors.
        owner: (H, W, 2) int32 row of a positive anchor's box, -1 elsewhere.
        regression: (H, W, 14) float32 deltas (see `coding`), anchor by anchor; zero where not positive.
    """

    positive: NDArray[np.bool_]
    owner: NDArray[np.int32]
    regression: NDArray[np.float32]


def assign_targets(
    boxes: ArrayLike,
    anchors: NDArray[np.float64],
    positive_iou: float | NDArray[np.float64] = 0.5,
    legacy_iou: bool = False,
    fits: NDArray[np.bool_] | None = None,
) -> AnchorAssignment:
    """Assign the anchors of one sample.

    An anchor with an overlap of at least `positive_iou` is positive for the box that it overlaps most. A box without
    such an anchor takes those that overlap it most: every anchor that fits inside a bus. For the overlap a box and
    an anchor are turned to the nearest axis, so that the number of a box's anchors does not depend on its heading.

    With `legacy_iou` the labels are the released code's: overlap of axis-aligned hulls with one metre added to every
    side (a pixel convention, applied to metres), more than 0.6 positive, the first box wins a disputed anchor and a
    box can end without any. The other arguments are then unused.

    Args:
        boxes: (n, 7) x, y, z, l, w, h, yaw in the anchors' frame.
        anchors: (H, W, 2, 7) of `anchor_grid`.
        positive_iou: least overlap of a positive anchor, or (2,) of each of a cell.
        fits: (n, 2) whether a box may have each anchor of a cell; all may when left out.

    Raises:
        ValueError: `fits` is not (n, 2).
    """
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    fits = np.ones((len(boxes), 2), bool) if fits is None else fits
    if fits.shape != (len(boxes), 2):
        raise ValueError(f"fits: expected ({len(boxes)}, 2), found {fits.shape}")
    if legacy_iou:
        owner = _assign_legacy(boxes, anchors)
    else:
        owner = _assign(boxes, anchors, positive_iou, fits)
    positive = owner >= 0
    regression = np.zeros((*owner.shape, 7), np.float32)
    if len(boxes):
        regression[positive] = encode(boxes[owner[positive]], anchors[positive])
    return AnchorAssignment(positive, owner, regression.reshape(*owner.shape[:2], -1))


def _assign(
    boxes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    positive_iou: float | NDArray[np.float64],
    fits: NDArray[np.bool_],
) -> NDArray[np.int32]:
    best = np.zeros(anchors.shape[:3])
    owner = np.full(anchors.shape[:3], -1, np.int32)
    overlaps = []
    for box, fit in zip(boxes, fits, strict=True):
        window, iou = _overlap(_nearest_axis_hull(box), anchors, 0.0)
        overlaps.append((window, iou * fit))
    for row, (window, iou) in enumerate(overlaps):
        more = iou > best[window]
        best[window][more] = iou[more]
        owner[window][more & (iou >= positive_iou)] = row
    for row, (window, iou) in enumerate(overlaps):
        if not (owner[window] == row).any() and iou.size and iou.max() > 0:
            owner[window][iou >= iou.max() - _TIE] = row
    return owner


def _assign_legacy(boxes: NDArray[np.float64], anchors: NDArray[np.float64]) -> NDArray[np.int32]:
    owner = np.full(anchors.shape[:3], -1, np.int32)
    overlaps = [_overlap(_hull(box), anchors, 1.0) for box in boxes]
    for row, (window, iou) in enumerate(overlaps):
        owner[window][(iou > np.float32(_LEGACY_POSITIVE)) & (owner[window] < 0)] = row
    for row, (window, iou) in enumerate(overlaps):
        if iou.size == 0 or iou.max() <= 0:
            continue
        place = np.unravel_index(int(iou.argmax()), iou.shape)
        if owner[window][place] < 0:
            owner[window][place] = row
    return owner


def _hull(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axis-aligned hull (x_min, y_min, x_max, y_max) of a rotated box."""
    c, s = abs(np.cos(box[6])), abs(np.sin(box[6]))
    half = 0.5 * np.array([box[3] * c + box[4] * s, box[3] * s + box[4] * c])
    return np.concatenate([box[:2] - half, box[:2] + half])


def _nearest_axis_hull(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the hull of the box turned to the nearest axis: its heading rounded to a multiple of 90 degrees."""
    along_y = round(float(box[6]) / (np.pi / 2)) % 2 == 1
    half = 0.5 * (box[[4, 3]] if along_y else box[[3, 4]])
    return np.concatenate([box[:2] - half, box[:2] + half])


def _overlap(
    hull: NDArray[np.float64], anchors: NDArray[np.float64], extra: float
) -> tuple[tuple[slice, slice], NDArray[np.floating]]:
    """Return the window of the grid that can overlap a hull, and the (h, w, 2) IoU of its anchors with it.

    Args:
        hull: (4,) x_min, y_min, x_max, y_max.
        anchors: (H, W, 2, 7): a grid, its centres vary in x along W and in y along H only.
        extra: added to every side before multiplying, 1 in the legacy convention (anchors' hulls, in float32), or 0.
    """
    x, y = anchors[0, :, 0, 0], anchors[:, 0, 0, 1]
    hull_of = _hull if extra else _nearest_axis_hull
    low = np.array([hull_of(a)[:2] - a[:2] for a in anchors[0, 0]])  # (2, 2) anchor corners about their centres
    reach = np.abs(low).max() + extra
    window = (
        slice(*np.searchsorted(y, [hull[1] - reach, hull[3] + reach])),
        slice(*np.searchsorted(x, [hull[0] - reach, hull[2] + reach])),
    )
    dtype = np.float32 if extra else np.float64
    hull, low = hull.astype(dtype), low.astype(dtype)
    side = [
        _sides(hull[axis], hull[axis + 2], centres[part].astype(dtype), low[:, axis], dtype(extra))
        for axis, centres, part in ((0, x, window[1]), (1, y, window[0]))
    ]
    (shared_x, anchor_x, box_x), (shared_y, anchor_y, box_y) = side
    shared = shared_x[None, :, :] * shared_y[:, None, :]
    union = box_x * box_y + anchor_x * anchor_y - shared
    return window, shared / union


def _sides(
    low: np.floating,
    high: np.floating,
    centres: NDArray[np.floating],
    anchor_low: NDArray[np.floating],
    extra: np.floating,
) -> tuple[NDArray[np.floating], NDArray[np.floating], np.floating]:
    """Return along one axis the shared lengths (k, 2), the anchors' lengths (2,) and the hull's length."""
    start, end = centres[:, None] + anchor_low, centres[:, None] - anchor_low
    shared = np.maximum(np.minimum(end, high) - np.maximum(start, low) + extra, 0)
    return shared, -2 * anchor_low + extra, high - low + extra
