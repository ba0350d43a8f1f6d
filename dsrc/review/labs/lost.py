"""Points that a corruption removed: what a recorded sweep has and the corrupted one lacks."""

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import ADDED, Sweep


def lost_rows(recorded: Sweep, corrupted: Sweep) -> NDArray[np.intp]:
    """Rows of the recorded sweep whose points a corruption removed, ascending.

    An untouched point has the same coordinates. A displaced one is found by its beam, and where the recording has no
    columns it is taken for the nearest point that is missing.

    Args:
        corrupted: the same under a corruption.
    """
    after = corrupted[corrupted.object_id != ADDED]
    missing = np.flatnonzero(~np.isin(_bits(recorded.points), _bits(after.points)))
    displaced = after[~np.isin(_bits(after.points), _bits(recorded.points))]
    if len(missing) == 0 or len(displaced) == 0:
        return missing
    if recorded.column.any():
        return missing[~np.isin(_beams(recorded)[missing], _beams(displaced))]
    # Imported where it is needed: it is not, before a page's first picture.
    from scipy.spatial import cKDTree

    nearest = cKDTree(recorded.points[missing]).query(displaced.points)[1]
    stays = np.ones(len(missing), bool)
    stays[nearest] = False
    return missing[stays]


def _bits(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """(P,) one number for the coordinates of each point; equal points have equal ones."""
    # Adding zero makes one of the two zeros.
    bits = np.ascontiguousarray(points + np.float32(0.0)).view(np.uint32).astype(np.uint64)
    mixed = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= bits[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)
    return mixed ^ (bits[:, 2] * np.uint64(0x165667B19E3779F9))


def _beams(sweep: Sweep) -> NDArray[np.int64]:
    """(P,) one number for the ring, the column and the place among the returns of each point."""
    beam = sweep.ring.astype(np.int64) << 40 | sweep.column.astype(np.int64) << 8
    return beam | sweep.return_number
