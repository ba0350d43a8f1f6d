"""Field of view: a sector ahead; the rest is blocked or switched off.

| severity                                | 1    | 2   | 3    | 4   | 5   |
|-----------------------------------------|------|-----|------|-----|-----|
| visible to either side of ahead, deg    | 105  | 90  | 75   | 60  | 45  |

The angles are those of Dong et al. (CVPR 2023), who count them from +y, which is straight ahead on nuScenes' sensor
and to the left on most. Here ahead is +x, or `middle_deg`. The corruption is deterministic.
"""

import math
from typing import Self

import msgspec
import numpy as np

from sensors.corruptions.physics.levels import at_level, check_range
from sensors.sweep import Sweep

HALF_WIDTH_DEG = (105.0, 90.0, 75.0, 60.0, 45.0)

_ROUNDING_RAD = 1e-6


class FieldOfView(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        half_width_deg: visible sector to either side of the middle.
        middle_deg: azimuth of the middle, counter-clockwise from straight ahead.
    """

    half_width_deg: float = 75.0
    middle_deg: float = 0.0

    def __post_init__(self) -> None:
        check_range("FieldOfView", "half_width_deg", self.half_width_deg, 0.0, 180.0)
        check_range("FieldOfView", "middle_deg", self.middle_deg, -360.0, 360.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(half_width_deg=at_level(HALF_WIDTH_DEG, level))


def corrupt(sweep: Sweep, severity: int | FieldOfView, rng: np.random.Generator) -> Sweep:
    """Keep the points inside the sector, borders included, unchanged; `rng` is unused."""
    settings = severity if isinstance(severity, FieldOfView) else FieldOfView.severity(severity)
    if settings.half_width_deg == 180.0:
        return sweep
    middle = math.radians(settings.middle_deg)
    x, y = sweep.points[:, 0], sweep.points[:, 1]
    ahead = x * np.float32(math.cos(middle)) + y * np.float32(math.sin(middle))
    aside = y * np.float32(math.cos(middle)) - x * np.float32(math.sin(middle))
    return sweep[np.abs(np.arctan2(aside, ahead)) <= np.float32(math.radians(settings.half_width_deg) + _ROUNDING_RAD)]
