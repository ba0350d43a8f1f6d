"""One weather per scene: all agents of a frame are in the same fog, and it changes as slowly as weather does.

The strength of a kind over a drive is a pure function of the drive's seed and the time: frames can be made in any order
and by any number of processes. It is the severity's own value times

    1 + 0.15 / 3 * sum over k of sin(2 pi t / T_k + phi_k),    k = 1, 2, 3

with phases phi_k uniform and periods T_k from 20 to 120 s, uniform in their logarithm, drawn once per drive and kind.
So it stays within 15 % and changes by less than 0.5 % in 0.1 s. What is scaled says each kind's `scaled`: extinction,
rate of rain or snow, height of the water. Amplitude and periods are chosen: small beside the step from one severity to
the next, and no jump from frame to frame. The paper's family is left as it was published, without a drift.
"""

import math
import zlib

import numpy as np

DRIFT = 0.15
"""The strength stays within this share of the severity's own."""

PERIODS_S = (20.0, 120.0)
"""Shortest and longest period of the drift, s."""

_WAVES = 3
_STREAM = 3
_DRIFT, _MEDIUM = 0, 1


def strength(seed: int, kind: str, time_s: float) -> float:
    """Return what a kind of weather is at a time of a drive, relative to its severity: within 1 +- `DRIFT`.

    Args:
        seed: of the drive.
        kind: of weather.
        time_s: of the frame, s.
    """
    rng = _stream(seed, kind, _DRIFT)
    shortest, longest = PERIODS_S
    period_s = shortest * (longest / shortest) ** rng.random(_WAVES)
    phase = rng.uniform(0.0, 2.0 * math.pi, _WAVES)
    return 1.0 + DRIFT * float(np.mean(np.sin(2.0 * math.pi * time_s / period_s + phase)))


def weather_rng(seed: int, kind: str) -> np.random.Generator:
    """Return the stream of what the weather of a drive is made of, the same for every agent and frame."""
    return _stream(seed, kind, _MEDIUM)


def _stream(seed: int, kind: str, part: int) -> np.random.Generator:
    key = (_STREAM, zlib.crc32(kind.encode()), part)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
