"""How many flakes falling snow has and how large they are, and samples of them in the planes that rings sweep.

Snow falling at s mm/h of water with speed v fills the share O = s / (3.6e6 rho v) of the air, and its flakes' diameters
are distributed exponentially with rate L (Gunn and Marshall 1958), so there are O L^3 / pi per cubic metre. They cover
O L / 2 of a thin ray per metre.

A plane cuts a flake with a chance proportional to its diameter, at a uniform height: there are O L^2 / pi discs per
square metre, and their diameters before the cut follow D exp(-L D). Discs block exactly the share of a ray that the
flakes do.

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
from sensors.corruptions.strongest import Particles

DISC_RADIUS_M = 80.0
"""Flakes in discs are followed one by one up to this range; beyond it snow is a haze."""

_LARGEST_RADIUS_M = 0.01
_POOL_SEED = 2022
_POOL_FLAKES = 1 << 20
_FEWEST_DISCS, _MOST_DISCS = 4, 64
_LEAST_PER_DISC = 1 << 10
_AREA_M2 = math.pi * (DISC_RADIUS_M**2 - BLIND_M**2)


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


@dataclass(frozen=True, slots=True, eq=False)
class StandardFlakes:
    """F discs in a plane, of which any snow takes its share and its size.

    Attributes:
        range_m, azimuth: as of `Flakes`.
        radius: (F,) in units of 1 / L.
        turn: (F,) uniform in [0, 1): snow with a share q of the flakes has those below q.
    """

    range_m: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    radius: NDArray[np.float64]
    turn: NDArray[np.float64]


def occupancy(snowfall_mm_h: float, fall_speed_mps: float, density: float) -> float:
    """Return the share of the air that is snow; density of the flakes relative to water."""
    return snowfall_mm_h / (3.6e6 * density * fall_speed_mps)


def gunn_marshall_rate(water_mm_h: float) -> float:
    """Return the rate of the exponential law of melted diameters, 1/m."""
    return 2550.0 * water_mm_h**-0.48


def flake_rate(snowfall_mm_h: float, density: float) -> float:
    """Return L, the rate of the exponential law of the flakes' diameters, 1/m."""
    return gunn_marshall_rate(snowfall_mm_h) * density ** (1.0 / 3.0)


def snow_particles(snowfall_mm_h: float, fall_speed_mps: float, density: float, reflectivity: float) -> Particles:
    """Return falling snow as a medium; extinction is twice the share of a ray that flakes cover."""
    filled = occupancy(snowfall_mm_h, fall_speed_mps, density)
    rate = flake_rate(snowfall_mm_h, density)
    return Particles(
        per_m3=filled * rate**3 / math.pi, rate_per_m=rate, reflectivity=reflectivity, extinction=filled * rate
    )


@dataclass(frozen=True, slots=True, eq=False)
class FlakePool:
    """Samples of discs for any snow that has no more flakes than they.

    Attributes:
        per_disc: expected number of flakes in each.
        discs: the samples.
    """

    per_disc: int
    discs: tuple[StandardFlakes, ...]

    def flakes(self, number: int, snow: Particles) -> Flakes:
        """Return what this snow has of one disc."""
        disc = self.discs[number]
        there = disc.turn < discs_per_m2(snow) * _AREA_M2 / self.per_disc
        radius = np.minimum(disc.radius[there] / snow.rate_per_m, _LARGEST_RADIUS_M)
        range_m = disc.range_m[there]
        return Flakes(range_m, disc.azimuth[there], np.arcsin(np.minimum(radius / range_m, 1.0)))


def discs_per_m2(snow: Particles) -> float:
    """Return how many flakes a plane cuts."""
    return snow.per_m3 / snow.rate_per_m


def flake_pool(snow: Particles) -> FlakePool:
    """Return samples for this snow, the same ones in every process and for snow somewhat lighter or heavier."""
    needed = max(discs_per_m2(snow) * _AREA_M2, _LEAST_PER_DISC)
    return sample_flakes(1 << math.ceil(math.log2(needed)))


@lru_cache(maxsize=2)
def sample_flakes(per_disc: int) -> FlakePool:
    """Sample discs with so many flakes in each, as a rule; fewer discs when they hold many."""
    rng = np.random.default_rng(np.random.SeedSequence(_POOL_SEED))
    number = min(max(_POOL_FLAKES // per_disc, _FEWEST_DISCS), _MOST_DISCS)
    return FlakePool(per_disc, tuple(_sample_disc(per_disc, rng) for _ in range(number)))


def _sample_disc(per_disc: int, rng: np.random.Generator) -> StandardFlakes:
    # Discs overlap so rarely (share ~1e-6) that none needs to be rejected.
    count = rng.poisson(per_disc)
    range_m = np.sqrt(rng.uniform(BLIND_M**2, DISC_RADIUS_M**2, count))
    range_m.sort()
    diameter = rng.standard_gamma(2.0, count)
    height = rng.random(count)
    return StandardFlakes(
        range_m=range_m,
        azimuth=rng.uniform(0.0, 2.0 * math.pi, count),
        radius=0.5 * diameter * np.sqrt(1.0 - height**2),
        turn=rng.random(count),
    )
