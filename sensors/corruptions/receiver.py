"""What weather needs to know of a receiver: how much a return must have to be seen, and what it sees up close.

Power is measured in units of a target of reflectivity 1, hit squarely in clear air at 1 m: a calibrated intensity i
at range r arrives with power i / r^2. A LiDAR reports the strongest of the returns that it detects.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.errors import DataError

LIGHT_SPEED = 299_792_458.0
"""m/s."""

CLEAR_AIR_EXTINCTION = 2e-4
"""Extinction of clear air that intensities already hold, 1/m; the same number as in `sensors.lidar`."""

UNKNOWN_RANGE_10_M = 100.0
"""`LidarSpec.range_10_m` assumed for a sweep whose sensor is not known."""

BLIND_M, SIGHT_M = 0.9, 1.0
"""Emitted beam and receiver's view do not overlap nearer than the first range, fully beyond the second (Hahner)."""


def least_power(spec: LidarSpec | None, range_10_m: float | None = None) -> float:
    """Return the power of the weakest return that a sensor detects.

    Args:
        spec: the sensor, None when not known.
        range_10_m: instead of the sensor's own value; infinity for a receiver that detects everything.
    """
    if range_10_m is None:
        range_10_m = UNKNOWN_RANGE_10_M if spec is None else spec.range_10_m
    if math.isinf(range_10_m):
        return 0.0
    return 0.1 * math.exp(-2.0 * CLEAR_AIR_EXTINCTION * range_10_m) / range_10_m**2


def overlap(range_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share in [0, 1] of the beam that the receiver sees at a range (Hahner 2021, xi)."""
    return np.clip((range_m - BLIND_M) / (SIGHT_M - BLIND_M), 0.0, 1.0)


def ring_count(sweep: Sweep) -> int:
    """Return the sensor's number of rings; without a spec one more than the highest that has points."""
    if sweep.spec is not None:
        return sweep.spec.rings
    return int(sweep.ring.max()) + 1 if len(sweep) else 0


def known_ring_count(sweep: Sweep, kind: str) -> int:
    """Return the number of rings of a sweep that knows which ring each point is of; `kind` is for the message.

    Raises:
        DataError: it does not, as in files without rings: a corruption of rings would quietly change nothing.
    """
    rings = ring_count(sweep)
    if sweep.spec is None and rings == 1:
        raise DataError(f"{kind}: expected points with their rings, found a sweep without rings and without a sensor")
    return rings
