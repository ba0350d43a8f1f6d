"""Changes between two runs over the same frames: objects that one finds and the other misses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.review.errors.filters import ErrorFilter
from dsrc.review.errors.judged import JudgedRun


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Objects that one run finds and the other misses, K rows, by frame.

    Attributes:
        row: (K,) int64 frame in its source.
        frame: (K,) int64 number of the frame.
        object_id: (K,) int64.
        box: (K, 7) float32 in the ego LiDAR's frame of the second run.
        fixed: (K,) bool, True where the second run finds it, False where it misses it.
        distance_m: (K,) float64 from the ego's LiDAR in the plane.
        points: (K, 2) int32 of all agents left on the object in the first and in the second run; -1 for unknown.
        before, after: titles of the runs' difference, as `clean` and `fog 3`, or two methods.
        rows: (F,) int64 frames that both runs have.
    """

    row: NDArray[np.int64]
    frame: NDArray[np.int64]
    object_id: NDArray[np.int64]
    box: NDArray[np.float32]
    fixed: NDArray[np.bool_]
    distance_m: NDArray[np.float64]
    points: NDArray[np.int32]
    before: str
    after: str
    rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.row)

    def title(self, row: int) -> str:
        """Title of a change: `fixed by DSRC`, `broken by fog 3`."""
        return f"{'fixed' if self.fixed[row] else 'broken'} by {self.after}"

    def worst_frames(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(F,) frames by what the second run took, and (F,) objects taken less objects fixed there, falling."""
        place = np.searchsorted(self.rows, self.row)
        taken = np.bincount(place[~self.fixed], minlength=len(self.rows))
        taken = taken - np.bincount(place[self.fixed], minlength=len(self.rows))
        order = np.argsort(-taken, kind="stable")
        return self.rows[order], taken[order].astype(np.int64)


def changes(
    before: JudgedRun, after: JudgedRun, threshold: float, iou: float, only: ErrorFilter | None = None
) -> Changes:
    """Changes from one run to another: another condition, or another method.

    Args:
        threshold: least score of a detection in both.
        iou: least bird's-eye IoU of a true positive.
        only: objects of the second run to look at; None for all.
    """
    first, second = _same_objects(before, after)
    if only is not None:
        chosen = only.objects(after)[second]
        first, second = first[chosen], second[chosen]
    had, has = before.found(threshold, iou)[first], after.found(threshold, iou)[second]
    changed = np.flatnonzero(had != has)
    first, second, has = first[changed], second[changed], has[changed]
    table, frame = after.table, after.truth_frame_of[second]
    left = [before.table.points[first, 3], table.points[second, 3]]
    titles = _titles(before, after)
    order = np.lexsort((after.truth_distance_m[second], table.position[frame]))
    second, frame, has = second[order], frame[order], has[order]
    return Changes(
        row=table.position[frame],
        frame=table.index[frame],
        object_id=table.object_id[second],
        box=table.truth[second],
        fixed=has,
        distance_m=after.truth_distance_m[second],
        points=np.stack(left, axis=1)[order].astype(np.int32),
        before=titles[0],
        after=titles[1],
        rows=np.intersect1d(before.table.position, table.position),
    )


def _titles(before: JudgedRun, after: JudgedRun) -> tuple[str, str]:
    """Titles of two runs: what differs between them."""
    titles = []
    for run in (before, after):
        alone = "" if run.setup.cooperative or before.setup.cooperative == after.setup.cooperative else ", ego alone"
        condition = run.setup.condition.label
        if before.setup.condition == after.setup.condition:
            titles.append(f"{run.method}{alone}")
        elif before.method == after.method:
            titles.append(f"{condition}{alone}")
        else:
            titles.append(f"{run.method} in {condition}{alone}")
    return titles[0], titles[1]


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
