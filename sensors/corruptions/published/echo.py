"""Echo of a pulse from fog, flakes and targets by Hahner et al. (2021, 2022), after Rasshofer et al. 2011.

A pulse P0 sin^2(pi t / 2 tau), 0 <= t <= 2 tau, comes back from a target at R0 and from the fog before it as

    C_A P0 beta0 exp(-2 alpha R0) xi(R0) / R0^2 sin^2(pi (R - R0) / (c tau)),   R0 <= R <= R0 + c tau
    C_A P0 beta int sin^2(pi t / 2 tau) exp(-2 alpha r) xi(r) / r^2 U(R0 - r) dt,   r = R - c t / 2

with U(0) = 0, xi the receiver's overlap (`physics.receiver`) and beta0 = 1e-6 / pi; C_A P0 cancels. The integral is
Simpson's with 2000 points, an even number, so it is the mean of the one that takes the first interval as a trapeze and
the one that takes the last.
"""

import numpy as np

from sensors.corruptions.physics.receiver import OVERLAP_START_M, overlap
from sensors.optics.reflectance import LIGHT_SPEED
from sim.geometry import Array

TARGET_BACKSCATTER = 1e-6 / np.pi
"""beta0, 1/(m sr)."""

_POINTS = 2000


def pulse(behind_m: Array, pulse_s: float) -> Array:
    """Return sin^2(pi R / (c tau)), the shape of a target's echo at the range R behind it."""
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
        # The part of the pulse between the start of the overlap and the target.
        first = np.searchsorted(way, range_m[row] - ends[row], side="right")
        after = np.searchsorted(way, range_m[row] - OVERLAP_START_M)
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
