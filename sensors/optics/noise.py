"""Noise of a sweep: windows into two fixed tables of random numbers, placed by the sweep's generator.

A sweep needs several random numbers per ray, and drawing them would cost as much as tracing the ray. The tables are
fixed; where each ring's window starts is drawn, so that one generator state gives one sweep, whichever engine makes
it, whatever the scene and whatever the number of threads.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.optics.beams import Beams

_STARTS = 1 << 20

RANGE, SECOND_RANGE, ACROSS, UP, LOST_BEFORE, LOST_AFTER = range(6)
"""Rows of `SweepNoise.start`: standard normal for the first four, uniform in [0, 1) for the others."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepNoise:
    """Random numbers of one sweep: that of ring r and column c is `table[start[row, r] + c]`.

    Attributes:
        start: (6, R) int64.
        normal, uniform: the float32 tables.
    """

    start: NDArray[np.int64]
    normal: NDArray[np.float32]
    uniform: NDArray[np.float32]

    def grid(self, row: int, columns: int) -> NDArray[np.float32]:
        """Return (R, columns) numbers of one row."""
        table = self.normal if row <= UP else self.uniform
        windows = np.lib.stride_tricks.sliding_window_view(table, columns)
        return windows[self.start[row]]


def draw_noise(beams: Beams, rng: np.random.Generator) -> SweepNoise:
    """Draw the windows of one sweep."""
    width = 1 << int(beams.axis.shape[2] - 1).bit_length()
    normal, uniform = _tables(max(width, 1 << 14))
    return SweepNoise(rng.integers(0, _STARTS, (6, beams.rings)), normal, uniform)


@lru_cache(maxsize=2)
def _tables(width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return tables long enough for a window of `width` at any start; a shorter table is a prefix of a longer one."""
    length = _STARTS + width
    normal = np.random.Generator(np.random.PCG64(1)).standard_normal(length, np.float32)
    uniform = np.random.Generator(np.random.PCG64(2)).random(length, np.float32)
    return normal, uniform
