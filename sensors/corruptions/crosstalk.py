"""Crosstalk: pulses of other LiDARs are taken for own returns.

| severity           | 1   | 2   | 3 (paper) | 4 | 5 |
|--------------------|-----|-----|-----------|---|---|
| share of points, % | 0.2 | 0.5 | 1         | 2 | 4 |

A touched point is displaced by noise of 3 m in every coordinate (paper), or along its ray: a receiver that mistakes a
foreign pulse is wrong in time of flight and never in direction (`along_ray`). Intensities stay, and touched points
belong to no object. With one random stream the points of a lower severity are among those of a higher one. Source:
DSRC, section on robustness.
"""

from dataclasses import replace
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.levels import at_level, check_range
from sensors.sweep import ADDED, SCATTERED, Sweep

SHARE = (0.002, 0.005, 0.01, 0.02, 0.04)


class Crosstalk(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        share: share of the points that are touched.
        deviation_m: standard deviation of the displacement, m.
        along_ray: displace along the ray instead of in every coordinate.
    """

    share: float = 0.01
    deviation_m: float = 3.0
    along_ray: bool = False

    def __post_init__(self) -> None:
        check_range("Crosstalk", "share", self.share, 0.0, 1.0)
        check_range("Crosstalk", "deviation_m", self.deviation_m, 0.0, 1000.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(share=at_level(SHARE, level))


def corrupt(sweep: Sweep, severity: int | Crosstalk, rng: np.random.Generator) -> Sweep:
    """Displace `int(share * P)` of the P points; the others stay bit-identical."""
    settings = severity if isinstance(severity, Crosstalk) else Crosstalk.severity(severity)
    touched = rng.permutation(len(sweep))[: int(settings.share * len(sweep))]
    points, object_id, fate = sweep.points.copy(), sweep.object_id.copy(), sweep.fate.copy()
    if settings.along_ray:
        points[touched] = _slide(sweep[touched], settings.deviation_m, rng)
    else:
        points[touched] += rng.normal(0.0, settings.deviation_m, (len(touched), 3)).astype(np.float32)
    object_id[touched] = ADDED
    fate[touched] = SCATTERED
    return replace(sweep, points=points, object_id=object_id, fate=fate)


def _slide(sweep: Sweep, deviation_m: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return (P, 3) the points displaced along their rays, within the sensor's ranges."""
    near, far = (0.0, np.inf) if sweep.spec is None else (sweep.spec.range_min_m, sweep.spec.range_max_m)
    reach = np.maximum(sweep.range.astype(np.float64), 1e-6)
    displaced = np.clip(reach + rng.normal(0.0, deviation_m, len(sweep)), near, far)
    return (sweep.points * (displaced / reach)[:, None]).astype(np.float32)
