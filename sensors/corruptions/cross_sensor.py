"""Cross sensor: a model trained on one LiDAR meets a cheaper one, with fewer beams and fewer firings per rotation.

| severity               | 1  | 2  | 3 (paper) | 4  | 5  |
|------------------------|----|----|-----------|----|----|
| rings removed, of 64   | 16 | 32 | 32        | 48 | 48 |
| one firing kept of     | 1  | 1  | 2         | 2  | 4  |

Rings are removed evenly, ring 0 stays. Firings are thinned by their column, which doubles the azimuth step of every
ring as a slower sensor's is (Wei 2022, LiDAR-Distillation, which the paper cites); `thin_by="index"` keeps every n-th
point of the list instead, whose phase slips from ring to ring, as the released code does. Nothing is random here.
"""

from typing import Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.levels import at_level, check_range, share_of
from sensors.corruptions.receiver import known_ring_count
from sensors.sweep import Sweep

RINGS_OF_64 = (16, 32, 32, 48, 48)
KEEP_ONE_OF = (1, 1, 2, 2, 4)


class CrossSensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rings_of_64: rings removed from a sensor of 64 rings; from others in proportion.
        keep_one_of: of so many firings one is kept.
        thin_by: `column` keeps columns that are multiples, `index` every n-th point of the list.
    """

    rings_of_64: int = 32
    keep_one_of: int = 2
    thin_by: Literal["column", "index"] = "column"

    def __post_init__(self) -> None:
        check_range("CrossSensor", "rings_of_64", self.rings_of_64, 0, 63)
        check_range("CrossSensor", "keep_one_of", self.keep_one_of, 1, 1000)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(rings_of_64=at_level(RINGS_OF_64, level), keep_one_of=at_level(KEEP_ONE_OF, level))


def corrupt(sweep: Sweep, severity: int | CrossSensor, rng: np.random.Generator) -> Sweep:
    """Return the points that the other sensor would have had; `rng` is not used.

    Raises:
        DataError: the sweep does not know its rings.
    """
    settings = severity if isinstance(severity, CrossSensor) else CrossSensor.severity(severity)
    rings = known_ring_count(sweep, "cross_sensor")
    present = np.ones(rings, bool)
    present[removed_rings(rings, share_of(rings, settings.rings_of_64))] = False
    thinned = sweep[present[sweep.ring]]
    if settings.thin_by == "index":
        return thinned[:: settings.keep_one_of]
    return thinned[_column(thinned) % settings.keep_one_of == 0]


def removed_rings(rings: int, removed: int) -> NDArray[np.int64]:
    """Return which of `rings` rings go: `removed` of them, evenly, the first of them ring 1."""
    removed = min(removed, rings - 1)
    if removed <= 0:
        return np.zeros(0, np.int64)
    return 1 + np.arange(removed) * rings // removed


def _column(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) columns; the place of a point within its ring when the sweep doesn't know its columns."""
    if len(sweep) == 0 or sweep.column.any():
        return sweep.column.astype(np.int64)
    order = np.argsort(sweep.ring, kind="stable")
    sorted_ring = sweep.ring[order]
    place = np.zeros(len(sweep), np.int64)
    place[order] = np.arange(len(sweep)) - np.searchsorted(sorted_ring, sorted_ring)
    return place
