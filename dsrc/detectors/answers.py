"""Detections of a detector of one's own, checked before anything is made of them."""

from typing import Any

import numpy as np

from dsrc.ops.anchors import ANCHORS, Users
from dsrc.ops.detections import Detections
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint

MOST_BOXES = 10_000
"""Most boxes of one frame."""


def checked(found: Any, where: str) -> Detections:
    """Return the detections of one frame, best first.

    Args:
        found: what a detector has returned.
        where: detector and frame, for messages.

    Raises:
        TypeError: it is something else.
        DataError: a number is not finite or out of its range, or there are too many boxes.
    """
    if not isinstance(found, Detections):
        raise TypeError(f"{where}.detect: expected Detections, found {type(found).__name__}")

    def wrong(field: str, expected: str, shown: object) -> DataError:
        return DataError(complaint(where, field, expected, shown))

    if len(found) > MOST_BOXES:
        raise wrong("boxes", f"at most {MOST_BOXES}", len(found))
    boxes, score = found.boxes.array, np.asarray(found.score)
    if not (np.isfinite(boxes).all() and np.isfinite(score).all()):
        raise wrong("boxes, score", "finite numbers", "NaN or infinity")
    if len(found) and not boxes[:, 3:6].min() > 0.0:
        raise wrong("boxes", "lengths, widths and heights above 0", f"{boxes[:, 3:6].min():g} m")
    if len(found) and not 0.0 <= score.min() <= score.max() <= 1.0:
        raise wrong("score", "0 to 1", f"{score.min():g} to {score.max():g}")
    order = np.argsort(-score, kind="stable")
    return Detections(found.boxes[order], score[order].astype(np.float32))


def of_arrays(boxes: Any, score: Any, classes: tuple[str, ...], users: Users, where: str) -> Detections:
    """Return the detections of arrays.

    Args:
        boxes: (N, 7) x, y, z, l, w, h, yaw.
        score: (N,).
        classes: of the boxes; empty for the users' first.
        where: detector and frame, for messages.

    Raises:
        DataError: an array is missing or of another shape, a class is unknown, or as `checked`.
    """
    for field, array, shape in (("boxes", boxes, "(N, 7)"), ("score", score, "(N,)")):
        fits = isinstance(array, np.ndarray) and array.dtype.kind == "f"
        if not fits or (array.ndim, *array.shape[1:]) != ((2, 7) if field == "boxes" else (1,)):
            shown = "none" if array is None else f"{getattr(array, 'dtype', '')} {getattr(array, 'shape', array)}"
            raise DataError(complaint(where, field, f"floats of shape {shape}", shown))
    if len(boxes) != len(score) or (classes and len(classes) != len(boxes)):
        shown = f"{len(boxes)} boxes, {len(score)} scores and {len(classes)} classes"
        raise DataError(complaint(where, "boxes", "as many scores, and as many classes or none", shown))
    if unknown := sorted(set(classes) - set(CLASSES)):
        raise DataError(complaint(where, "classes", f"names of {', '.join(CLASSES)}", unknown[0]))
    if not np.isfinite(boxes).all():  # before an angle is wrapped
        raise DataError(complaint(where, "boxes", "finite numbers", "NaN or infinity"))
    named = classes or (CLASSES[ANCHORS[users].label[0]],) * len(boxes)
    label = np.array([CLASSES.index(name) for name in named], np.int64)
    return checked(Detections(Boxes.from_array(boxes, label), np.asarray(score, np.float32)), where)
