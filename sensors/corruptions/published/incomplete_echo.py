"""Incomplete echo of Robo3D: missing points on vehicles.

Of each class of vehicles with more than 10 points int(n ratio) random points are deleted; other classes stay.

| severity                          | 1   | 2             | 3 (Robo3D light) | 4 (moderate) | 5 (heavy) |
|-----------------------------------|-----|---------------|------------------|--------------|-----------|
| share of the points deleted       | 0.4 | 0.6           | 0.75             | 0.85         | 0.95      |

Published for SemanticKITTI (car, bicycle, motorcycle, truck, other vehicle; `SEMANTIC_KITTI` has the raw labels of
each, moving ones included) and nuScenes (bicycle, bus, car, construction vehicle, motorcycle, trailer, truck), where
points have labels; a sweep has object ids, and all its objects are taken for one class. Where a file has no ids, points
in the boxes of the frame's vehicles count (`in_frame`). Brightness and distance have no influence. Points deleted at a
lower severity are among those of a higher one.
"""

from collections.abc import Iterable
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.vehicles import note_unlabelled, points_on_vehicles
from sensors.corruptions.published.cloud import RandomSource
from sensors.frame import Frame
from sensors.sweep import Sweep

SEMANTIC_KITTI = ((10, 252), (11,), (15,), (18, 258), (13, 16, 20, 256, 257, 259))
"""Raw labels of SemanticKITTI's vehicle classes: car, bicycle, motorcycle, truck, other vehicle."""

_LEAST = 10


class PaperIncompleteEcho(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        deleted: share of the points of a class that is deleted.
    """

    LEVELS: ClassVar = {"deleted": (0.4, 0.6, 0.75, 0.85, 0.95)}
    RANGES: ClassVar = {"deleted": (0.0, 1.0)}

    deleted: float = 0.75


PUBLISHED: dict[str, PaperIncompleteEcho] = {
    "robo3d_light": PaperIncompleteEcho(deleted=0.75),
    "robo3d_moderate": PaperIncompleteEcho(deleted=0.85),
    "robo3d_heavy": PaperIncompleteEcho(deleted=0.95),
}


def corrupt(sweep: Sweep, settings: PaperIncompleteEcho, rng: RandomSource) -> Sweep:
    """Delete points on objects; the others are unchanged."""
    note_unlabelled(sweep, "ids of objects, or a frame with their boxes (corrupt_frame)")
    return _without(sweep, sweep.object_id >= 0, settings, rng)


def in_frame(frame: Frame, row: int, settings: PaperIncompleteEcho, rng: RandomSource) -> Sweep:
    """Delete points on objects of the agent in a row of `frame.agents`, by its ids or else by the frame's boxes."""
    sweep = frame.agents[row].sweep
    on = sweep.object_id >= 0
    return _without(sweep, on if on.any() else points_on_vehicles(frame, row), settings, rng)


def _without(sweep: Sweep, on: NDArray[np.bool_], settings: PaperIncompleteEcho, rng: RandomSource) -> Sweep:
    return sweep[remaining_points(on.astype(np.int64), ((1,),), settings, rng)]


def remaining_points(
    label: NDArray[np.integer], classes: Iterable[tuple[int, ...]], settings: PaperIncompleteEcho, rng: RandomSource
) -> NDArray[np.bool_]:
    """Return (P,) mask of the remaining points.

    Args:
        label: (P,) of each point.
        classes: labels of each class of vehicles.
    """
    left = np.ones(len(label), bool)
    for labels in classes:
        rows = np.flatnonzero(np.isin(label, labels))
        if len(rows) > _LEAST:
            left[rows[rng.permutation(len(rows))[: int(len(rows) * settings.deleted)]]] = False
    return left
