"""Changes between two runs over the same frames: objects that one finds and the other misses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.review.errors.filters import ErrorFilter
from dsrc.review.errors.judged import JudgedRun


@dataclass(frozen=True, slots=True, eq=False)
class ObjectChanges:
    """Objects that one run finds and the other misses, K rows, by frame.

    Attributes:
        row: (K,) int64 frame in its source.
        object_id: (K,) int64.
        fixed: (K,) bool, True where the second run finds it, False where it misses it.
    """

    row: NDArray[np.int64]
    object_id: NDArray[np.int64]
    fixed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.row)


def changes(
    before: JudgedRun, after: JudgedRun, threshold: float, iou: float, only: ErrorFilter | None = None
) -> ObjectChanges:
    """Changes from one run to another: another condition, or another method.

    Args:
        only: objects of the second run to look at; None for all.
    """
    first, second = _same_objects(before, after)
    if only is not None:
        chosen = only.objects(after)[second]
        first, second = first[chosen], second[chosen]
    had, has = before.found(threshold, iou)[first], after.found(threshold, iou)[second]
    changed = np.flatnonzero(had != has)
    second, has = second[changed], has[changed]
    row = after.table.position[after.truth_frame_of[second]]
    order = np.lexsort((after.truth_distance_m[second], row))
    return ObjectChanges(row[order], after.table.object_id[second[order]], has[order])


def _same_objects(before: JudgedRun, after: JudgedRun) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the true boxes that both runs have: equal in frame and object; unknown ids, -1, are left out."""
    keys = []
    ids = np.unique(np.concatenate([before.table.object_id, after.table.object_id]))
    for run in (before, after):
        number = np.searchsorted(ids, run.table.object_id)
        keys.append(run.table.position[run.truth_frame_of] * (len(ids) + 1) + number)
    known = [np.flatnonzero(run.table.object_id >= 0) for run in (before, after)]
    _, first, second = np.intersect1d(keys[0][known[0]], keys[1][known[1]], return_indices=True)
    return known[0][first], known[1][second]
