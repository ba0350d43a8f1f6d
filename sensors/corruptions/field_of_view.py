"""Field of view: a sector ahead; the rest is blocked or switched off.

| severity                                | 1    | 2   | 3    | 4   | 5   |
|-----------------------------------------|------|-----|------|-----|-----|
| visible to either side of ahead, deg    | 105  | 90  | 75   | 60  | 45  |

The angles are those of Dong et al. (CVPR 2023), who count them from +y, which is straight ahead on nuScenes' sensor
and to the left on most. Here ahead is +x, or `middle_deg`. The corruption is deterministic.
"""

import math
from typing import ClassVar

import numpy as np

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.sweep import Sweep

_ROUNDING_RAD = 1e-6


class FieldOfView(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        half_width_deg: visible sector to either side of the middle.
        middle_deg: azimuth of the middle, counter-clockwise from straight ahead.
    """

    LEVELS: ClassVar = {"half_width_deg": (105.0, 90.0, 75.0, 60.0, 45.0)}
    RANGES: ClassVar = {"half_width_deg": (0.0, 180.0), "middle_deg": (-360.0, 360.0)}

    half_width_deg: float = 75.0
    middle_deg: float = 0.0


def corrupt(sweep: Sweep, settings: FieldOfView, rng: np.random.Generator) -> Sweep:
    """Keep the points inside the sector, borders included, unchanged; `rng` is unused."""
    if settings.half_width_deg == 180.0:
        return sweep
    middle = math.radians(settings.middle_deg)
    x, y = sweep.points[:, 0], sweep.points[:, 1]
    ahead = x * np.float32(math.cos(middle)) + y * np.float32(math.sin(middle))
    aside = y * np.float32(math.cos(middle)) - x * np.float32(math.sin(middle))
    return sweep[np.abs(np.arctan2(aside, ahead)) <= np.float32(math.radians(settings.half_width_deg) + _ROUNDING_RAD)]
