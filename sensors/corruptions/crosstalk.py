"""Crosstalk: pulses of other LiDARs received as own returns.

| severity                              | 1   | 2 | 3 | 4 | 5 |
|---------------------------------------|-----|---|---|---|---|
| beams that receive a foreign pulse, % | 0.5 | 1 | 2 | 4 | 8 |

A foreign pulse gives a wrong time of flight and a right direction. Sensors are not synchronised, so the pulse arrives
at any time while the receiver is open: the false range is uniform between the nearest and the farthest range of the
beam. Its power is log-uniform between that of a white target at 100 m (or the detection threshold, if that is more) and
that of one at 10 m (assumed: the other sensor's light comes off all kinds of surfaces).

A beam without a return reports the pulse; one with a return reports the stronger of the two, or the farther when the
sensor reports last returns (of two returns the second competes). Dark and far targets are replaced more often, about
every second one of a street, so that at level 3 one return in a hundred is false, the share in the DSRC paper. False
points are on no object; those of beams without a return come after all others. The rest is bit-identical, and the
pulses of a severity are among those of the next. Shares are assumed.
"""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.cross_sensor import DEFAULT_RANGE_MAX_M
from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.medium import NO_SURFACE, Echo, open_echoes
from sensors.corruptions.physics.receiver import OVERLAP_START_M, detection_threshold, reported_intensity, target_power
from sensors.sweep import POINT_FIELDS, Sweep, make_sweep

POWER = (1e-4, 1e-2)
"""Power of the weakest and the strongest foreign pulse, see `receiver`: white targets at 100 and at 10 m."""


class Crosstalk(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        share: foreign pulses per beam of a sweep.
        range_10_m: see `LidarSpec`; None for what `receiver` takes.
    """

    LEVELS: ClassVar = {"share": (0.005, 0.01, 0.02, 0.04, 0.08)}
    RANGES: ClassVar = {"share": (0.0, 1.0)}

    share: float = 0.02
    range_10_m: float | None = None


def corrupt(sweep: Sweep, settings: Crosstalk, rng: np.random.Generator) -> Sweep:
    """Replace returns by foreign pulses, and add those of beams without a return."""
    beams, columns = _beams(sweep)
    drawn = rng.random((round(settings.share * beams), 3))
    if len(drawn) == 0:
        return sweep
    beam, quantile = (drawn[:, 0] * beams).astype(np.intp), drawn[:, 1:]
    ring, column = np.divmod(beam, columns or 1)
    nearest, farthest = _window(sweep, ring)
    place = nearest + (farthest - nearest) * quantile[:, 0]
    threshold = detection_threshold(sweep.spec, settings.range_10_m)
    faintest = max(POWER[0], threshold)
    power = faintest * (max(POWER[1], threshold) / faintest) ** quantile[:, 1]
    row = _last_row(sweep, beam, beams, columns)
    returned, silent = np.flatnonzero(row >= 0), np.flatnonzero(row < 0)
    # Of two pulses in one beam the first is added, and the last one that wins replaces the return.
    silent = silent[np.unique(beam[silent], return_index=True)[1]]
    wins = returned[_wins(sweep, row[returned], place[returned], power[returned], threshold)]
    added = open_echoes(sweep, ring[silent], column[silent], Echo(place[silent], power[silent]))
    return _with_false(sweep, row[wins], Echo(place[wins], power[wins]), added)


def _beams(sweep: Sweep) -> tuple[int, int | None]:
    """Return the number of beams and of columns; without columns every point is a beam, and the second is None."""
    spec = sweep.spec
    if spec is None or not (sweep.column.any() or len(sweep) <= 2 * spec.rings):
        return len(sweep), None
    known = len(sweep) == 0 or (
        0 <= sweep.column.min() <= sweep.column.max() < spec.columns
        and 0 <= sweep.ring.min() <= sweep.ring.max() < spec.rings
    )
    return (spec.rings * spec.columns, spec.columns) if known else (len(sweep), None)


def _last_row(sweep: Sweep, beam: NDArray[np.intp], beams: int, columns: int | None) -> NDArray[np.intp]:
    """Return (N,) the row of each beam's last return, -1 without one."""
    if columns is None:
        return beam
    key = sweep.ring.astype(np.int32) * np.int32(columns) + sweep.column
    if len(key) and (key[1:] >= key[:-1]).all():
        # Few beams: a search in sorted points is faster than a table of all beams.
        order = np.argsort(beam)
        wanted = beam[order].astype(np.int32)
        last = np.searchsorted(key, wanted, "right") - 1
        found = np.zeros(len(beam), np.intp)
        found[order] = np.where(key[last] == wanted, last, -1)
        return found
    row = np.full(beams, -1, np.int32)
    row[key] = np.arange(len(sweep), dtype=np.int32)
    return row[beam].astype(np.intp)


def _window(sweep: Sweep, ring: NDArray[np.intp]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N,) nearest and farthest range of beams by their rings, m."""
    if sweep.spec is None:
        return np.full(len(ring), OVERLAP_START_M), np.full(len(ring), DEFAULT_RANGE_MAX_M)
    nearest, farthest = sweep.spec.beam_range[ring % sweep.spec.rings].T
    return np.minimum(np.maximum(nearest, OVERLAP_START_M), farthest), farthest


def _wins(
    sweep: Sweep, row: NDArray[np.intp], place: NDArray[np.float64], power: NDArray[np.float64], threshold: float
) -> NDArray[np.bool_]:
    """Return (N,) mask of pulses that are reported instead of the returns in `row`."""
    points = sweep.points[row]
    reach = np.sqrt(np.einsum("ni,ni->n", points, points)).astype(np.float64)
    if sweep.spec is not None and sweep.spec.returns == "last":
        return place > reach
    columns = {name: getattr(sweep, name)[row] for name in ("intensity", "material", "cosine")}
    own = make_sweep(points, spec=sweep.spec, **columns)
    return power > np.maximum(target_power(own, reach), threshold)


def _with_false(sweep: Sweep, row: NDArray[np.integer], echo: Echo, added: Sweep) -> Sweep:
    """Return the sweep with some points moved along their rays to the false range, and others added."""
    stale = {name for name, value in NO_SURFACE.items() if (getattr(sweep, name)[row] != value).any()}
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(sweep, name), getattr(added, name)])
        for name in POINT_FIELDS
        if len(added) or name in stale or name in ("points", "intensity")
    }
    reach = np.maximum(np.linalg.norm(sweep.points[row], axis=1), 1e-6)
    columns["points"][row] *= (echo.range_m / reach)[:, None].astype(np.float32)
    columns["intensity"][row] = reported_intensity(sweep.spec, echo.power, echo.range_m)
    for name in stale:
        columns[name][row] = NO_SURFACE[name]
    return replace(sweep, **columns)
