"""Ground plane and noise level of a cloud, for snow and wet ground of Hahner et al. (CVPR 2022).

Plane: a robust fit (RANSAC) of z over x, y to the points with 10 < x < 70, |y| < 3, -1.86 - 0.01 x < z < -1.55 m, so of
a road ahead of a sensor 1.7 m above it. Quirks: the normal is made a unit vector, the offset is not; residuals are
squared before they are compared with the median deviation of z; with 5 points or fewer the plane is z = 1.55, above
the sensor instead of below. Ground points are within 0.5 m of it.

Intensities of ground points over the cosine of incidence give two lines over range: the ordinary one (least squares),
and the noise line, through the emptiest occupied of 2555 bins of intensity (5 to the largest) in each of 50 bins of
range from 10 to 70 m. In the published code ties among the emptiest fall as numpy's build has them; here the darkest
counts, as in that build for the synthetic clouds of the tests. The noise floor of snow is a parabola over
range through the noise line times a factor times the cosine of each ground point.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.published.cloud import Cloud, RandomSource
from sim.geometry import Array

_TRIALS = 1000
_SAMPLE = 3
_CONFIDENCE = 0.99
_LEAST_FIT = 6
_HALF_M = 0.5
_RANGE_BINS, _NEAR_M, _FAR_M = 50, 10.0, 70.0
_LEVEL_BINS, _LOWEST = 2555, 5.0
_LEAST_LINE = 4


class Plane(NamedTuple):
    """A plane normal . p + offset = 0.

    Attributes:
        normal: (3,) unit vector.
        offset: m, as published: not divided by the norm of the unnormalised normal.
    """

    normal: Array
    offset: float


FALLBACK = Plane(np.array([0.0, 0.0, 1.0]), -1.55)
"""Plane where none can be fitted."""


class FittedGround(NamedTuple):
    """G ground points of a cloud.

    Attributes:
        rows: (P,) mask of the points.
        range_m: (G,).
        cosine: (G,) of the angle of incidence.
    """

    rows: NDArray[np.bool_]
    range_m: Array
    cosine: Array


def fit_plane(points: Cloud, rng: RandomSource) -> Plane:
    """Fit the ground plane.

    Args:
        points: (P, 3) or a cloud.
        rng: draws three different points per trial, one after the other, and again where one repeats. A legacy
            generator gives the published plane if 300 points or more are eligible.
    """
    x, y, z = np.array(points[:, :3].T, np.float64)
    eligible = (x > 10.0) & (x < 70.0) & (np.abs(y) < 3.0) & (z < -1.55) & (z > -1.86 - 0.01 * x)
    if eligible.sum() < _LEAST_FIT:
        return FALLBACK
    flat, height = np.column_stack([x, y])[eligible], z[eligible]
    slope, offset = _least_squares(flat, height, _consensus(flat, height, rng))
    normal = np.append(slope, -1.0)
    return Plane(normal / np.linalg.norm(normal), offset)


def ground_of(points: Cloud, plane: Plane) -> FittedGround:
    """Return the points within half a metre of a plane."""
    x, y, z = np.array(points[:, :3].T, np.float64)
    height = plane.normal[0] * x + plane.normal[1] * y + plane.normal[2] * z
    rows = np.abs(height + plane.offset) < _HALF_M
    range_m = np.sqrt(x[rows] ** 2 + y[rows] ** 2 + z[rows] ** 2)
    slant = np.divide(np.abs(height[rows]), range_m, out=np.ones(len(range_m)), where=range_m > 0)
    return FittedGround(rows, range_m, np.clip(slant / np.linalg.norm(plane.normal), 0.0, 1.0))


def labelled_ground(points: Cloud, rows: NDArray[np.bool_]) -> FittedGround:
    """Return labelled ground, taken for level under an upright sensor (Robo3D).

    Args:
        points: (P, 3) or a cloud.
        rows: (P,) mask of ground points.
    """
    p = np.asarray(points, np.float64)[rows, :3]
    range_m = np.linalg.norm(p, axis=1)
    return FittedGround(rows, range_m, np.divide(np.abs(p[:, 2]), range_m, out=np.ones(len(p)), where=range_m > 0))


def intensity_line(ground: FittedGround, intensity: Array) -> Array:
    """Return (2,) slope and offset of intensity / cosine over range; zeros if all ground is at one range.

    Args:
        intensity: (G,) theirs.
    """
    return _line(ground.range_m, _per_cosine(ground, intensity))


def noise_line(ground: FittedGround, intensity: Array) -> Array | None:
    """Return (2,) slope and offset of the noise level over range, for intensities of 0 to 255; None without a fit.

    Args:
        intensity: (G,) theirs.
    """
    level = _per_cosine(ground, intensity)
    if len(level) == 0 or level.max() <= _LOWEST:
        return None
    limits = ((_NEAR_M, _FAR_M), (_LOWEST, float(level.max())))
    binned = (ground.range_m >= _NEAR_M) & (ground.range_m <= _FAR_M) & (level >= _LOWEST)
    count, near, low = np.histogram2d(ground.range_m[binned], level[binned], (_RANGE_BINS, _LEVEL_BINS), limits)
    count[count == 0] = len(level)
    darkest = low[count.argmin(axis=1)]
    filled = darkest > _LOWEST
    if filled.sum() < _LEAST_LINE:
        return None
    return _line((0.5 * (near[:-1] + near[1:]))[filled], darkest[filled])


def noise_floor(ground: FittedGround, line: Array, factor: float) -> Array:
    """Return (3,) coefficients of snow's noise floor, a parabola over range, highest power first.

    Args:
        ground: points that it is fitted to.
        factor: of the line, 0.7.
    """
    return np.polyfit(ground.range_m, factor * np.polyval(line, ground.range_m) * ground.cosine, 2)


def _per_cosine(ground: FittedGround, intensity: Array) -> Array:
    return np.divide(intensity, ground.cosine, out=np.zeros(len(intensity)), where=ground.cosine > 0)


def _consensus(flat: Array, height: Array, rng: RandomSource) -> NDArray[np.bool_]:
    """Return (N,) inliers of the best plane through three points (RANSAC, squared residuals)."""
    tolerance = np.median(np.abs(height - np.median(height)))
    best, best_fit, found = 1, -np.inf, np.ones(len(height), bool)
    trials, trial = float(_TRIALS), 0
    while trial < trials:
        trial += 1
        slope, offset = _least_squares(flat, height, _three(len(height), rng))
        residual = (height - flat @ slope - offset) ** 2
        agreeing = residual <= tolerance
        number = int(agreeing.sum())
        if number < best:
            continue
        spread = ((height[agreeing] - height[agreeing].mean()) ** 2).sum()
        fit = 1.0 - residual[agreeing].sum() / spread if spread > 0 else 0.0
        if number == best and fit < best_fit:
            continue
        best, best_fit, found = number, fit, agreeing
        trials = min(trials, _needed(number / len(height)))
    return found


def _needed(share: float) -> float:
    """Return the number of trials of which one has three inliers with a probability of 99 %."""
    missing = max(float(np.finfo(np.float64).eps), 1.0 - share**_SAMPLE)
    return np.inf if missing >= 1.0 else float(np.ceil(np.log(1.0 - _CONFIDENCE) / np.log(missing)))


def _three(number: int, rng: RandomSource) -> NDArray[np.int64]:
    draw = rng.integers if isinstance(rng, np.random.Generator) else rng.randint
    rows: list[int] = []
    while len(rows) < _SAMPLE:
        row = int(draw(number))
        if row not in rows:
            rows.append(row)
    return np.array(rows)


def _least_squares(flat: Array, height: Array, rows: NDArray[np.generic]) -> tuple[Array, float]:
    """Return slopes and offset of the best plane through some points."""
    x, z = flat[rows], height[rows]
    slope = np.linalg.lstsq(x - x.mean(axis=0), z - z.mean(), rcond=None)[0]
    return slope, float(z.mean() - x.mean(axis=0) @ slope)


def _line(x: Array, y: Array) -> Array:
    """Return slope and offset of the best line."""
    spread = x - x.mean() if len(x) else x
    if not (spread**2).sum() > 0:
        return np.zeros(2)
    slope = (spread * y).sum() / (spread**2).sum()
    return np.array([slope, y.mean() - slope * x.mean()])
