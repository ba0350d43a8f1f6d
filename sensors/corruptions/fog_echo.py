"""The echo of homogeneous fog to one pulse, as a function of range (Hahner et al., ICCV 2021, soft target).

A pulse sin^2(pi t / 2 tau), 0 <= t <= 2 tau, crosses fog that lies between the sensor and a target at R0. At range R
(time of flight times c / 2) arrives

    W(R) = integral over t of sin^2(pi t / 2 tau) exp(-2 alpha r) xi(r) / r^2,  r = R - c t / 2 < R0.

For R <= R0 all of r lies before the target, so W doesn't depend on it: one convolution serves all targets, and the
strongest echo before R0 is the running maximum. A hard target's echo peaks at R0 + c tau / 2 and is reported at R0, so
ranges are half a pulse less than the R of a waveform.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.receiver import BLIND_M, LIGHT_SPEED, overlap

_STEP_M = 0.01
_REACH_M = 120.0


@dataclass(frozen=True, slots=True, eq=False)
class FogEcho:
    """Echo of one fog to one pulse, per unit of backscatter.

    Attributes:
        range_m: (K,) R, evenly spaced from 0.
        waveform: (K,) W(R), s/m^2.
        running_peak: (K,) strongest W up to R.
        shift_m: R of an echo minus the range reported for it, half a pulse.
        cumulated: (K,) integral of the waveform over reported ranges, from the first that the receiver sees.
    """

    range_m: NDArray[np.float64]
    waveform: NDArray[np.float64]
    running_peak: NDArray[np.float64]
    shift_m: float
    cumulated: NDArray[np.float64]

    def peak(self, target_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P,) the strongest echo before targets at these ranges, s/m^2."""
        return np.interp(target_m, self.range_m, self.running_peak)

    def place(self, quantile: NDArray[np.float64], target_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P,) ranges before the targets, drawn with the waveform as density.

        Args:
            quantile: (P,) uniform in [0, 1).
            target_m: (P,) ranges of the targets.
        """
        mass = np.interp(target_m, self.range_m, self.cumulated) * quantile
        return np.minimum(np.maximum(np.interp(mass, self.cumulated, self.range_m), BLIND_M), target_m)


@lru_cache(maxsize=64)
def fog_echo(extinction: float, pulse_s: float) -> FogEcho:
    """Compute the echo of fog.

    Args:
        extinction: alpha, 1/m.
        pulse_s: tau, the pulse's length at half power, s.
    """
    range_m = np.arange(0.0, _REACH_M + _STEP_M, _STEP_M)
    depth = np.maximum(range_m, _STEP_M)
    answer = np.exp(-2.0 * extinction * depth) * overlap(range_m) / depth**2
    pulse_m = np.arange(0.0, LIGHT_SPEED * pulse_s, _STEP_M)
    pulse = np.sin(np.pi * pulse_m / (LIGHT_SPEED * pulse_s)) ** 2
    waveform = np.convolve(answer, pulse)[: len(range_m)] * (2.0 * _STEP_M / LIGHT_SPEED)
    shift_m = 0.5 * LIGHT_SPEED * pulse_s
    density = np.interp(range_m + shift_m, range_m, waveform) * (range_m >= BLIND_M)
    return FogEcho(
        range_m=range_m,
        waveform=waveform,
        running_peak=np.maximum.accumulate(waveform),
        shift_m=shift_m,
        cumulated=np.cumsum(density) * _STEP_M,
    )
