"""Snow: attenuated targets, and the strongest flake before each.

| severity                           | 1    | 2    | 3    | 4    | 5    |
|------------------------------------|------|------|------|------|------|
| snowfall, mm/h of water            | 0.1  | 0.25 | 0.5  | 1.5  | 5    |
| extinction, 1/km                   | 0.99 | 1.60 | 2.29 | 4.06 | 7.59 |
| visibility ln(20) / extinction, km | 3.0  | 1.9  | 1.3  | 0.74 | 0.39 |

Level 3 is the snowfall of DSRC's code (the published model's light snow); the paper gives none. Flakes fall at
1 m/s, as aggregates do (Locatelli and Hobbs 1974); the published 2 m/s halves everything. Weather services call snow
light above 1 km of visibility and heavy below 0.4 km.

A target at range r returns power exp(-2 alpha r), the strongest flake before it reflectivity D^2 / (divergence^2 r^4),
and the sensor reports the stronger one, if it reaches the detection threshold (`medium`). Flakes fill the widening
beam; the strongest is drawn from its law (`strongest`). The many others are a homogeneous medium: extinction.

Diameters follow Gunn and Marshall (1958). Extinction is twice the flakes' cross-section (large particles, van de Hulst
1957). A flake that fills a beam counts as a surface of reflectivity 2 pi / S with S = 30 sr, the ratio of extinction to
backscatter that lidars find for ice (33 +- 5 sr: Josset et al. 2012).

Differences from the published model (Hahner et al., CVPR 2022): flakes fill the air instead of one plane per ring,
where a flat disc at range r takes D / (divergence r) of a beam instead of the square of that and far flakes are
overstated; the target keeps its own power (there, a target behind any flake gets the flake's), the optics are the
sweep's sensor instead of an HDL-64E's, the noise floor is the sensor's detection threshold, heavier snow takes more
(see `snow_flakes`), beams without a target return flakes, and azimuth 0 is like any other.
"""

from typing import ClassVar

import numpy as np

from sensors.corruptions.physics.levels import WeatherSettings
from sensors.corruptions.physics.medium import rays_of, report
from sensors.corruptions.physics.snow_flakes import snow_particles
from sensors.corruptions.physics.strongest import strongest_particle
from sensors.sweep import Sweep


class Snow(WeatherSettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        snowfall_mm_h: snowfall, mm/h of water.
        fall_speed_mps: terminal velocity of the flakes, m/s.
        flake_density: relative to water.
        flake_reflectivity: of a flake as wide as the beam.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    LEVELS: ClassVar = {"snowfall_mm_h": (0.1, 0.25, 0.5, 1.5, 5.0)}
    STRENGTH: ClassVar = ("snowfall_mm_h",)
    RANGES: ClassVar = {
        "snowfall_mm_h": (0.0, 50.0),
        "fall_speed_mps": (0.1, 10.0),
        "flake_density": (0.01, 1.0),
        "flake_reflectivity": (0.0, 1.0),
    }

    snowfall_mm_h: float = 0.5
    fall_speed_mps: float = 1.0
    flake_density: float = 0.1
    flake_reflectivity: float = 0.2
    range_10_m: float | None = None


def corrupt(sweep: Sweep, snow: Snow, rng: np.random.Generator) -> Sweep:
    """Dim, replace or remove returns; flakes' lie nearer on the same rays, and on rays without a target."""
    if snow.snowfall_mm_h == 0.0:
        return sweep
    particles = snow_particles(snow.snowfall_mm_h, snow.fall_speed_mps, snow.flake_density, snow.flake_reflectivity)
    rays = rays_of(sweep, snow.range_10_m, rng)
    transmission = np.exp(-2.0 * particles.extinction * rays.reach[: len(sweep)])
    return report(rays, transmission, strongest_particle(particles, rays, transmission, rng))
