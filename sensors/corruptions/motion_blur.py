"""Motion blur: the platform shakes faster than its odometry can tell, so every point is displaced a little.

| severity                     | 1    | 2   | 3 (paper) | 4   | 5   |
|------------------------------|------|-----|-----------|-----|-----|
| deviation of a coordinate, m | 0.05 | 0.1 | 0.2       | 0.3 | 0.4 |

Coordinates only: an intensity doesn't shake (the released code blurs it too). Source: DSRC, section on robustness.
"""

from dataclasses import replace
from typing import Self

import msgspec
import numpy as np

from sensors.corruptions.levels import at_level, check_range
from sensors.sweep import MOVED, Sweep

DEVIATION_M = (0.05, 0.1, 0.2, 0.3, 0.4)


class MotionBlur(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        deviation_m: standard deviation of each coordinate's displacement, m.
    """

    deviation_m: float = 0.2

    def __post_init__(self) -> None:
        check_range("MotionBlur", "deviation_m", self.deviation_m, 0.0, 100.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(deviation_m=at_level(DEVIATION_M, level))


def corrupt(sweep: Sweep, severity: int | MotionBlur, rng: np.random.Generator) -> Sweep:
    """Displace every point by independent Gaussian noise; each is still a return of its object."""
    settings = severity if isinstance(severity, MotionBlur) else MotionBlur.severity(severity)
    if settings.deviation_m == 0.0:
        return sweep
    shake = rng.standard_normal(sweep.points.shape, np.float32) * np.float32(settings.deviation_m)
    return replace(sweep, points=sweep.points + shake, fate=np.full(len(sweep), MOVED, np.uint8))
