"""Drift of the weather: one strength for all agents of a frame, slowly varying over a drive.

The strength of a kind over a drive is a pure function of the drive's seed and the time: frames can be made in any order
and by any number of processes. It is the severity's own value times

    1 + 0.15 / 3 * sum over k of sin(2 pi t / T_k + phi_k),    k = 1, 2, 3

with phases phi_k uniform and periods T_k from 20 to 120 s, uniform in their logarithm, drawn once per drive and kind.
So it stays within 15 % and changes by less than 0.5 % in 0.1 s. Each kind's `scaled` applies it: to extinction,
rate of rain or snow, height of the water. Amplitude and periods are assumed: small beside the step from one severity to
the next, and no jump from frame to frame. The paper's family has no drift, as published.
"""

import math

import numpy as np

from sim.streams import Stream, random_generator

DRIFT = 0.15
"""Largest deviation of the strength, as a share of the severity's."""

PERIODS_S = (20.0, 120.0)
"""Shortest and longest period of the drift, s."""

_WAVES = 3
_DRIFT, _MEDIUM = 0, 1


def strength(seed: int, kind: str, time_s: float) -> float:
    """Return the strength of a kind of weather at a time of a drive, relative to its severity: within 1 +- `DRIFT`."""
    rng = random_generator(seed, Stream.WEATHER, kind, _DRIFT)
    shortest, longest = PERIODS_S
    period_s = shortest * (longest / shortest) ** rng.random(_WAVES)
    phase = rng.uniform(0.0, 2.0 * math.pi, _WAVES)
    return 1.0 + DRIFT * float(np.mean(np.sin(2.0 * math.pi * time_s / period_s + phase)))


def weather_rng(seed: int, kind: str) -> np.random.Generator:
    """Return the random generator of a drive's weather, the same for every agent and frame."""
    return random_generator(seed, Stream.WEATHER, kind, _MEDIUM)
