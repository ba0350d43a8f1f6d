"""Rain: attenuated targets, and the strongest drop before each (after LISA: Kilic et al. 2021).

| severity                | 1    | 2    | 3    | 4    | 5    |
|-------------------------|------|------|------|------|------|
| rain, mm/h              | 2    | 8    | 25   | 60   | 120  |
| extinction, 1/km        | 0.57 | 1.36 | 2.79 | 4.85 | 7.5  |

Light, moderate, heavy, violent, and a cloudburst. Rain at 905 nm is a weak corruption: published levels end at 7 mm/h,
where a target at 50 m loses an eighth of its power.

Drops have Marshall and Palmer's (1948) diameters: N0 exp(-L D) per cubic metre and metre of diameter, N0 = 8e6 / m^4,
L = 4100 R^-0.21 / m at R mm/h. A drop takes Q times its cross-section out of the beam. For drops much larger than the
wavelength Mie's theory goes to Q = 2 + 2 x^(-2/3), x = pi D / wavelength (Nussenzveig and Wiscombe 1980), which
integrates to

    alpha = pi / 4 N0 (4 / L^3 + 2 (pi / wavelength)^(-2/3) Gamma(7/3) / L^(7/3)),

within 1 % of the sum over the full theory (and of 3.65e-4 R^0.63 / m). The power of a target falls by exp(-2 alpha r);
the strongest drop before it, reflectivity F D^2 / (divergence^2 r^4) with F = |(m - 1) / (m + 1)|^2 of water (m =
1.328), is drawn from its law (`strongest`), and the stronger one is reported if it reaches the detection threshold
(`medium`).

Ranges of the remaining targets are noisier: their deviation is accuracy / sqrt(2 signal-to-noise), the signal relative
to the detection threshold. Sweeps have the noise of clear air already, so only the difference is added.
"""

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import WeatherSettings
from sensors.corruptions.physics.medium import Rays, rays_of, report
from sensors.corruptions.physics.strongest import Particles, strongest_particle
from sensors.sweep import Sweep

WATER_INDEX = 1.328
"""Refractive index of water at 905 nm."""

_INTERCEPT_PER_M4 = 8e6
_WAVELENGTH_M = 905e-9


class Rain(WeatherSettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rain_mm_h: rain rate, mm/h.
        drop_reflectivity: of a drop as wide as the beam.
        range_accuracy_m: range deviation of a signal half as strong as the detection threshold, m.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    LEVELS: ClassVar = {"rain_mm_h": (2.0, 8.0, 25.0, 60.0, 120.0)}
    STRENGTH: ClassVar = ("rain_mm_h",)
    RANGES: ClassVar = {
        "rain_mm_h": (0.0, 300.0),
        "drop_reflectivity": (0.0, 1.0),
        "range_accuracy_m": (0.0, 1.0),
    }

    rain_mm_h: float = 25.0
    drop_reflectivity: float = ((WATER_INDEX - 1.0) / (WATER_INDEX + 1.0)) ** 2
    range_accuracy_m: float = 0.09
    range_10_m: float | None = None


def corrupt(sweep: Sweep, rain: Rain, rng: np.random.Generator) -> Sweep:
    """Dim, shift, replace or remove returns; drops' lie nearer on the same rays, and on rays without a target.

    Remaining targets are `ATTENUATED`: their shift along the ray is range noise of millimetres.
    """
    if rain.rain_mm_h == 0.0:
        return sweep
    drops = rain_particles(rain.rain_mm_h, rain.drop_reflectivity)
    rays = rays_of(sweep, rain.range_10_m, rng)
    transmission = np.exp(-2.0 * drops.extinction * rays.reach[: len(sweep)])
    noise = rays.draw(rng.standard_normal)[: len(sweep)]
    shift_m = noise * added_deviation(rays, transmission, rain.range_accuracy_m)
    return report(rays, transmission, strongest_particle(drops, rays, transmission, rng), shift_m)


def added_deviation(rays: Rays, transmission: NDArray[np.float64], accuracy_m: float) -> NDArray[np.float64]:
    """Return (P,) deviation to add to the ranges of clear air, m, for a signal reduced by `transmission`."""
    clear = rays.power[: len(transmission)]
    noise = rays.threshold / np.maximum(clear, np.finfo(np.float64).tiny)
    return accuracy_m * np.sqrt(0.5 * noise * (1.0 / np.maximum(transmission, 1e-12) - 1.0))


def rain_particles(rain_mm_h: float, reflectivity: float) -> Particles:
    """Return rain as a medium of particles."""
    rate = 4100.0 * rain_mm_h**-0.21
    edge = 2.0 * (math.pi / _WAVELENGTH_M) ** (-2.0 / 3.0) * math.gamma(7.0 / 3.0) / rate ** (7.0 / 3.0)
    return Particles(
        per_m3=_INTERCEPT_PER_M4 / rate,
        rate_per_m=rate,
        reflectivity=reflectivity,
        extinction=0.25 * math.pi * _INTERCEPT_PER_M4 * (4.0 / rate**3 + edge),
    )
