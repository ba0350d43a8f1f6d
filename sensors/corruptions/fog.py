"""Fog: it dims what lies behind it and answers the pulse itself (Hahner et al., ICCV 2021).

| severity                                     | 1     | 2    | 3    | 4    | 5    |
|----------------------------------------------|-------|------|------|------|------|
| visibility (meteorological optical range), m | 400   | 200  | 100  | 50   | 25   |
| extinction ln(20) / visibility, 1/km         | 7.5   | 15   | 30   | 60   | 120  |
| backscatter 0.046 / visibility, 1/(km sr)    | 0.115 | 0.23 | 0.46 | 0.92 | 1.84 |

The paper gives no number. Level 3 is the 0.03 per metre of its released code's draw (0 to 0.06), and a target of
reflectivity 0.15 then drowns in the fog beyond some 40 m, where that code's fog takes over.

A target at range r returns i exp(-2 alpha r) / r^2, the fog its own echo (`fog_echo`). The sensor reports the stronger
one, if it detects it at all. What differs from the published code, because a sensor's physics asks for it:

* Backscatter follows from the visibility instead of being a second, free number.
* The echo of the fog depends on the fog and the sensor, not on how bright the target behind it happens to be: dark
  targets drown first. (A target of intensity 1 drowns at exactly the published range.)
* A return too weak for the receiver is lost.
* The fog's return lies where the echo's waveform says, shifted by the half pulse that every range is measured with,
  and spread as that waveform is: fog is patchy, and its strongest spot lies anywhere along the echo. It is never
  behind its target, and it is as dim as fog is.
"""

import math
from dataclasses import replace
from typing import Self

import msgspec
import numpy as np

from sensors.corruptions.fog_echo import fog_echo
from sensors.corruptions.levels import at_level, check_range
from sensors.corruptions.receiver import least_power
from sensors.sweep import ADDED, ATTENUATED, SCATTERED, Sweep

VISIBILITY_M = (400.0, 200.0, 100.0, 50.0, 25.0)

TARGET_BACKSCATTER = 1e-6 / math.pi
"""Backscatter of a target of intensity 1 on the scale of the echo's integral (Hahner 2021, beta_0)."""

PULSE_S = 2e-8
"""Length at half power of the pulse when the sensor is not known (Hahner 2021)."""


class Fog(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        extinction: alpha, 1/m.
        backscatter: beta, 1/(m sr).
        pulse_s: pulse length at half power; None for the sensor's own.
        range_10_m: see `LidarSpec`; None for the sensor's own, infinity for a receiver that detects everything.
    """

    extinction: float = math.log(20.0) / 100.0
    backscatter: float = 0.046 / 100.0
    pulse_s: float | None = None
    range_10_m: float | None = None

    def __post_init__(self) -> None:
        check_range("Fog", "extinction", self.extinction, 0.0, 10.0)
        check_range("Fog", "backscatter", self.backscatter, 0.0, 10.0)

    @classmethod
    def of_visibility(cls, visibility_m: float) -> Self:
        """Return the fog in which one sees so far: contrast falls to 5 % (WMO), droplets as in Rasshofer 2011."""
        check_range("Fog", "visibility_m", visibility_m, 1.0, math.inf)
        return cls(extinction=math.log(20.0) / visibility_m, backscatter=0.046 / visibility_m)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls.of_visibility(at_level(VISIBILITY_M, level))


def corrupt(sweep: Sweep, severity: int | Fog, rng: np.random.Generator) -> Sweep:
    """Dim, replace or lose the returns; the fog's own returns lie on the same rays, nearer, on no object."""
    fog = severity if isinstance(severity, Fog) else Fog.severity(severity)
    if fog.extinction == fog.backscatter == 0.0:
        return sweep
    reach = np.linalg.norm(sweep.points.astype(np.float64), axis=1)
    echo = fog_echo(fog.extinction, _pulse(sweep, fog))
    dimmed = sweep.intensity * np.exp(-2.0 * fog.extinction * reach)
    hard = dimmed / np.maximum(reach, 1e-6) ** 2
    soft = echo.peak(reach) * (fog.backscatter / TARGET_BACKSCATTER)
    drowned = soft > hard
    # One draw for every point: whether a point drowns must not shift the draws of the others.
    place = np.where(drowned, echo.place(rng.random(len(sweep)), reach), reach)

    points = sweep.points.copy()
    points[drowned] = (sweep.points * (place / np.maximum(reach, 1e-6))[:, None])[drowned].astype(np.float32)
    clouded = replace(
        sweep,
        points=points,
        intensity=np.where(drowned, np.minimum(soft * place**2, 1.0), dimmed).astype(np.float32),
        object_id=np.where(drowned, ADDED, sweep.object_id).astype(np.int32),
        fate=np.where(drowned, SCATTERED, ATTENUATED).astype(np.uint8),
    )
    return clouded[np.maximum(hard, soft) >= least_power(sweep.spec, fog.range_10_m)]


def _pulse(sweep: Sweep, fog: Fog) -> float:
    if fog.pulse_s is not None:
        return fog.pulse_s
    return PULSE_S if sweep.spec is None else sweep.spec.pulse_s
