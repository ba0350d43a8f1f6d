"""Number and sizes of the flakes of falling snow.

Snow falling at s mm/h of water with speed v fills the share O = s / (3.6e6 rho v) of the air, and its flakes' diameters
are distributed exponentially with rate L (Gunn and Marshall 1958), so there are O L^3 / pi per cubic metre. They cover
O L / 2 of a thin ray per metre.

Two differences from the published code, whose heavier snow has fewer flakes and touches fewer beams: Gunn and
Marshall's law takes the snowfall s in mm/h of water (the code converts it a second time), and gives diameters of melted
flakes, smaller than the flakes by the cube root of the densities. At the paper's
0.5 mm/h the rate is 16.5 per cm here and 17.3 there.
"""

import math

from sensors.corruptions.physics.strongest import Particles


def occupancy(snowfall_mm_h: float, fall_speed_mps: float, density: float) -> float:
    """Return O, the share of the air that is snow; `density` of the flakes relative to water."""
    return snowfall_mm_h / (3.6e6 * density * fall_speed_mps)


def gunn_marshall_rate(water_mm_h: float) -> float:
    """Return the rate of the exponential law of melted diameters, 1/m."""
    return 2550.0 * water_mm_h**-0.48


def flake_rate(snowfall_mm_h: float, density: float) -> float:
    """Return L, the rate of the exponential law of the flakes' diameters, 1/m."""
    return gunn_marshall_rate(snowfall_mm_h) * density ** (1.0 / 3.0)


def snow_particles(snowfall_mm_h: float, fall_speed_mps: float, density: float, reflectivity: float) -> Particles:
    """Return falling snow as a medium of particles; extinction is twice the cross-section per volume."""
    filled = occupancy(snowfall_mm_h, fall_speed_mps, density)
    rate = flake_rate(snowfall_mm_h, density)
    return Particles(
        per_m3=filled * rate**3 / math.pi, rate_per_m=rate, reflectivity=reflectivity, extinction=filled * rate
    )
