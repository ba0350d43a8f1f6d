"""Rolling shutter: poses of a sensor at its firings."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.optics.beams import BLOCK, Beams, Fan
from sensors.raycast.base import SweepRequest

_STEP_S = 1e-3
"""Longest linear interpolation of poses, s: 0.05 mm off at 50 m for a body that turns at 3 rad/s."""

Floats = NDArray[np.float32]


def beam_axes(beams: Beams) -> Floats:
    """Return the axes of the beams in the frame of the head.

    Returns:
        (3, R, 1), the same for all columns, or (3, R, C) of a rosette, whose head does not turn.
    """
    return beams.axis[:, :, : beams.columns] if beams.fan is None else _head_axes(beams)


@lru_cache(maxsize=8)
def _head_axes(beams: Beams) -> Floats:
    assert beams.fan is not None
    cosine, sine = _head(beams.fan)[:, 0]
    x, y, z = beams.axis[..., :1]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z])


@lru_cache(maxsize=16)
def _head(fan: Fan) -> Floats:
    """Return (2, W) float32 cosine and sine of the columns' azimuths."""
    return np.stack([np.cos(fan.azimuth), np.sin(fan.azimuth)]).astype(np.float32)


class Shutter:
    """Timing of one sweep, in columns since its start.

    Attributes:
        border: (K,) float64 moments between which poses are interpolated linearly: borders of blocks, parts of long
            ones, and the knots of the bodies' path.
        segment: (C,) the border before each column.
        timing: (4, C) float32 share of its segment that has passed when a column starts to fire, or its beams if they
            all fire together; share of the segment that the others take, else 0; cosine and sine of the head's azimuth.
    """

    def __init__(self, request: SweepRequest, knots_s: NDArray[np.float64]) -> None:
        """Prepare a sweep among bodies whose path has knots at (K,) times."""
        share, columns, column_s = request.beams.firing_share, request.beams.columns, request.spec.column_s
        self._request = request
        together = bool((share == share[0]).all())
        parts = max(1, int(np.ceil(BLOCK * column_s / _STEP_S)))
        borders = np.linspace(0.0, float(request.beams.blocks * BLOCK), request.beams.blocks * parts + 1)
        if column_s > 0.0:
            knots = (knots_s - request.time_s) / column_s + 0.5 * columns
            borders = np.sort(np.concatenate([borders, knots[(knots > 0.0) & (knots < borders[-1])]]))
        fired = np.arange(columns) + (float(share[0]) if together else 0.0)
        self.border = borders
        self.segment: NDArray[np.int64] = np.searchsorted(borders, fired, "right") - 1
        length = np.diff(borders)[self.segment]
        self.timing: Floats = np.zeros((4, columns), np.float32)
        self.timing[0] = (fired - borders[self.segment]) / length
        self.timing[1] = 0.0 if together else 1.0 / length
        self.timing[2:] = [[1.0], [0.0]] if request.beams.fan is None else _head(request.beams.fan)[:, :columns]

    def sensor(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3, 4) world_from_lidar at (N,) moments."""
        knots = self._request.knots
        block = np.clip(column // BLOCK, 0, len(knots) - 2).astype(np.int64)
        share = (column / BLOCK - block)[:, None, None]
        return knots[block] + share * (knots[block + 1] - knots[block])
