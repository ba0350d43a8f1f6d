"""The strongest of the many particles in a beam: flakes of snow, drops of rain.

A medium of N particles per cubic metre, spread at random, with diameters D distributed as L exp(-L D), fills a beam
whose full angle is theta. A particle at range r takes the share D^2 / (theta r)^2 of the beam and answers with power
rho D^2 / (theta^2 r^4), so it answers with more than p if D > r^2 theta sqrt(p / rho), which has the chance exp(-c r^2)
with c = L theta sqrt(p / rho). Particles louder than p are a Poisson process with mean

    M(p) = N pi theta^2 / 4 integral of r^2 exp(-c r^2) dr = N pi^1.5 theta^2 / (16 c^1.5).

Hence, from the loudest to the next, M(p_1), M(p_2), ... are the arrivals E_1, E_1 + E_2, ... of unit exponentials. The
density of the range of a particle as loud as p goes with r^2 times that of D there times dD/dp, that is with
r^4 exp(-c r^2): its square is Gamma(5/2) distributed with rate c (those louder than p: Gamma(3/2)).

So the loudest particle between the nearest range that the sensor reports and the target is found without sampling the
others: walk down from the loudest until one lies in between, or all that remain are too weak to matter. In 0.5 mm/h of
snow a beam of 3 mrad passes some six hundred flakes on 50 m.

What the closed form leaves out: particles that only graze the beam or fill it (D > theta r: a flake of 3 mm within
1 m), and that the loudest is dimmed on its way by those before it, which is applied afterwards.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.medium import Echo, Sight
from sensors.corruptions.physics.receiver import SIGHT_M
from sensors.spec import LidarSpec

UNKNOWN_DIVERGENCE_RAD = 0.003
"""Divergence of a beam when the sensor is not known, or is a simulator's whose rays have no width (Hahner 2022)."""

SAME_RETURN_M = 0.2
"""An echo nearer than this to the target is the target's."""

_MOST_STEPS = 12


@dataclass(frozen=True, slots=True)
class Particles:
    """A medium of particles.

    Attributes:
        per_m3: N.
        rate_per_m: L, of the exponential law of their diameters.
        reflectivity: rho, of a particle that fills the beam, relative to a white surface.
        extinction: by which they dim a beam, 1/m.
    """

    per_m3: float
    rate_per_m: float
    reflectivity: float
    extinction: float


def beam_width(spec: LidarSpec | None) -> float:
    """Return the full divergence of a round beam as wide in area as the sensor's, rad."""
    if spec is None:
        return UNKNOWN_DIVERGENCE_RAD
    vertical = spec.divergence_rad if spec.divergence_vertical_rad is None else spec.divergence_vertical_rad
    return math.sqrt(spec.divergence_rad * vertical) or UNKNOWN_DIVERGENCE_RAD


def strongest_particle(
    particles: Particles, sight: Sight, through: NDArray[np.float64], rng: np.random.Generator
) -> Echo:
    """Draw the loudest particle before the target of each line of sight, if it is louder than what else there is.

    Args:
        particles: the medium.
        sight: the lines.
        through: (P,) transmission to the targets and back.
        rng: draws the same numbers whatever the medium, as far as it has to walk down.
    """
    width = beam_width(sight.sweep.spec)
    echo = Echo(np.zeros(len(sight)), np.zeros(len(sight)))
    # M(p) of a particle that fills the beam with c = 1.
    volume = particles.per_m3 * math.pi**1.5 * width**2 / 16.0
    if volume * particles.reflectivity == 0.0:
        return echo
    floor = sight.floor(through)
    near = np.maximum(sight.near, SIGHT_M)
    arrival = np.zeros(sight.beams)
    line = np.arange(len(sight))
    for _ in range(_MOST_STEPS):
        arrival += rng.standard_exponential(sight.beams)
        square = rng.standard_gamma(2.5, sight.beams)
        beam = sight.beam[line]
        c = (volume / arrival[beam]) ** (2.0 / 3.0)
        power = particles.reflectivity * (c / (particles.rate_per_m * width)) ** 2
        place = np.sqrt(square[beam] / c)
        loud = power > floor[line]
        found = loud & (place >= near[line]) & (place <= sight.reach[line] - SAME_RETURN_M)
        at = line[found]
        echo.range_m[at] = place[found]
        dimmed = power[found] * np.exp(-2.0 * particles.extinction * place[found])
        echo.power[at] = np.minimum(dimmed, particles.reflectivity / place[found] ** 2)
        line = line[loud & ~found]
        if len(line) == 0:
            break
    return echo
