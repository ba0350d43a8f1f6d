"""Fog: attenuated targets and backscatter of the fog itself (Hahner et al., ICCV 2021).

| severity                                     | 1     | 2    | 3    | 4    | 5    |
|----------------------------------------------|-------|------|------|------|------|
| visibility (meteorological optical range), m | 400   | 200  | 100  | 50   | 25   |
| extinction ln(20) / visibility, 1/km         | 7.5   | 15   | 30   | 60   | 120  |
| backscatter 0.046 / visibility, 1/(km sr)    | 0.115 | 0.23 | 0.46 | 0.92 | 1.84 |

The paper gives no number. Level 3 is the 0.03 per metre of its released code's draw (0 to 0.06), and a target of
reflectivity 0.15 then drowns in the fog beyond some 40 m, as in that code.

A target at range r returns power exp(-2 alpha r), the fog its own echo (`fog_echo`). The sensor reports the stronger
one, if it reaches the detection threshold (`medium`). Differences from the published code, for physical reasons:

* Backscatter follows from the visibility instead of being a second, free number.
* The echo of the fog depends on the fog and the sensor, not on the brightness of the target behind it: dark targets
  drown first. (In homogeneous fog a target of intensity 1 drowns at exactly the published range.)
* Returns below the detection threshold are lost, and beams without a target return fog.
* The fog's return has the range of its waveform, without the half pulse by which the published table is too far, and
  the intensity of fog. It is never behind its target. Patchiness spreads the returns; the published code adds noise.
"""

import math
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.fog_echo import MOST_EXTINCTION, fog_echo
from sensors.corruptions.physics.levels import WeatherSettings, at_level, check_range
from sensors.corruptions.physics.medium import Echo, Rays, rays_of, report
from sensors.sweep import Sweep

VISIBILITY_M = (400.0, 200.0, 100.0, 50.0, 25.0)

TARGET_BACKSCATTER = 1e-6 / math.pi
"""Backscatter of a target of intensity 1 on the scale of the echo's integral (Hahner 2021, beta_0).

The published figure is kept. In its units a white surface would have 2 / (pi c) = 2.1e-9 s/m, so that fog would be 150
times as strong: real receivers reduce their gain at close range, by an unpublished amount."""

DEFAULT_PULSE_S = 2e-8
"""Pulse length at half power of an unknown sensor, s (Hahner 2021)."""

_CONTRAST = math.log(20.0)
_BACKSCATTER = 0.046


class Fog(WeatherSettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        extinction: alpha, 1/m.
        backscatter: beta, 1/(m sr).
        patchiness: of the fog's density within metres, see `fog_echo`: 0.4 for a deviation as large as the mean.
        pulse_s: pulse length at half power; None for the sensor's own.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    STRENGTH: ClassVar = ("extinction", "backscatter")
    RANGES: ClassVar = {
        "extinction": (0.0, MOST_EXTINCTION),
        "backscatter": (0.0, 10.0),
        "patchiness": (1e-3, 0.45),
        "pulse_s": (1e-12, 1e-6),
    }

    extinction: float = _CONTRAST / 100.0
    backscatter: float = _BACKSCATTER / 100.0
    patchiness: float = 0.4
    pulse_s: float | None = None
    range_10_m: float | None = None

    @classmethod
    def of_visibility(cls, visibility_m: float) -> Self:
        """Return the fog of a visibility: contrast falls to 5 % (WMO), droplets as in Rasshofer 2011."""
        check_range("Fog", "visibility_m", visibility_m, _CONTRAST / MOST_EXTINCTION, math.inf)
        return cls(extinction=_CONTRAST / visibility_m, backscatter=_BACKSCATTER / visibility_m)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls.of_visibility(at_level(VISIBILITY_M, level))


def corrupt(sweep: Sweep, fog: Fog, rng: np.random.Generator) -> Sweep:
    """Dim, replace or remove returns; the fog's lie nearer on the same rays, and on rays without a target."""
    if fog.extinction == fog.backscatter == 0.0:
        return sweep
    rays = rays_of(sweep, fog.range_10_m, rng)
    transmission = np.exp(-2.0 * fog.extinction * rays.reach[: len(sweep)])
    return report(rays, transmission, _fog_echoes(fog, rays, transmission, rng))


def _fog_echoes(fog: Fog, rays: Rays, transmission: NDArray[np.float64], rng: np.random.Generator) -> Echo:
    """Draw the fog's echo on each ray where it could exceed the target and the threshold."""
    pulse_s, spec = fog.pulse_s, rays.sweep.spec
    if pulse_s is None:
        pulse_s = DEFAULT_PULSE_S if spec is None else spec.pulse_s
    echo = fog_echo(fog.extinction, pulse_s, fog.patchiness)
    strength, quantile = rays.draw(rng.standard_exponential), rays.draw(rng.random)
    scale = fog.backscatter / TARGET_BACKSCATTER
    floor = rays.floor(transmission)
    # Candidates by the echo of all the fog, an upper bound; then the echo of the fog before the target.
    candidate = np.flatnonzero(scale * echo.strongest(echo.cumulated[-1], strength) > floor)
    near, far = rays.near[candidate], rays.reach[candidate]
    between = np.maximum(echo.cells(far) - echo.cells(near), 0.0)
    echoes = Echo(np.zeros(len(rays)), np.zeros(len(rays)))
    echoes.power[candidate] = scale * echo.strongest(between, strength[candidate])
    echoes.range_m[candidate] = echo.place(quantile[candidate], near, far)
    return echoes
