"""Rings of points: as recorded, or estimated by elevation.

A beam of a spinning LiDAR keeps its elevation, so the points of one ring have one elevation whatever their order and
wherever the rotation began. The elevations of a sweep form a comb; its teeth are found in their histogram. How wide a
tooth is depends on rounding, noise and calibration, so several widths are tried and the one is taken whose teeth stand
apart best:

    quality = 1 - 2 mean(|elevation - own ring's| / half the distance to the next ring on that side)

1 when every point lies exactly on its ring, 0 when points lie evenly between rings. Normal noise of 0.15 of the
distance between rings gives 0.5 and one wrong point in a thousand; lower qualities are refused.

Two things blur the comb and are looked for when it is not sharp. Drivers and datasets compensate the sensor's own
motion: points then lie where a still sensor would see them, off their rings by the way since or until the rotation
passed straight ahead; the one way straight on that sharpens the comb is taken back. And some sensors' beams do not
start in one point (the HDL-64E's differ by 0.1 m): tan(elevation) = a + b / distance with b the height of the start,
found for all beams first, then ring by ring.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import Sweep
from sim.errors import DataError, complaint

CREDIBLE = 0.5
"""Least quality of an accepted estimate."""

_MOST_RINGS = 640
_LEAST_PER_RING = 5.0
_ONE_RING_RAD = np.radians(0.05)
_FINEST_RAD = np.radians(0.001)
_WIDTHS = 9
_WIDEST_RAD = np.radians(1.0)
_PLAIN = 0.9
_AS_GOOD = 0.01
_VALLEY = 0.7
_STRAY = 0.01
_STARTS_M = np.arange(-7, 8) * 0.04
_FARTHEST_START_M = 0.4
_WAYS_M = np.arange(-13, 14) * 0.25
_SHARP_RAD = np.radians(0.03)
_REFINEMENTS = 3
_SLOTS = 1 << 12


@dataclass(frozen=True, slots=True, eq=False)
class RingEstimate:
    """Estimated rings of P points.

    Attributes:
        ring: (P,) int16, 0 = highest elevation; rings without points are not counted.
        elevation: (R,) float64 elevation of each ring, rad, descending.
        quality: see above, at most 1.
    """

    ring: NDArray[np.int16]
    elevation: NDArray[np.float64]
    quality: float


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """Rings of a sweep, recorded or estimated.

    Attributes:
        ring: (P,) ring of each point, in [0, count).
        count: number of rings R.
        identity: (R,) number of each ring, the same in all sweeps of one sensor, below `IDENTITIES`.
        elevation: (R,) elevation, rad; of an empty ring that of its neighbours.
    """

    ring: NDArray[np.int16]
    count: int
    identity: NDArray[np.int64]
    elevation: NDArray[np.float64]


IDENTITIES = _SLOTS
"""Bound of `Rings.identity`."""


def rings_of(sweep: Sweep, kind: str) -> Rings:
    """Return the rings of a sweep, estimated where neither sweep nor sensor has them.

    Raises:
        DataError: rings that the sensor lacks, or missing rings that cannot be estimated.
    """
    if sweep.spec is not None:
        check_rings(sweep, kind)
        return Rings(sweep.ring, sweep.spec.rings, np.arange(sweep.spec.rings) % _SLOTS, sweep.spec.elevation)
    if len(sweep) and sweep.ring.any():
        count = int(sweep.ring.max()) + 1
        check_rings(sweep, kind)
        return Rings(sweep.ring, count, np.arange(count) % _SLOTS, measured_elevation(sweep.points, sweep.ring, count))
    try:
        found = estimate_rings(sweep.points)
    except DataError as error:
        raise DataError(f"{kind}: expected points with their rings, found a sweep without; {error}") from None
    return Rings(found.ring, len(found.elevation), _identity(found.elevation), found.elevation)


def check_rings(sweep: Sweep, kind: str) -> None:
    """Raise DataError for points of rings that the sensor lacks."""
    rings = np.iinfo(np.int16).max if sweep.spec is None else sweep.spec.rings
    if len(sweep) == 0:
        return
    lowest, highest = int(sweep.ring.min()), int(sweep.ring.max())
    if lowest < 0 or highest >= rings:
        whose = "" if sweep.spec is None else f" of the {rings} of '{sweep.spec.name}'"
        raise DataError(complaint(kind, "ring", f"rings from 0{whose}", f"{lowest} to {highest}"))


def measured_elevation(points: NDArray[np.floating], ring: NDArray[np.integer], rings: int) -> NDArray[np.float64]:
    """Return (rings,) mean elevation of each ring's points, rad; of empty rings between their neighbours."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    count = np.bincount(ring, minlength=rings)
    known = np.flatnonzero(count)
    if len(known) == 0:
        return np.zeros(rings)
    mean = np.bincount(ring, elevation, rings)[known] / count[known]
    return np.interp(np.arange(rings), known, mean)


def estimate_rings(points: NDArray[np.floating], rings: int | None = None) -> RingEstimate:
    """Estimate the rings of a spinning LiDAR's points by their elevation, in any order and from any start.

    Args:
        points: (P, 3) in the sensor's upright frame, m; those at its origin get the ring nearest to 0 elevation.
        rings: number of the sensor's rings, None if unknown; an upper bound.

    Raises:
        DataError: the elevations form no credible comb: too few points, several sensors merged, a tilted frame, a
            scanner without rings, or more than `rings`.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    seen = np.hypot(points[:, 0], points[:, 1]) > 1e-3
    if not seen.any():
        return RingEstimate(np.zeros(len(points), np.int16), np.zeros(min(1, len(points))), 1.0)
    comb = _comb(points[seen], _MOST_RINGS if rings is None else rings)
    if comb.quality < CREDIBLE:
        found_text = f"points of quality {comb.quality:.2f} at best, {int(seen.sum())} of them"
        raise DataError(complaint("points", "rings", f"elevations of quality {CREDIBLE} or more", found_text))
    ring = np.full(len(points), np.abs(comb.elevation).argmin(), np.int16)
    ring[seen] = comb.ring
    return RingEstimate(ring, comb.elevation, comb.quality)


def _comb(points: NDArray[np.float64], most: int) -> RingEstimate:
    """Return the best comb of at most `most` teeth of (P, 3) points, none of them above or below the sensor."""
    best = _best_comb(_elevation(points), most)
    if best.quality >= _PLAIN:
        return best
    way = _sharpest(_WAYS_M, lambda way: _halted(points, way))
    points = _halted(points, way)
    start = _sharpest(_STARTS_M, lambda start: points - [0.0, 0.0, start])
    best = max(best, _best_comb(_elevation(points - [0.0, 0.0, start]), most), key=lambda comb: comb.quality)
    near = 1.0 / np.hypot(points[:, 0], points[:, 1])
    for _ in range(_REFINEMENTS):
        # Neighbouring beams share a lens: smoothing outvotes a few bad rings.
        slope = _slopes(points[:, 2] * near, near, best)
        again = _best_comb(np.arctan((points[:, 2] - slope[best.ring]) * near), most)
        if again.quality <= best.quality + 1e-4:
            break
        best = again
    return best


def _elevation(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def _halted(points: NDArray[np.float64], way_m: float) -> NDArray[np.float64]:
    """Return (P, 3) points without the compensation of a straight motion of `way_m` per rotation."""
    turned = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    return points - np.stack([way_m * turned, np.zeros_like(turned), np.zeros_like(turned)], axis=1)


def _sharpest(values: NDArray[np.floating], of: Callable[[float], NDArray[np.float64]]) -> float:
    """Return the value whose points have the sharpest histogram of elevations, refined; 0 if none is better."""

    def sharpness(value: float) -> float:
        bins = ((_elevation(of(value)) + 0.5 * np.pi) / _SHARP_RAD).astype(np.int64)
        return float((np.bincount(bins).astype(np.float64) ** 2).sum())

    rated = {float(value): sharpness(float(value)) for value in values}
    step = float(values[1] - values[0])
    for _ in range(2):
        step *= 0.5
        best = max(rated, key=lambda value: rated[value])
        rated |= {value: sharpness(value) for value in (best - step, best + step)}
    best = max(rated, key=lambda value: rated[value])
    return best if rated[best] > 1.05 * sharpness(0.0) else 0.0


def _slopes(tangent: NDArray[np.float64], near: NDArray[np.float64], comb: RingEstimate) -> NDArray[np.float64]:
    """Return (R,) slope of tan(elevation) over 1 / distance of each ring, smoothed over rings, m."""
    # SciPy takes half a second to import, which most users of the registry need not wait for.
    from scipy.ndimage import median_filter

    rings = len(comb.elevation)
    count = np.maximum(np.bincount(comb.ring, minlength=rings), 1)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(comb.ring, values, rings) / count

    x = near - mean(near)[comb.ring]
    y = tangent - mean(tangent)[comb.ring]
    spread = mean(x * x)
    slope = np.where(spread > 1e-10, mean(x * y) / np.maximum(spread, 1e-10), 0.0)
    return median_filter(np.clip(slope, -_FARTHEST_START_M, _FARTHEST_START_M), size=min(9, rings), mode="nearest")


def _best_comb(elevation: NDArray[np.float64], most: int) -> RingEstimate:
    """Return the comb of at most `most` teeth with the best quality in (P,) elevations, the coarsest of the good."""
    if np.ptp(elevation) <= _ONE_RING_RAD:
        return RingEstimate(np.zeros(len(elevation), np.int16), np.array([np.median(elevation)]), 1.0)
    lowest = elevation.min()
    count = np.bincount(((elevation - lowest) / _FINEST_RAD).astype(np.int64))
    middle = lowest + (np.arange(len(count)) + 0.5) * _FINEST_RAD
    combs = []
    for doubling in range(_WIDTHS):
        step = 1 << doubling
        borders = _valleys(np.add.reduceat(count, np.arange(0, len(count), step)))
        if borders is not None and len(elevation) >= _LEAST_PER_RING * (len(borders) + 1):
            teeth = _teeth(middle, count, lowest + borders * (step * _FINEST_RAD))
            if len(teeth) <= most:
                combs.append((_quality(middle, count, teeth), teeth))
    top = max((quality for quality, _ in combs), default=0.0)
    if top <= 0.0:
        return RingEstimate(np.zeros(len(elevation), np.int16), np.array([np.median(elevation)]), 0.0)
    teeth = [teeth for quality, teeth in combs if quality >= top - _AS_GOOD][-1]
    ring = len(teeth) - 1 - np.searchsorted(0.5 * (teeth[:-1] + teeth[1:]), elevation)
    center = np.bincount(ring, elevation) / np.bincount(ring)
    return RingEstimate(ring.astype(np.int16), center, _quality(elevation, np.ones(len(elevation)), center[::-1]))


def _valleys(counts: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Return the valleys between the teeth of a histogram, in bins; None without a comb."""
    from scipy.ndimage import gaussian_filter1d

    density = gaussian_filter1d(np.concatenate([np.zeros(9), counts, np.zeros(9)]), 2.0, mode="constant")
    rising = np.diff(density) > 0.0
    peak = np.flatnonzero(rising[:-1] & ~rising[1:]) + 1
    if not 2 <= len(peak) <= 4 * _MOST_RINGS:
        return None
    valley = peak[:-1] + np.array([density[a:b].argmin() for a, b in pairwise(peak)])
    # A tooth without a valley beside it is a shoulder of its neighbour.
    kept_peak, kept_valley = [density[peak[0]]], []
    for where, top in zip(valley, density[peak[1:]], strict=True):
        if density[where] <= _VALLEY * min(kept_peak[-1], top):
            kept_peak.append(top)
            kept_valley.append(where)
        else:
            kept_peak[-1] = max(kept_peak[-1], top)
    if not 1 <= len(kept_valley) < _MOST_RINGS:
        return None
    return np.array(kept_valley, np.float64) - 9.0 + 0.5


def _teeth(
    elevation: NDArray[np.float64], weight: NDArray[np.integer], borders: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the ascending centres of the teeth between borders, without those of a few stray points."""
    cell = np.searchsorted(borders, elevation)
    count = np.bincount(cell, weight, len(borders) + 1)
    kept = count >= max(1.0, _STRAY * float(np.median(count[count > 0])))
    return (np.bincount(cell, weight * elevation, len(count))[kept] / count[kept]).astype(np.float64)


def _quality(elevation: NDArray[np.float64], weight: NDArray, teeth: NDArray[np.float64]) -> float:
    """Return the quality of ascending teeth for weighted elevations, see above."""
    if len(teeth) < 2:
        return 0.0
    half = np.minimum(0.5 * np.diff(teeth), _WIDEST_RAD)
    cell = np.searchsorted(0.5 * (teeth[:-1] + teeth[1:]), elevation)
    offset = elevation - teeth[cell]
    reach = np.where(offset > 0.0, np.r_[half, half[-1]][cell], np.r_[half[0], half][cell])
    share = np.minimum(np.abs(offset) / reach, 1.0)
    return float(1.0 - 2.0 * (weight * share).sum() / weight.sum())


def _identity(elevation: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return (R,) places of rings on a ladder from elevation 0 with rungs as far apart as close rings.

    A place on the ladder, unlike a rank, is the same in sweeps where other rings are empty.
    """
    if len(elevation) < 2:
        return np.zeros(len(elevation), np.int64)
    rungs = elevation / np.quantile(-np.diff(elevation), 0.2, method="nearest")
    phase = np.angle(np.exp(2j * np.pi * rungs).mean()) / (2.0 * np.pi)
    return np.rint(rungs - phase).astype(np.int64) % _SLOTS
