"""Noise: random errors of coordinates, by a bad clock, encoder or interface.

| severity                                    | 1    | 2    | 3    | 4    | 5    |
|---------------------------------------------|------|------|------|------|------|
| gaussian: standard deviation, m             | 0.02 | 0.04 | 0.06 | 0.08 | 0.10 |
| uniform: half width, m                      | 0.02 | 0.04 | 0.06 | 0.08 | 0.10 |
| impulse: one point of n                     | 30   | 25   | 20   | 15   | 10   |
| impulse: error of each coordinate, +- m     | 0.1  | 0.1  | 0.1  | 0.1  | 0.1  |

Numbers and kinds are those of Dong et al. (CVPR 2023), who add the noise to all columns, intensity and ring included;
here only coordinates are noisy. All three draw the same numbers at every severity, so that noise
grows with it point by point, and the points hit by impulses at a severity are hit at the next.
"""

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.sweep import MOVED, SCATTERED, Sweep

_IMPULSE_M = 0.1


class Noise(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        how: distribution of the displacement.
        size_m: standard deviation (gaussian) or half width (uniform) of each coordinate, m.
        one_of: n: impulses hit one point of n, each with the same chance.
        impulse_m: displacement of each coordinate by an impulse, up or down, m.
    """

    LEVELS: ClassVar = {"size_m": (0.02, 0.04, 0.06, 0.08, 0.10), "one_of": (30.0, 25.0, 20.0, 15.0, 10.0)}
    RANGES: ClassVar = {
        "size_m": (0.0, 100.0),
        "one_of": (1.0, 1e9),
        "impulse_m": (0.0, 100.0),
    }

    how: Literal["gaussian", "uniform", "impulse"] = "gaussian"
    size_m: float = 0.06
    one_of: float = 20.0
    impulse_m: float = _IMPULSE_M


def corrupt(sweep: Sweep, settings: Noise, rng: np.random.Generator) -> Sweep:
    """Displace points; each stays a return of its object, with its intensity."""
    if settings.how == "impulse":
        return _with_impulses(sweep, settings, rng)
    if settings.size_m == 0.0:
        return sweep
    shape = sweep.points.shape
    if settings.how == "gaussian":
        offset = rng.standard_normal(shape, np.float32)
    else:
        offset = rng.random(shape, np.float32)
        offset -= np.float32(0.5)
        offset *= np.float32(2.0)
    offset *= np.float32(settings.size_m)
    offset += sweep.points
    return replace(sweep, points=offset, fate=np.where(sweep.fate == SCATTERED, sweep.fate, np.uint8(MOVED)))


def _with_impulses(sweep: Sweep, settings: Noise, rng: np.random.Generator) -> Sweep:
    """Displace some points to the corners of a cube around them."""
    hit = np.flatnonzero(rng.random(len(sweep), np.float32) < 1.0 / settings.one_of)
    corner = rng.integers(0, 8, len(sweep), np.uint8)[hit]
    if settings.impulse_m == 0.0:
        return sweep
    side = 2.0 * (corner[:, None] >> np.arange(3, dtype=np.uint8) & 1) - 1.0
    points, fate = sweep.points.copy(), sweep.fate.copy()
    points[hit] += (side * settings.impulse_m).astype(np.float32)
    fate[hit[fate[hit] != SCATTERED]] = MOVED
    return replace(sweep, points=points, fate=fate)
