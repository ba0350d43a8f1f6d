"""LiDAR receiver in weather: power of a return, detection threshold, reported intensity.

Power is in units of a target of reflectivity 1 at normal incidence in clear air at 1 m. A LiDAR reports the
strongest of the returns that it detects.

A simulator's sensor detects everything within its farthest range: its `LidarSpec.range_10_m` lies beyond `range_max_m`
and is no threshold. In clear air nothing follows from that. In weather such a receiver would detect every flake and
drop, so it takes the threshold of the sensor that these simulators imitate (`DEFAULT_RANGE_10_M`). Only
what weather adds and takes away depends on it; clear sweeps are what they were.
"""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.optics.reflectance import CLEAR_AIR_EXTINCTION, COSINE_BINS, optics_of, reported
from sensors.spec import LidarSpec
from sensors.sweep import UNKNOWN_MATERIAL, Sweep

DEFAULT_RANGE_10_M = 50.0
"""`LidarSpec.range_10_m` of an unknown sensor or one without a threshold, m.

It is the Velodyne HDL-64E's (user manual, S2: 50 m at reflectivity 0.1, 120 m at 0.8), KITTI's sensor and the one whose
64 beams from +2 to -25 degrees, 1.3 million points a second and 120 m OPV2V's CARLA sensor has, and for which snow was
published (Hahner 2022).
"""

DEFAULT_REFLECTIVITY = 0.2
"""Reflectivity of a surface of unknown material and uninformative intensity."""

OVERLAP_START_M, FULL_OVERLAP_M = 0.9, 1.0
"""Ranges between which the overlap of beam and receiver rises from 0 to 1, m (Hahner)."""

_POWER_LAW_M = 10.0


def detection_threshold(spec: LidarSpec | None, range_10_m: float | None = None) -> float:
    """Return the detection threshold of a sensor in weather, a power.

    Args:
        spec: the sensor, None if unknown.
        range_10_m: instead of the sensor's or the default; infinity for a receiver without a threshold.
    """
    if range_10_m is None:
        if spec is None or spec.range_10_m > spec.range_max_m:
            range_10_m = DEFAULT_RANGE_10_M
        else:
            range_10_m = spec.range_10_m
    if math.isinf(range_10_m):
        return 0.0
    return 0.1 * math.exp(-2.0 * CLEAR_AIR_EXTINCTION * range_10_m) / range_10_m**2


def target_power(sweep: Sweep, reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (P,) received power in clear air.

    A calibrated intensity i at range r means i / r^2; received power is the power. CARLA's intensity is independent of
    the surface, and on a scale of the sensor's own dark and far surfaces are alike: there the material decides, and
    `DEFAULT_REFLECTIVITY` without one.

    Args:
        sweep: as measured in clear air.
        reach: (P,) range of its points, m.
    """
    law = "reflectivity" if sweep.spec is None else sweep.spec.intensity_law
    if law == "power":
        return sweep.intensity.astype(np.float64) / _POWER_LAW_M**2
    of_surface = law == "distance" or _has_scale(sweep.spec)
    surface = _reflectivity(sweep, reach) if of_surface else sweep.intensity
    return surface / np.maximum(reach, 1e-6) ** 2


def reported_intensity(
    spec: LidarSpec | None, power: NDArray[np.float64], reach: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (P,) intensity in [0, 1] of returns of some power from some range, m."""
    law = "reflectivity" if spec is None else spec.intensity_law
    if spec is not None and law == "distance":
        return np.exp(-spec.attenuation * reach)
    intensity = power * (_POWER_LAW_M**2 if law == "power" else reach**2)
    return np.minimum(intensity if spec is None else reported(spec, intensity, reach), 1.0)


def _has_scale(spec: LidarSpec | None) -> bool:
    return spec is not None and not (spec.intensity_curve is spec.intensity_fade_m is msgspec.UNSET)


def overlap(range_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the overlap in [0, 1] of beam and receiver at a range (Hahner 2021, xi)."""
    return np.clip((range_m - OVERLAP_START_M) / (FULL_OVERLAP_M - OVERLAP_START_M), 0.0, 1.0)


def _reflectivity(sweep: Sweep, reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (P,) reflectivity of the points' materials at their incidence, through clear air."""
    known = sweep.material != UNKNOWN_MATERIAL
    if sweep.spec is None or not known.any():
        return np.full(len(sweep), DEFAULT_REFLECTIVITY)
    bin_ = np.rint(sweep.cosine * COSINE_BINS).astype(np.int64)
    surface = optics_of(sweep.spec).power[np.where(known, sweep.material, 0), bin_]
    return np.where(known, surface * np.exp(-2.0 * CLEAR_AIR_EXTINCTION * reach), DEFAULT_REFLECTIVITY)
