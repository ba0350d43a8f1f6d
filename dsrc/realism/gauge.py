"""Gauge of realism: the figures of real sweeps beside those of simulated ones, and how far apart they are.

The distance of a figure is Wasserstein's of first order, in the figure's unit: the mean way by which one distribution
has to be moved to become the other. Every sweep weighs the same, however many values it has. The interval is the
percentile bootstrap over sweeps. Two yardsticks stand beside it: the distance between random halves of the real sweeps,
which no simulation needs to undercut, and the spread of the real figure, by which figures of different units are
summed up.

Source: L. V. Kantorovich, On the translocation of masses (1942); scipy.stats.wasserstein_distance for one dimension;
B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap (1993), chapter 13.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from dsrc.data.drives import drive_hashes, list_drives, open_drive
from dsrc.realism.figures import BEAMS, FIGURES, FigureOf, Samples, figures_of, sweeps_of
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.jobs import results_of
from dsrc.runs.provenance import provenance
from sim.errors import DataError, SettingsError, complaint

RESAMPLES = 200
HALVES = 40
LEVEL = 0.95
_FEWEST_SWEEPS = 4
"""Fewest real sweeps whose halves differ, or whose spread one number each tells."""
_ALIKE = 1e-6
"""Difference of values that are alike, as a share of the largest."""
SHOWN = (0.1, 0.5, 0.9)
"""Quantiles that tables show."""


@dataclass(frozen=True, slots=True)
class Row:
    """A figure of real and of simulated sweeps.

    Attributes:
        figure: which one.
        sweeps: real and simulated sweeps that have it.
        real: `SHOWN` quantiles of the real values.
        simulated: of the simulated ones.
        distance: between the two, in the figure's unit.
        low, high: interval of the distance.
        halves: median distance between halves of the real sweeps; NaN for fewer than four sweeps.
        spread: standard deviation of the real values; NaN where they are all alike, or one each of fewer than four
            sweeps.
    """

    figure: FigureOf
    sweeps: tuple[int, int]
    real: tuple[float, ...]
    simulated: tuple[float, ...]
    distance: float
    low: float
    high: float
    halves: float
    spread: float

    @property
    def relative(self) -> float:
        """Distance in spreads of the real figure; NaN where it has none."""
        return self.distance / self.spread


def compare(real: Sequence[Samples], simulated: Sequence[Samples], seed: int = 0) -> list[Row]:
    """Return the figures that real and simulated sweeps both have, in the order of `FIGURES`.

    Args:
        real: figures of each real sweep, see `figures_of`.
        simulated: of each simulated sweep.
        seed: of resamples and halves.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for figure in FIGURES:
        one, other = ([sweep[figure.name] for sweep in sweeps if figure.name in sweep] for sweeps in (real, simulated))
        if one and other:
            rows.append(_row(figure, one, other, rng))
    return rows


def families_of(rows: Sequence[Row]) -> dict[str, float]:
    """Return the mean of the relative distances of each family; NaN where none is known."""
    return {family: float(np.mean(known)) if known else math.nan for family, (known, _) in _by_family(rows).items()}


def counts_of(rows: Sequence[Row]) -> dict[str, tuple[int, int]]:
    """Return the number of figures that the number of each family is a mean of, and that of all its figures."""
    return {family: (len(known), count) for family, (known, count) in _by_family(rows).items()}


def _by_family(rows: Sequence[Row]) -> dict[str, tuple[list[float], int]]:
    """Return the known relative distances of each family, and the number of its figures."""
    families = dict.fromkeys(row.figure.family for row in rows)
    own = {family: [row.relative for row in rows if row.figure.family == family] for family in families}
    return {family: ([one for one in values if math.isfinite(one)], len(values)) for family, values in own.items()}


def sensors_text(real: Sequence[Samples], simulated: Sequence[Samples]) -> str:
    """Return what speaks against one sensor of all sweeps, in one line: different numbers of beams; "" if nothing."""
    counts = [sorted({int(sweep[BEAMS][0]) for sweep in sweeps if BEAMS in sweep}) for sweeps in (real, simulated)]
    if len({*counts[0], *counts[1]}) < 2:
        return ""
    told = [" and ".join(map(str, own)) or "unknown numbers of" for own in counts]
    return f"sweeps of several sensors: the real ones have {told[0]} beams, the simulated ones {told[1]}"


def measure(
    roots: Sequence[Path],
    frames: int | None = None,
    seed: int = 0,
    pool: Pool = SERIAL,
    progress: Progress | None = None,
) -> list[Samples]:
    """Return the figures of the vehicles' sweeps in drives, in any supported format.

    Args:
        roots: drives, or folders of them.
        frames: frames of each drive, evenly spread; None for all.
        seed: of the points whose neighbourhoods are looked at.

    Raises:
        DataError: a folder holds no drives, or no vehicle has a sweep.
        SettingsError: less than one frame.
    """
    if frames is not None and frames < 1:
        raise SettingsError(complaint("realism", "frames", "at least 1", frames))
    jobs: list[tuple[Path, int, int]] = []
    for drive in (path for root in roots for path in list_drives(root)):
        count = len(open_drive(drive))
        wanted = count if frames is None else min(frames, count)
        jobs += [(drive, int(i), seed) for i in np.linspace(0, count - 1, wanted).round()]
    found: dict[int, list[Samples]] = {}
    for result in results_of(_measure, jobs, pool, progress):
        if result.error is not None:
            raise result.error
        found[result.row] = result.value
    samples = [sweep for row in sorted(found) for sweep in found[row]]
    if not samples:
        places = ", ".join(map(str, roots))
        raise DataError(complaint(places, "agents", "a vehicle with a sweep", "none"))
    return samples


def provenance_of(real: Sequence[Path], simulated: Sequence[Path], frames: int | None, seed: int) -> dict[str, Any]:
    """Return what made a comparison, with the hashes of its drives."""
    drives = [drive for root in (*real, *simulated) for drive in list_drives(root)]
    settings = {"real": list(map(str, real)), "simulated": list(map(str, simulated)), "frames": frames}
    return provenance(settings, seed, drive_hashes(drives))


def _measure(job: tuple[Path, int, int], progress: Progress) -> list[Samples]:
    drive, position, seed = job
    return [figures_of(sweep, boxes, seed) for sweep, boxes in sweeps_of(open_drive(drive).read(position))]


def _row(
    figure: FigureOf, real: list[NDArray[np.float64]], simulated: list[NDArray[np.float64]], rng: np.random.Generator
) -> Row:
    distances = []
    for _ in range(RESAMPLES):
        again = [[sweeps[k] for k in rng.integers(0, len(sweeps), len(sweeps))] for sweeps in (real, simulated)]
        distances.append(_distance(*again))
    halves = math.nan
    if len(real) >= _FEWEST_SWEEPS:
        splits = []
        for _ in range(HALVES):
            order = rng.permutation(len(real))
            one, other = np.array_split(order, 2)
            splits.append(_distance([real[k] for k in one], [real[k] for k in other]))
        halves = float(np.median(splits))
    low, high = np.quantile(distances, (0.5 - LEVEL / 2, 0.5 + LEVEL / 2))
    return Row(
        figure,
        (len(real), len(simulated)),
        _quantiles(real),
        _quantiles(simulated),
        _distance(real, simulated),
        float(low),
        float(high),
        halves,
        _spread(real),
    )


def _spread(sweeps: Sequence[NDArray[np.float64]]) -> float:
    """Return the standard deviation of a figure, see `Row.spread`."""
    values, weights = _pooled(sweeps)
    if np.ptp(values) <= _ALIKE * np.abs(values).max() or len(values) == len(sweeps) < _FEWEST_SWEEPS:
        return math.nan
    return float(np.sqrt(np.average((values - np.average(values, weights=weights)) ** 2, weights=weights)))


def _pooled(sweeps: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return all values, and weights with which every sweep weighs the same."""
    weights = [np.full(len(sweep), 1.0 / len(sweep)) for sweep in sweeps]
    return np.concatenate(sweeps), np.concatenate(weights)


def _distance(one: Sequence[NDArray[np.float64]], other: Sequence[NDArray[np.float64]]) -> float:
    (values, weights), (values_2, weights_2) = _pooled(one), _pooled(other)
    return float(wasserstein_distance(values, values_2, weights, weights_2))


def _quantiles(sweeps: Sequence[NDArray[np.float64]]) -> tuple[float, ...]:
    values, weights = _pooled(sweeps)
    order = np.argsort(values)
    reached = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    return tuple(float(np.interp(q, reached, values[order])) for q in SHOWN)
