"""Ring estimates of published code, for files without rings; ring 0 = top.

| estimate       | source                           | assumption                                                     |
|----------------|----------------------------------|----------------------------------------------------------------|
| `azimuth_wrap` | DSRC, Robo3D beams, cross sensor | KITTI's order: ring after ring, each counter-clockwise from +x |
| `elevation`    | DSRC, Robo3D snow                | an HDL-64E: 64 rings evenly from +3 to -25 degrees             |
| `k_means`      | LiDAR-Distillation               | 64 rings at well separated elevations                          |

Each is right under its assumption and silently wrong elsewhere: the same cloud in reverse order has a single ring by
azimuth wrap, a shuffled one noise. Use `sensors.corruptions.physics.rings` instead. Quirks, all kept: azimuth wraps are
counted up to 63, whatever the sensor; the bin of an elevation is computed in single precision, and its distance is the
norm over all four columns, the intensity included, unless only three are given.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.rings import rings_of
from sensors.corruptions.published.cloud import Cloud, cloud_of
from sensors.sweep import Sweep

RingSource = Literal["sweep", "azimuth_wrap", "elevation", "k_means"]
"""Source of rings: the sweep itself, or an estimate."""

LASERS = 64
"""Number of rings that every estimate assumes."""

_BEHIND, _AHEAD = 0.2, 0.8
_TOP_RAD, _BOTTOM_RAD = 3.0 / 180.0 * np.pi, -25.0 / 180.0 * np.pi
_BINS = 1024
_ROUNDS = 100


def rings_from(sweep: Sweep, source: RingSource, kind: str) -> tuple[NDArray[np.int64], int]:
    """Return (P,) rings of a sweep and the number of rings of its sensor.

    Raises:
        DataError: `source` is `sweep`, and rings are missing and cannot be estimated.
    """
    if source == "sweep":
        rings = rings_of(sweep, kind)
        return rings.ring.astype(np.int64), rings.count
    guess = {"azimuth_wrap": azimuth_wrap, "elevation": elevation_bin, "k_means": k_means}[source]
    return guess(cloud_of(sweep).astype(np.float32)), LASERS


def azimuth_wrap(cloud: Cloud) -> NDArray[np.int64]:
    """Return (P,) rings counted by passes of +x in the order of the rows: u below 0.2 after above 0.8.

    Here u in [0, 1] grows counter-clockwise from +x.
    """
    ring = np.zeros(len(cloud), np.int64)
    turn = 0.5 * (1.0 - np.arctan2(cloud[:, 1], -cloud[:, 0]) / np.pi)
    ring[1:] = np.cumsum((turn[1:] < _BEHIND) & (turn[:-1] > _AHEAD))
    return np.minimum(ring, LASERS - 1)


def elevation_bin(cloud: Cloud) -> NDArray[np.int64]:
    """Return (P,) bin of asin(z / norm of the row) among 64 equal ones of +3 to -25 degrees, clipped.

    Args:
        cloud: (P, 3) points, or (P, 4) with the intensity in the norm, as released.
    """
    rows = cloud.astype(np.float32)
    norm = np.linalg.norm(rows, axis=1)
    pitch = np.arcsin(np.divide(rows[:, 2], norm, out=np.zeros_like(norm), where=norm > 0))
    share = 1.0 - (pitch + abs(_BOTTOM_RAD)) / (_TOP_RAD - _BOTTOM_RAD)
    return np.clip(np.floor(share * LASERS), 0, LASERS - 1).astype(np.int64)


def k_means(cloud: Cloud, clusters: int = LASERS) -> NDArray[np.int64]:
    """Return (P,) rings as clusters of elevation with the least squared deviation, 0 = highest.

    Published code restarts k-means from random seeds and keeps the best; in one dimension the optimum follows from
    dynamic programming over a histogram, then refined on the points.
    """
    elevation = np.arctan2(cloud[:, 2], np.hypot(cloud[:, 0], cloud[:, 1])).astype(np.float64)
    if len(elevation) == 0:
        return np.zeros(0, np.int64)
    center = _refined(np.sort(elevation), _best_centers(elevation, clusters))
    bounds = 0.5 * (center[1:] + center[:-1])
    return len(center) - 1 - np.searchsorted(bounds, elevation, side="right")


def _best_centers(value: NDArray[np.float64], clusters: int) -> NDArray[np.float64]:
    """Return (K,) ascending centres of the optimal clusters of a histogram of values."""
    count, edges = np.histogram(value, _BINS, (value.min(), value.max() + 1e-9))
    filled = np.flatnonzero(count)
    place = 0.5 * (edges[:-1] + edges[1:])[filled]
    weight, first, second = (np.append(0.0, np.cumsum(count[filled] * place**k)) for k in range(3))
    bins = len(filled)
    clusters = min(clusters, bins)
    # cost[i, j]: squared deviation of bins i..j - 1 from their mean.
    low, high = np.arange(bins + 1)[:, None], np.arange(bins + 1)
    size = np.where(high > low, weight - weight[:, None], 1.0)
    cost = second - second[:, None] - (first - first[:, None]) ** 2 / size
    cost[high <= low] = np.inf
    best = np.append(0.0, np.full(bins, np.inf))
    cuts = np.zeros((clusters, bins + 1), np.int64)
    for k in range(clusters):
        total = best[:, None] + cost
        cuts[k] = total.argmin(axis=0)
        best = total[cuts[k], high]
    ends = [bins]
    for k in range(clusters - 1, -1, -1):
        ends.append(int(cuts[k, ends[-1]]))
    ends = ends[::-1]
    return np.diff(first[ends]) / np.diff(weight[ends])


def _refined(value: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return centres after Lloyd's iterations on ascending values, until they are stationary."""
    total = np.append(0.0, np.cumsum(value))
    for _ in range(_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(value, 0.5 * (center[1:] + center[:-1])), [len(value)]])
        size = np.diff(ends)
        moved = np.where(size > 0, np.diff(total[ends]) / np.maximum(size, 1), center)
        if np.array_equal(moved, center):
            break
        center = moved
    return center
