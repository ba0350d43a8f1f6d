"""Velocities of objects from their positions a frame earlier and later, for datasets without velocities."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes

LONGEST_GAP_S = 0.5
"""Longest time between two frames of one track."""


class TimedBoxes(NamedTuple):
    """Boxes of all objects at one time."""

    time_s: float
    boxes: Boxes


def tracked_velocity(now: TimedBoxes, before: TimedBoxes | None, after: TimedBoxes | None) -> NDArray[np.float64]:
    """Return (N, 2) velocities in the plane, m/s, by finite differences; NaN for objects in neither neighbour.

    Args:
        now: boxes of the frame; equal ids are one object.
        before: boxes of the frame before; together with `after` they give a central difference.
        after: boxes of the frame after.
    """
    first, last = _found(now, before), _found(now, after)
    start = np.where(np.isnan(first), [*now.boxes.center[:, :2].T, np.full(len(now.boxes), now.time_s)], first)
    end = np.where(np.isnan(last), [*now.boxes.center[:, :2].T, np.full(len(now.boxes), now.time_s)], last)
    gap = end[2] - start[2]
    known = (gap > 0.0) & (gap <= 2.0 * LONGEST_GAP_S)
    velocity = np.full((len(now.boxes), 2), np.nan)
    velocity[known] = ((end[:2] - start[:2])[:, known] / gap[known]).T
    return velocity


def _found(now: TimedBoxes, other: TimedBoxes | None) -> NDArray[np.float64]:
    """Return (3, N) x, y and time of the objects of `now` in another frame, NaN for missing ones."""
    rows = np.full((3, len(now.boxes)), np.nan)
    if other is None or abs(other.time_s - now.time_s) > LONGEST_GAP_S or len(other.boxes) == 0:
        return rows
    _, mine, theirs = np.intersect1d(now.boxes.object_id, other.boxes.object_id, return_indices=True)
    rows[:2, mine] = other.boxes.center[theirs, :2].T
    rows[2, mine] = other.time_s
    return rows
