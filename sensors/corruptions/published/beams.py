"""Beam missing and cross sensor, as published.

Beam missing: the points of some rings are deleted, the others unchanged.

| severity              | 1 | 2 | 3 (DSRC's text) | 4 (DSRC's code) | 5 (number of Robo3D heavy) |
|-----------------------|---|---|-----------------|-----------------|----------------------------|
| rings missing, of 64  | 4 | 8 | 16              | 32              | 48                         |

Robo3D draws 16, 32 or 48 ring numbers from 4 to 58 with replacement, so that some 14.0, 24.4 and 32.2 rings are missing
(55 (1 - (54/55)^m)); for nuScenes 8, 16 or 24 from 2 to 28, which is the same share. DSRC's code counts 64 rings on any
sensor (`azimuth_wrap` does); by default the sensor's own rings are taken, and the same share of them.

Cross sensor: rings 1, 1 + s, 1 + 2 s, ... rounded down are deleted, with s = 64 / rings deleted, cut to two decimals,
and of the list of what remains every n-th point is kept, so that the phase slips where a ring has an odd count. After
Wei et al. (LiDAR-Distillation), whose own method keeps whole rings, counted from the lowest, and in each of them every
n-th point by azimuth.

| severity              | 1  | 2                     | 3 (DSRC)  | 4 (Robo3D heavy) | 5  |
|-----------------------|----|-----------------------|-----------|------------------|----|
| rings deleted, of 64  | 16 | 32 (Wei's 32)         | 32        | 48               | 48 |
| one point kept of     | 1  | 1                     | 2         | 2                | 4  |

Robo3D's light, moderate and heavy delete 16, 32, 48 (nuScenes 8, 16, 24) and keep every second point; moderate is what
DSRC does, and what CoopDiff calls electromagnetic interference (EMI). MultiCorrupt keeps every second, fourth or eighth
ring whole, from the second lowest on. Cross sensor has no randomness.
"""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings, check_range, proportional_rings
from sensors.corruptions.published.cloud import Cloud, RandomSource
from sensors.corruptions.published.rings import RingSource, rings_from
from sensors.sweep import Sweep


class PaperBeamMissing(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `beam_missing`.

    Attributes:
        rings_of_64: rings drawn for a sensor of 64 rings; for others in proportion.
        replaced: draw with replacement, so that fewer are missing (Robo3D).
        first_of_64, after_of_64: bounds of the drawn rings, the second excluded.
        rings: source of the points' rings.
    """

    LEVELS: ClassVar = {"rings_of_64": (4, 8, 16, 32, 48)}
    RANGES: ClassVar = {"rings_of_64": (0, 64), "after_of_64": (1, 64)}

    rings_of_64: int = 16
    replaced: bool = False
    first_of_64: int = 0
    after_of_64: int = 64
    rings: RingSource = "sweep"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("PaperBeamMissing", "first_of_64", self.first_of_64, 0, self.after_of_64 - 1)


class PaperCrossSensor(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `cross_sensor`.

    Attributes:
        rings_of_64: rings deleted of a sensor of 64 rings; of others in proportion.
        keep_one_of: n: every n-th point is kept.
        method: `list` deletes rings and thins the list of the rest (DSRC, Robo3D); `azimuth` keeps every n-th ring from
            the lowest on, n the share that remains, and thins each by azimuth (LiDAR-Distillation).
        first: lowest ring that `azimuth` keeps, 0 = bottom.
        rings: source of the points' rings.
    """

    LEVELS: ClassVar = {"rings_of_64": (16, 32, 32, 48, 48), "keep_one_of": (1, 1, 2, 2, 4)}
    RANGES: ClassVar = {"rings_of_64": (0, 63), "keep_one_of": (1, 1000), "first": (0, 63)}

    rings_of_64: int = 32
    keep_one_of: int = 2
    method: Literal["list", "azimuth"] = "list"
    first: int = 0
    rings: RingSource = "sweep"


PUBLISHED_BEAM_MISSING: dict[str, PaperBeamMissing] = {
    "dsrc_text": PaperBeamMissing(),
    "dsrc": PaperBeamMissing(rings_of_64=32, rings="azimuth_wrap"),
    "robo3d_light": PaperBeamMissing(rings_of_64=16, replaced=True, first_of_64=4, after_of_64=59),
    "robo3d_moderate": PaperBeamMissing(rings_of_64=32, replaced=True, first_of_64=4, after_of_64=59),
    "robo3d_heavy": PaperBeamMissing(rings_of_64=48, replaced=True, first_of_64=4, after_of_64=59),
}
"""Settings by source; Robo3D takes the rings of KITTI by azimuth wrap and those of nuScenes from its files."""

PUBLISHED_CROSS_SENSOR: dict[str, PaperCrossSensor] = {
    "dsrc": PaperCrossSensor(rings="azimuth_wrap"),
    "coopdiff_emi": PaperCrossSensor(rings="azimuth_wrap"),
    "multicorrupt_1": PaperCrossSensor(rings_of_64=32, keep_one_of=1, method="azimuth", first=1),
    "multicorrupt_2": PaperCrossSensor(rings_of_64=48, keep_one_of=1, method="azimuth", first=1),
    "multicorrupt_3": PaperCrossSensor(rings_of_64=56, keep_one_of=1, method="azimuth", first=1),
    "robo3d_light": PaperCrossSensor(rings_of_64=16),
    "robo3d_moderate": PaperCrossSensor(rings_of_64=32),
    "robo3d_heavy": PaperCrossSensor(rings_of_64=48),
    "lidar_distillation_32": PaperCrossSensor(rings_of_64=32, keep_one_of=1, method="azimuth", rings="k_means"),
    "lidar_distillation_32^": PaperCrossSensor(rings_of_64=32, keep_one_of=2, method="azimuth", rings="k_means"),
    "lidar_distillation_16": PaperCrossSensor(rings_of_64=48, keep_one_of=1, method="azimuth", rings="k_means"),
    "lidar_distillation_16^": PaperCrossSensor(rings_of_64=48, keep_one_of=2, method="azimuth", rings="k_means"),
}


def beam_missing(sweep: Sweep, settings: PaperBeamMissing, rng: RandomSource) -> Sweep:
    """Delete all points of some rings; see `missing_rings`.

    Raises:
        DataError: `rings` is `sweep`, and they are missing and cannot be estimated.
    """
    ring, rings = rings_from(sweep, settings.rings, "beam_missing")
    return sweep[~np.isin(ring, missing_rings(settings, rings, rng))]


def cross_sensor(sweep: Sweep, settings: PaperCrossSensor, rng: RandomSource) -> Sweep:
    """Keep the points of another sensor; `rng` is unused.

    Raises:
        DataError: `rings` is `sweep`, and they are missing and cannot be estimated.
    """
    ring, rings = rings_from(sweep, settings.rings, "cross_sensor")
    return sweep[kept_points(sweep.points, ring, rings, settings)]


def missing_rings(settings: PaperBeamMissing, rings: int, rng: RandomSource) -> NDArray[np.int64]:
    """Draw the missing rings, in the order of drawing; a legacy generator gives those of the release.

    Those of a lower `rings_of_64` are the first of those of a higher one.
    """
    number = proportional_rings(rings, settings.rings_of_64)
    first, after = settings.first_of_64 * rings // 64, settings.after_of_64 * rings // 64
    if settings.replaced:
        return first + (rng.random(number) * (after - first)).astype(np.int64)
    return first + rng.permutation(after - first)[:number]


def kept_points(points: Cloud, ring: NDArray[np.integer], rings: int, settings: PaperCrossSensor) -> NDArray[np.bool_]:
    """Return (P,) mask of the points that the other sensor keeps.

    Args:
        points: (P, 3) or a cloud, in the order of the file.
        ring: (P,) in [0, rings), 0 = top.
    """
    if settings.method == "azimuth":
        return _thinned_by_azimuth(points, ring, rings, settings)
    kept = np.zeros(len(points), bool)
    remaining_points = np.flatnonzero(
        ~np.isin(ring, deleted_rings(rings, proportional_rings(rings, settings.rings_of_64)))
    )
    kept[remaining_points[:: settings.keep_one_of]] = True
    return kept


def deleted_rings(rings: int, number: int) -> NDArray[np.int64]:
    """Return (number,) rings that a cross sensor deletes."""
    number = min(number, rings - 1)
    if number <= 0:
        return np.zeros(0, np.int64)
    step = (100 * rings // number) / 100.0
    return np.floor(1.0 + np.arange(number) * step).astype(np.int64)


def _thinned_by_azimuth(
    points: Cloud, ring: NDArray[np.integer], rings: int, settings: PaperCrossSensor
) -> NDArray[np.bool_]:
    """Return (P,) mask of points that LiDAR-Distillation keeps; azimuth from +x, counter-clockwise to a full turn."""
    every = rings // (rings - min(proportional_rings(rings, settings.rings_of_64), rings - 1))
    azimuth = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2.0 * np.pi)
    order = np.lexsort((azimuth, ring))
    sorted_ring = ring[order]
    place = np.arange(len(order)) - np.searchsorted(sorted_ring, sorted_ring)
    kept = np.zeros(len(points), bool)
    kept[order] = ((rings - 1 - sorted_ring) % every == settings.first % every) & (place % settings.keep_one_of == 0)
    return kept
