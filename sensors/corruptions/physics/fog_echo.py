"""Echo of fog to one pulse, as a function of range (Hahner et al., ICCV 2021, soft target).

A pulse sin^2(pi t / 2 tau), 0 <= t <= 2 tau, crosses fog of extinction alpha. At a time of flight of 2 R / c arrives,
for each unit of backscatter,

    W(R) = integral over t of sin^2(pi t / 2 tau) exp(-2 alpha r) xi(r) / r^2,  r = R - c t / 2,

with xi the receiver's overlap. A hard target at R0 arrives strongest at R0 + c tau / 2 and is reported at R0, so every
reported range, of fog too, is half a pulse less than the R of its waveform. The echo of the fog before a target does
not depend on the target's range, so one waveform serves all. (Within half a pulse before the target it includes fog
behind it, which is negligible: W falls steeply, and there the target is stronger.)

Fog is patchy. Its density in one half pulse length, the resolution of a receiver, is taken as g times the mean with
g = E^-s / Gamma(1 - s), E unit exponential, independent from one such cell to the next: its mean is 1, its
deviation 0.14, 0.56 and 1.03 for s = 0.1, 0.3 and 0.4. That law is assumed, for its closed form: of many cells
the strongest, max of g W, is then as strong as one cell with W = S^s, S the sum of W^(1/s) over the cells, and it lies
in each of them with the chance W^(1/s) / S, whatever its strength (extreme values of Frechet's law). So strength and
place of fog's return are two draws without a loop over cells. As s goes to 0 fog becomes homogeneous, with echoes from
one range only.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.receiver import FULL_OVERLAP_M, OVERLAP_START_M, overlap
from sensors.corruptions.physics.table_cache import cached_tables
from sensors.optics.reflectance import LIGHT_SPEED

MOST_EXTINCTION = 1.0
"""Densest fog of the tables, 1/m: a visibility of 3 m."""

_FARTHEST_M = 300.0
_RANGES = 1024
_STEP_PER_M = 0.01
_LEAST = 1e-300
_VERSION = 1
"""Version of the tables in users' caches: raise it with their content."""


@dataclass(frozen=True, slots=True, eq=False)
class FogEcho:
    """Echo of one fog to one pulse, per unit of backscatter.

    Attributes:
        range_m: (K,) ranges as reported, ascending.
        waveform: (K,) W there, s/m^2.
        patchiness: s.
        cumulated: (K,) S of the cells up to each range, W relative to its largest.
    """

    range_m: NDArray[np.float64]
    waveform: NDArray[np.float64]
    patchiness: float
    cumulated: NDArray[np.float64]

    def cells(self, far: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P,) S of the cells up to reported ranges, m."""
        return np.interp(far, self.range_m, self.cumulated)

    def strongest(self, cells: NDArray[np.float64] | float, strength: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P,) strongest echo of some cells, s/m^2.

        Args:
            cells: (P,) or one S of the cells, at least 0.
            strength: (P,) unit exponential draws.
        """
        patch = (cells / strength) ** self.patchiness
        return patch * (self.waveform.max() / math.gamma(1.0 - self.patchiness))

    def place(
        self, quantile: NDArray[np.float64], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (P,) reported range of the strongest echo between two ranges, m.

        Args:
            quantile: (P,) uniform draws, 0 to 1.
            near_m: (P,) nearer range, as reported.
            far_m: (P,) farther range, as reported.
        """
        near, far = self.cells(near_m), self.cells(far_m)
        # Cells beyond `full` are below the resolution of the sum of floats.
        full = int(np.searchsorted(self.cumulated, self.cumulated[-1])) + 1
        place = np.interp(near + quantile * (far - near), self.cumulated[:full], self.range_m[:full])
        # Where S hardly grows its inverse is coarse.
        return np.clip(place, near_m, far_m)


@lru_cache(maxsize=64)
def fog_echo(extinction: float, pulse_s: float, patchiness: float) -> FogEcho:
    """Return the echo of fog, from cached tables.

    Args:
        extinction: alpha, 0 to `MOST_EXTINCTION`, 1/m.
        pulse_s: tau, the pulse's length at half power, s.
        patchiness: s, more than 0 and less than 0.5.
    """
    tables = _waveforms(pulse_s)
    place = min(extinction, MOST_EXTINCTION) / _STEP_PER_M
    row = min(int(place), len(tables["log_waveform"]) - 2)
    # ln W is the logarithm of a mean of exponentials in alpha: between rows it is straight to 1e-4 for LiDARs' pulses.
    share = place - row
    log_waveform = (1.0 - share) * tables["log_waveform"][row] + share * tables["log_waveform"][row + 1]
    range_m = tables["range_m"]
    cells = np.exp((log_waveform - log_waveform.max()) / patchiness)
    between = 0.5 * (cells[1:] + cells[:-1]) * np.diff(range_m) / (0.5 * LIGHT_SPEED * pulse_s)
    return FogEcho(
        range_m=range_m,
        waveform=np.exp(log_waveform),
        patchiness=patchiness,
        cumulated=np.concatenate([[0.0], np.cumsum(between)]),
    )


@lru_cache(maxsize=8)
def _waveforms(pulse_s: float) -> dict[str, NDArray[np.float64]]:
    """Return `range_m` (K,) and `log_waveform` (A, K) of one pulse, one row per extinction, ascending."""
    alphas = np.linspace(0.0, MOST_EXTINCTION, round(MOST_EXTINCTION / _STEP_PER_M) + 1)

    def compute() -> dict[str, NDArray[np.float64]]:
        range_m = np.geomspace(OVERLAP_START_M, _FARTHEST_M, _RANGES)
        table = waveforms(alphas, pulse_s, range_m + 0.5 * LIGHT_SPEED * pulse_s)
        return {"range_m": range_m, "log_waveform": np.log(np.maximum(table, _LEAST))}

    shapes = {"range_m": (_RANGES,), "log_waveform": (len(alphas), _RANGES)}
    return cached_tables(f"fog_echo_{_VERSION}_{pulse_s * 1e12:.0f}ps", shapes, compute)


def waveforms(extinction: NDArray[np.float64], pulse_s: float, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (A, K) W of fogs (A,) at R (K,), s/m^2, with a relative error of about 1e-6.

    Args:
        extinction: 1/m.
        pulse_s: tau, s.
        range_m: R of the waveform, m, half a pulse more than reported.
    """
    # The integrand has a kink where the overlap is full; in ln r both parts are smooth.
    total = np.zeros((len(extinction), len(range_m)))
    reach = LIGHT_SPEED * pulse_s
    for low, high, nodes in ((OVERLAP_START_M, FULL_OVERLAP_M, 8), (FULL_OVERLAP_M, np.inf, 40)):
        first = np.clip(range_m - reach, low, high)
        last = np.clip(range_m, low, high)
        node, weight = np.polynomial.legendre.leggauss(nodes)
        width = 0.5 * np.log(last / first)
        depth = np.exp(0.5 * np.log(last * first) + width * node[:, None])
        pulse = np.sin(np.pi * (range_m - depth) / reach) ** 2
        # dt = 2 dr / c and dr = r d ln r.
        share = weight[:, None] * width * pulse * overlap(depth) / depth * (2.0 / LIGHT_SPEED)
        for row, alpha in enumerate(extinction):
            total[row] += np.einsum("nk,nk->k", np.exp(-2.0 * alpha * depth), share)
    return total
