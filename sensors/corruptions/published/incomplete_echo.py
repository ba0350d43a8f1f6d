"""Incomplete echo, as Robo3D has it: dark vehicles return less.

Of each class of vehicles with more than 10 points int(n ratio) random points are deleted; other classes stay.

| severity                          | 1   | 2             | 3 (Robo3D light) | 4 (moderate) | 5 (heavy) |
|-----------------------------------|-----|---------------|------------------|--------------|-----------|
| share of the points deleted       | 0.4 | 0.6           | 0.75             | 0.85         | 0.95      |

Published for SemanticKITTI (car, bicycle, motorcycle, truck, other vehicle; `SEMANTIC_KITTI` has the raw labels of
each, moving ones included) and nuScenes (bicycle, bus, car, construction vehicle, motorcycle, trailer, truck), where
points have labels; a sweep has object ids, and all its objects are taken for one class. How dark a vehicle is does not
matter, nor its distance. What a lower severity deletes is among what a higher one deletes.
"""

from collections.abc import Iterable
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import at_level, check_range
from sensors.corruptions.published.cloud import Draws
from sensors.sweep import Sweep

DELETED = (0.4, 0.6, 0.75, 0.85, 0.95)

SEMANTIC_KITTI = ((10, 252), (11,), (15,), (18, 258), (13, 16, 20, 256, 257, 259))
"""Raw labels of SemanticKITTI's vehicle classes: car, bicycle, motorcycle, truck, other vehicle."""
NUSCENES = ((2,), (3,), (4,), (5,), (6,), (9,), (10,))
"""Learning ids of nuScenes' vehicle classes."""

_LEAST = 10


class IncompleteEcho(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        deleted: share of the points of a class that goes.
    """

    deleted: float = 0.75

    def __post_init__(self) -> None:
        check_range("IncompleteEcho", "deleted", self.deleted, 0.0, 1.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(deleted=at_level(DELETED, level))


PUBLISHED: dict[str, IncompleteEcho] = {
    "robo3d_light": IncompleteEcho(deleted=0.75),
    "robo3d_moderate": IncompleteEcho(deleted=0.85),
    "robo3d_heavy": IncompleteEcho(deleted=0.95),
}


def corrupt(sweep: Sweep, severity: int | IncompleteEcho, rng: Draws) -> Sweep:
    """Delete points on objects; the world and the other points stay."""
    settings = severity if isinstance(severity, IncompleteEcho) else IncompleteEcho.severity(severity)
    return sweep[remaining((sweep.object_id >= 0).astype(np.int64), ((1,),), settings, rng)]


def remaining(
    label: NDArray[np.integer], classes: Iterable[tuple[int, ...]], settings: IncompleteEcho, rng: Draws
) -> NDArray[np.bool_]:
    """Return (P,) which points are left.

    Args:
        label: (P,) of each point.
        classes: labels of each class of vehicles.
        settings: how much goes.
        rng: the only randomness.
    """
    left = np.ones(len(label), bool)
    for labels in classes:
        rows = np.flatnonzero(np.isin(label, labels))
        if len(rows) > _LEAST:
            left[rows[rng.permutation(len(rows))[: int(len(rows) * settings.deleted)]]] = False
    return left
