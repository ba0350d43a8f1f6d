"""The echo of a pulse from fog, flakes and targets as Hahner et al. (2021, 2022) have it, after Rasshofer et al. 2011.

A pulse P0 sin^2(pi t / 2 tau), 0 <= t <= 2 tau, comes back from a target at R0 and from the fog before it as

    C_A P0 beta0 exp(-2 alpha R0) xi(R0) / R0^2 sin^2(pi (R - R0) / (c tau)),   R0 <= R <= R0 + c tau
    C_A P0 beta int sin^2(pi t / 2 tau) exp(-2 alpha r) xi(r) / r^2 U(R0 - r) dt,   r = R - c t / 2

with U(0) = 0. xi, the share of the beam that the receiver sees, is 0 up to 0.9 m and 1 from 1 m on. P0 = 80 W,
C_A = c 0.05 0.25 m^2 / 2, beta0 = 1e-6 / pi. The integral is Simpson's with 2000 points, an even number, so it is the
mean of the one that takes the first interval as a trapeze and the one that takes the last.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.constants import c as LIGHT_SPEED

TARGET_BACKSCATTER = 1e-6 / np.pi
"""beta0, 1/(m sr)."""
APERTURE = LIGHT_SPEED * 0.05 * 0.25 / 2.0
"""C_A, m^3/s: speed of light, loss 0.05, aperture 0.25 m^2."""
PEAK_W = 80.0
"""P0."""

BLIND_M, SIGHT_M = 0.9, 1.0
"""The receiver sees nothing nearer than the first, everything beyond the second."""

_POINTS = 2000

Array = NDArray[np.float64]


def overlap(range_m: Array) -> Array:
    """Return xi, the share in [0, 1] of the beam that the receiver sees at a range."""
    return np.clip((range_m - BLIND_M) / (SIGHT_M - BLIND_M), 0.0, 1.0)


def hard_power(range_m: Array, target_m: Array, extinction: float, pulse_s: float) -> Array:
    """Return the echo of a target of backscatter beta0 over time, W.

    Args:
        range_m: time of flight times c / 2.
        target_m: R0 > 0.
        extinction: alpha, 1/m.
        pulse_s: tau, s.
    """
    behind = range_m - target_m
    shape = np.where((behind >= 0) & (behind <= LIGHT_SPEED * pulse_s), pulse(behind, pulse_s), 0.0)
    loss = np.exp(-2.0 * extinction * target_m) * overlap(target_m) / target_m**2
    return APERTURE * PEAK_W * TARGET_BACKSCATTER * loss * shape


def pulse(behind_m: Array, pulse_s: float) -> Array:
    """Return sin^2(pi R / (c tau)), the shape of a target's echo in the range R behind it."""
    return np.sin(np.pi * behind_m / (LIGHT_SPEED * pulse_s)) ** 2


def soft_integral(range_m: Array, target_m: Array, extinction: float, pulse_s: float) -> Array:
    """Return the echo of fog before a target over time, divided by C_A P0 beta, s/m^2.

    Args:
        range_m: (N,) time of flight times c / 2.
        target_m: (N,) or one R0; infinite for fog without end.
        extinction: alpha, 1/m.
        pulse_s: tau, s.
    """
    time = np.linspace(0.0, 2.0 * pulse_s, _POINTS)
    weight = _simpson(_POINTS) * time[1] * np.sin(0.5 * np.pi * time / pulse_s) ** 2
    way = 0.5 * LIGHT_SPEED * time
    out = np.zeros(len(range_m))
    ends = np.broadcast_to(target_m, out.shape)
    for row in range(len(out)):
        # Only a part of the pulse lies between the receiver's first sight and the target.
        first = np.searchsorted(way, range_m[row] - ends[row], side="right")
        after = np.searchsorted(way, range_m[row] - BLIND_M)
        if first < after:
            r = range_m[row] - way[first:after]
            out[row] = weight[first:after] @ (np.exp(-2.0 * extinction * r) * overlap(r) / r**2)
    return out


def _simpson(points: int) -> Array:
    """Return weights of Simpson's rule for unit steps and an even number of points."""
    weight = np.zeros(points)
    inner = np.tile([2.0, 4.0], points // 2)[: points - 1] / 3.0
    inner[[0, -1]] = 1.0 / 3.0
    for part in (weight[:-1], weight[1:]):
        part += 0.5 * inner
    weight[[0, 1, -2, -1]] += 0.25
    return weight
