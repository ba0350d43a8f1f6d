"""Cross sensor: another LiDAR than in training, with fewer beams, fewer firings and a shorter range.

| severity                             | 1   | 2   | 3   | 4   | 5   |
|--------------------------------------|-----|-----|-----|-----|-----|
| rings removed, of 64                 | 16  | 32  | 32  | 48  | 48  |
| one firing kept of                   | 1   | 1   | 2   | 2   | 4   |
| range, relative to the sensor's own  | 0.9 | 0.8 | 0.7 | 0.6 | 0.5 |

The severities make a cheaper sensor of the same kind: rings are removed evenly (ring 0 stays), of the columns every
second or fourth is fired, and both the farthest range and the range at which dark targets are detected shrink. Instead,
`target` names a sensor (`sensors.presets`): each of its beams takes the ring nearest to it, each of its firings the
column nearest to it, and points outside its ranges or too faint for it are gone. A target with more beams than the
sensor adds none.

Firings are thinned by azimuth, with one phase for the whole rotation, so the azimuth step of every ring grows as a
slower sensor's does (Wei 2022, LiDAR-Distillation); thinning a list of points lets the phase slip where a beam had no
return. Missing columns are estimated by azimuth (`_columns`). The corruption is deterministic. Level 3 has the rings
and firings of the DSRC paper's code.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings, proportional_rings
from sensors.corruptions.physics.receiver import DEFAULT_RANGE_10_M, detection_threshold, target_power
from sensors.corruptions.physics.rings import Rings, rings_of
from sensors.presets import get_lidar
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.errors import DataError, SettingsError, complaint

DEFAULT_RANGE_MAX_M = 120.0
"""Farthest range of an unknown sensor, m."""

_FULL_TURN = 2.0 * np.pi
_SAMPLED_RINGS = 8


class CrossSensor(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rings_of_64: rings removed from a sensor of 64 rings; from others in proportion.
        keep_one_of: n: every n-th firing is kept.
        reach: farthest range and detection range, relative to the sensor's own.
        target: name of a sensor to become instead; then the numbers above are not used.
    """

    LEVELS: ClassVar = {
        "rings_of_64": (16, 32, 32, 48, 48),
        "keep_one_of": (1, 1, 2, 2, 4),
        "reach": (0.9, 0.8, 0.7, 0.6, 0.5),
    }
    RANGES: ClassVar = {
        "rings_of_64": (0, 63),
        "keep_one_of": (1, 1000),
        "reach": (0.01, 1.0),
    }

    rings_of_64: int = 32
    keep_one_of: int = 2
    reach: float = 0.7
    target: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target is not None and get_lidar(self.target).prisms:
            raise SettingsError(complaint("CrossSensor", "target", "a sensor with rings", self.target))


def corrupt(sweep: Sweep, settings: CrossSensor, rng: np.random.Generator) -> Sweep:
    """Return the points of the other sensor's beams, unchanged and in order; `rng` is unused.

    Raises:
        DataError: rings are missing and cannot be estimated, are not those of the sensor, or `target` is set for a
            sensor without rings.
    """
    if len(sweep) == 0:
        return sweep
    rings = rings_of(sweep, "cross_sensor")
    if settings.target is not None:
        target = get_lidar(settings.target)
        if sweep.spec is not None and sweep.spec.prisms:
            raise DataError(complaint("cross_sensor", "spec", "a sensor with rings", sweep.spec.name))
        limits = (target.range_min_m, target.range_max_m, target.range_10_m)
        return _within_reach(sweep[_beams_like(sweep, rings, target)], *limits)
    present = np.ones(rings.count, bool)
    present[removed_rings(rings.count, proportional_rings(rings.count, settings.rings_of_64))] = False
    kept = present[rings.ring]
    if settings.keep_one_of > 1:
        column, _ = _columns(sweep, rings)
        kept &= column % settings.keep_one_of == 0
    farthest, detected = _own_reach(sweep.spec)
    return _within_reach(sweep[kept], 0.0, settings.reach * farthest, settings.reach * detected)


def removed_rings(rings: int, removed: int) -> NDArray[np.int64]:
    """Return (removed,) rings to remove of `rings`, evenly spaced, the first of them ring 1."""
    removed = min(removed, rings - 1)
    if removed <= 0:
        return np.zeros(0, np.int64)
    return 1 + np.arange(removed) * rings // removed


def _own_reach(spec: LidarSpec | None) -> tuple[float, float]:
    return (DEFAULT_RANGE_MAX_M, DEFAULT_RANGE_10_M) if spec is None else (spec.range_max_m, spec.range_10_m)


def _within_reach(sweep: Sweep, nearest: float, farthest: float, range_10_m: float) -> Sweep:
    """Keep the points between two ranges that a sensor of this `LidarSpec.range_10_m` detects.

    Intensities below the own sensor's detection threshold are uninformative: there the ranges decide.
    """
    reach = sweep.range.astype(np.float64)
    kept = (reach >= nearest) & (reach <= farthest)
    threshold, own = (
        detection_threshold(sweep.spec, range_10_m),
        detection_threshold(sweep.spec, _own_reach(sweep.spec)[1]),
    )
    if threshold > own:
        power = target_power(sweep, reach)
        kept &= (power >= threshold) | (power < own)
    return sweep[kept]


def _beams_like(sweep: Sweep, rings: Rings, target: LidarSpec) -> NDArray[np.bool_]:
    """Return (P,) mask of points whose beam is the nearest to a beam of the target."""
    present = np.zeros(rings.count, bool)
    order = np.argsort(rings.elevation, kind="stable")
    present[order[_nearest(rings.elevation[order], target.elevation)]] = True
    column, azimuth = _columns(sweep, rings)
    start, end = np.radians(target.azimuth_start_deg), np.radians(target.azimuth_end_deg)
    seen = (azimuth - start) % _FULL_TURN < end - start
    fired = np.zeros(len(azimuth), bool)
    order = np.flatnonzero(seen)[np.argsort(((azimuth - start) % _FULL_TURN)[seen], kind="stable")]
    if len(order):
        wanted = (np.arange(target.columns) / target.columns) * (end - start)
        fired[order[_nearest(((azimuth - start) % _FULL_TURN)[order], wanted)]] = True
    return present[rings.ring] & fired[column]


def _nearest(have: NDArray[np.floating], wanted: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the rows of ascending (N,) values nearest to the (M,) wanted ones, without matches that are too far.

    Too far is half the distance to the next value, or half the median distance beyond both ends.
    """
    if len(have) == 1:
        return np.zeros(1, np.intp)
    right = np.clip(np.searchsorted(have, wanted), 1, len(have) - 1)
    row = right - (wanted - have[right - 1] <= have[right] - wanted)
    margin = 0.5 * float(np.median(np.diff(have))) + 1e-9
    return np.unique(row[(wanted >= have[0] - margin) & (wanted <= have[-1] + margin)])


def _columns(sweep: Sweep, rings: Rings) -> tuple[NDArray[np.int64], NDArray[np.floating]]:
    """Return (P,) columns and (C,) the azimuth of each, rad.

    Missing columns follow from the azimuth: the step is that between neighbours in the fullest rings, the phase each
    ring's own, since the beams of a head differ in azimuth.
    """
    if sweep.spec is not None and (sweep.column.any() or len(sweep) <= sweep.spec.rings):
        return sweep.column.astype(np.int64) % sweep.spec.columns, sweep.spec.azimuth
    azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]).astype(np.float64)
    count = np.bincount(rings.ring, minlength=rings.count)
    steps = [_step(azimuth[rings.ring == ring]) for ring in np.argsort(-count, kind="stable")[:_SAMPLED_RINGS]]
    columns = max(1, round(_FULL_TURN / float(np.median(steps))))
    turned = azimuth * (columns / _FULL_TURN)
    # The circular mean of where points lie between two columns.
    circle = np.exp(2j * np.pi * turned)
    real, imaginary = (np.bincount(rings.ring, part, rings.count) for part in (circle.real, circle.imag))
    phase = np.arctan2(imaginary, real) / _FULL_TURN
    column = np.rint(turned - phase[rings.ring]).astype(np.int64) % columns
    return column, np.arange(columns) * (_FULL_TURN / columns)


def _step(azimuth: NDArray[np.float64]) -> float:
    """Return the median azimuth step between neighbouring points, rad; a full turn without points."""
    steps = np.diff(np.sort(azimuth))
    steps = steps[steps > 1e-5]
    return float(np.median(steps)) if len(steps) else _FULL_TURN
