"""Falling snow as discs in the surface that a ring of a LiDAR sweeps (Hahner et al., CVPR 2022).

Snow falling at s mm/h of water with speed v fills the share O = s / (3.6e6 rho v) of the air, and its flakes' diameters
are distributed exponentially with rate Lambda (Gunn and Marshall 1958). A plane through it cuts a flake with a chance
proportional to its diameter, at a uniform height: so the discs' diameters before the cut follow D exp(-Lambda D), and
the discs block exactly the share of a ray that the flakes block, O Lambda / 2 per metre.

Two things differ from the published code, whose heavier snow has fewer flakes and touches fewer beams: Gunn and
Marshall's law takes the snowfall in mm/h of water, which is what s is (the code converts it a second time), and gives
diameters of the drops that flakes melt to, smaller than the flakes by the cube root of the densities. At the paper's
0.5 mm/h the rate is 16.5 per cm here and 17.3 there.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.receiver import BLIND_M

DISC_RADIUS_M = 80.0
"""Flakes are followed one by one up to this range; beyond it snow is a haze."""

POOL = 64
"""Samples of the medium; every ring of every sweep gets one of them, turned at random."""

_LARGEST_M = 0.02
_POOL_SEED = 2022


@dataclass(frozen=True, slots=True, eq=False)
class Flakes:
    """F discs in a plane around the sensor, nearest first.

    Attributes:
        range_m: (F,) distance of the centre.
        azimuth: (F,) direction of the centre, [0, 2 pi).
        half_width: (F,) angle between centre and edge as seen from the sensor, rad.
    """

    range_m: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    half_width: NDArray[np.float64]


def occupancy(snowfall_mm_h: float, fall_speed_mps: float, density: float) -> float:
    """Return the share of the air that is snow; density of the flakes relative to water."""
    return snowfall_mm_h / (3.6e6 * density * fall_speed_mps)


def gunn_marshall_rate(water_mm_h: float) -> float:
    """Return the rate of the exponential law of melted diameters, 1/m."""
    return 2550.0 * water_mm_h**-0.48


def flake_rate(snowfall_mm_h: float, density: float) -> float:
    """Return Lambda, the rate of the exponential law of the flakes' diameters, 1/m."""
    return gunn_marshall_rate(snowfall_mm_h) * density ** (1.0 / 3.0)


def extinction(snowfall_mm_h: float, fall_speed_mps: float, density: float) -> float:
    """Return the share of a thin ray that flakes block, 1/m."""
    return 0.5 * occupancy(snowfall_mm_h, fall_speed_mps, density) * flake_rate(snowfall_mm_h, density)


@lru_cache(maxsize=8)
def flake_pool(snowfall_mm_h: float, fall_speed_mps: float, density: float) -> tuple[Flakes, ...]:
    """Return `POOL` samples of one snowfall, the same ones in every process."""
    rng = np.random.default_rng(np.random.SeedSequence(_POOL_SEED))
    filled = occupancy(snowfall_mm_h, fall_speed_mps, density)
    rate = flake_rate(snowfall_mm_h, density)
    return tuple(sample_flakes(filled, rate, rng) for _ in range(POOL))


def sample_flakes(filled: float, rate: float, rng: np.random.Generator) -> Flakes:
    """Sample the discs that a plane cuts out of snow.

    Args:
        filled: share of the air, and of the plane, that is snow.
        rate: Lambda, 1/m.
        rng: the only randomness.
    """
    # Mean area of a disc is pi / rate^2. Discs overlap so rarely (share ~1e-6) that none needs to be rejected.
    area = math.pi * (DISC_RADIUS_M**2 - BLIND_M**2)
    count = rng.poisson(filled * area * rate**2 / math.pi)
    range_m = np.sort(np.sqrt(rng.uniform(BLIND_M**2, DISC_RADIUS_M**2, count)))
    diameter = np.minimum(rng.gamma(2.0, 1.0 / rate, count), _LARGEST_M)
    height = rng.uniform(-0.5, 0.5, count) * diameter
    radius = np.sqrt(0.25 * diameter**2 - height**2)
    return Flakes(
        range_m=range_m,
        azimuth=rng.uniform(0.0, 2.0 * math.pi, count),
        half_width=np.arcsin(np.minimum(radius / range_m, 1.0)),
    )
