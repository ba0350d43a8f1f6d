"""What a LiDAR reports through a medium that dims its targets and answers by itself: fog, snow and rain share this.

A target whose clear return had power p comes back with p times the transmission, both ways. The medium answers with an
echo of its own from somewhere before the target, or from anywhere in a beam that hit nothing. Of the two the sensor
reports the stronger, if it detects it at all; a sensor that reports last returns keeps the target while it detects it
(of two returns of one beam each is treated so; a third is not made up).

* The target keeps its place and its own intensity, dimmed: `ATTENUATED`, unless an earlier corruption left a mark.
* An echo lies on the target's ray, nearer, on no object: `SCATTERED`.
* What was in the sweep was detected, so it had at least the least power. Where intensities say less (many real sensors
  give 0 to dark targets) its power is that over a uniform number: the chance that it stays is the transmission.
* Open beams, those without a return, are known when the sweep knows its sensor and the columns of its points. A sensor
  that drops beams at random drops their echoes, too: as many of the open beams stay silent as the drop-off explains.

Rays start at the origin of the sweep's frame: in a compensated sweep they truly start where the sensor was when it
fired, less than a metre away at 15 m/s. Echoes in open beams know their firing and are placed exactly. Weather comes
before faults of the sensor: afterwards a dead beam looks open.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.receiver import BLIND_M, least_power, reported_intensity, target_power
from sensors.deskew import deskew
from sensors.optics.beams import beams_of
from sensors.spec import LidarSpec
from sensors.sweep import (
    ADDED,
    ATTENUATED,
    KEPT,
    SCATTERED,
    UNKNOWN_MATERIAL,
    Sweep,
    concatenate,
    make_sweep,
    moved,
    path_at,
    path_of,
)
from sim.geometry import invert

_MOST_RETURNS = 2
"""Points that one beam may have: more mean that a file did not tell their columns."""

OF_NOTHING = {"object_id": ADDED, "fate": SCATTERED, "material": UNKNOWN_MATERIAL, "cosine": 0.0, "return_number": 1}
"""Columns of a return that no surface sent."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Where L lines of sight end: those of the P points of a sweep, then Q open beams.

    Attributes:
        sweep: as measured in clear air.
        open_ring, open_column: (Q,) beams that hit nothing.
        reach: (L,) range of the target, m; for open beams the farthest that the sensor reports.
        power: (L,) of the target in clear air, see `receiver`; 0 for open beams.
        near: (L,) nearest range that is reported, m.
        need: power of the weakest return that is detected.
        beams: number of beams that random numbers are drawn for, whether they hit something or not.
        beam: (L,) index among them.
    """

    sweep: Sweep
    open_ring: NDArray[np.intp]
    open_column: NDArray[np.intp]
    reach: NDArray[np.float64]
    power: NDArray[np.float64]
    near: NDArray[np.float64]
    need: float
    beams: int
    beam: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.reach)

    def draw(self, table: Callable[[int], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return (L,) random numbers, `table(beams)`: one for each beam, so that no target shifts those of others."""
        return table(self.beams)[self.beam]

    def floor(self, through: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (L,) the power that an echo must exceed to be reported.

        Args:
            through: (P,) transmission to the points and back.
        """
        floor = np.full(len(self), self.need)
        hard = floor[: len(through)]
        hard[:] = self.power[: len(through)] * through
        if self.sweep.spec is None or self.sweep.spec.returns == "strongest":
            np.maximum(hard, self.need, out=hard)
        else:
            hard[:] = np.where(hard < self.need, self.need, np.inf)
        return floor


@dataclass(frozen=True, slots=True, eq=False)
class Echo:
    """What the medium itself answers on L lines of sight.

    Attributes:
        range_m: (L,) where from; any number where there is none.
        power: (L,) see `receiver`; 0 where there is none.
    """

    range_m: NDArray[np.float64]
    power: NDArray[np.float64]


def look(sweep: Sweep, range_10_m: float | None, rng: np.random.Generator) -> Sight:
    """Find where the beams of a sweep end.

    Args:
        sweep: as measured in clear air.
        range_10_m: see `least_power`.
        rng: draws the same numbers whatever the weather and whatever was hit.
    """
    rows = np.asarray(sweep.points, np.float64)
    reach = np.sqrt(np.einsum("pi,pi->p", rows, rows))
    need = least_power(sweep.spec, range_10_m)
    beam, beams, ring, column = _beams_known(sweep, rng)
    faint = rng.random(beams)
    power = target_power(sweep, reach)
    weak = np.flatnonzero(power < need)
    power[weak] = need / (1.0 - faint[beam[weak]])
    near, far = np.full(len(sweep), BLIND_M), np.zeros(0)
    if sweep.spec is not None:
        limits = sweep.spec.beam_range
        near = np.maximum(BLIND_M, limits[np.concatenate([sweep.ring % sweep.spec.rings, ring]), 0])
        far = limits[ring, 1]
        beam = np.concatenate([beam, ring * sweep.spec.columns + column])
    return Sight(
        sweep=sweep,
        open_ring=ring,
        open_column=column,
        reach=np.concatenate([reach, far]),
        power=np.concatenate([power, np.zeros(len(ring))]),
        near=near,
        need=need,
        beams=beams,
        beam=beam,
    )


def report(sight: Sight, through: NDArray[np.float64], echo: Echo, shift_m: NDArray[np.float64] | None = None) -> Sweep:
    """Return what the sensor reports through the medium; ring by ring and column by column when echoes were added.

    Args:
        sight: from `look`.
        through: (P,) transmission to the points and back, [0, 1].
        echo: of the medium.
        shift_m: (P,) by how much targets are reported too far, m.
    """
    count = len(sight.sweep)
    scattered = echo.power > sight.floor(through)
    seen = _seen(sight, through, echo, np.flatnonzero(scattered[:count]), shift_m)
    kept = np.flatnonzero(scattered[:count] | (sight.power[:count] * through >= sight.need))
    answered = count + np.flatnonzero(scattered[count:])
    if len(answered) == 0:
        return seen if len(kept) == count else seen[kept]
    added = _added(sight, echo, answered)
    order = np.argsort(sight.beam[np.concatenate([kept, answered])], kind="stable")
    return concatenate(seen, added)[np.concatenate([kept, count + np.arange(len(added))])[order]]


def _seen(
    sight: Sight,
    through: NDArray[np.float64],
    echo: Echo,
    scattered: NDArray[np.intp],
    shift_m: NDArray[np.float64] | None,
) -> Sweep:
    """Return the P points dimmed and shifted, those of some rows replaced by the medium's echo."""
    sweep = sight.sweep
    reach = np.maximum(sight.reach[: len(sweep)], 1e-6)
    columns = {name: getattr(sweep, name).copy() for name in ("points", *OF_NOTHING)}
    if shift_m is not None:
        columns["points"] = (sweep.points * (1.0 + shift_m / reach)[:, None]).astype(np.float32)
    columns["intensity"] = (sweep.intensity * through).astype(np.float32)
    columns["fate"][(sweep.fate == KEPT) & (through < 1.0)] = ATTENUATED
    place, power = echo.range_m[scattered], echo.power[scattered]
    columns["points"][scattered] = sweep.points[scattered] * (place / reach[scattered])[:, None]
    columns["intensity"][scattered] = reported_intensity(sweep.spec, power, place)
    for name, value in OF_NOTHING.items():
        columns[name][scattered] = value
    return replace(sweep, **columns)


def _added(sight: Sight, echo: Echo, lines: NDArray[np.intp]) -> Sweep:
    """Return the echoes of some open beams as a sweep of their own."""
    which = lines - len(sight.sweep)
    ring, column = sight.open_ring[which], sight.open_column[which]
    return open_echoes(sight.sweep, ring, column, Echo(echo.range_m[lines], echo.power[lines]))


def open_echoes(sweep: Sweep, ring: NDArray[np.intp], column: NDArray[np.intp], echo: Echo) -> Sweep:
    """Return a sweep like another one with nothing but echoes of N of its beams, which are on no object.

    Args:
        sweep: gives the sensor, its motion and the time.
        ring: (N,) of the beams.
        column: (N,) of the beams.
        echo: of each of them.
    """
    spec = sweep.spec
    known = sweep.path is not None and sweep.motion != "raw"
    fired = _firing(spec, ring, column) + (_middle_s(sweep) - sweep.time_s)
    points = _axis(sweep, ring, column) * echo.range_m[:, None]
    if known:
        now, *_ = path_at(path_of(sweep), np.array([sweep.time_s]))
        points = moved(invert(now) @ path_at(path_of(sweep), sweep.time_s + fired), points)
    made = make_sweep(
        points,
        sweep.world_from_lidar,
        sweep.time_s,
        spec,
        intensity=reported_intensity(spec, echo.power, echo.range_m),
        ring=ring,
        column=column,
        time_offset=fired,
        **{name: np.full(len(ring), value) for name, value in OF_NOTHING.items()},
    )
    return replace(made, path=sweep.path, motion=sweep.motion)


def _firing(spec: LidarSpec | None, ring: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return `spec.time_offset` of some beams: of all it would take longer than everything else."""
    if spec is None:
        return np.zeros(0)
    return (column - 0.5 * spec.columns + spec.firing_share[ring]) * spec.column_s


def open_axis(sight: Sight) -> NDArray[np.float64]:
    """Return (Q, 3) unit directions of the open beams in the sensor's frame at their firing."""
    return _axis(sight.sweep, sight.open_ring, sight.open_column)


def _axis(sweep: Sweep, ring: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float64]:
    if sweep.spec is None:
        return np.zeros((0, 3))
    return beams_of(sweep.spec, _middle_s(sweep)).axis[:, ring, column].T.astype(np.float64)


def _middle_s(sweep: Sweep) -> float:
    """Return the instant that firing times and rosettes count from; points may be of the sweep's start or end."""
    if sweep.motion in ("middle", "raw") or sweep.path is None:
        return sweep.time_s
    return deskew(sweep[:0], "middle").time_s


def _beams_known(
    sweep: Sweep, rng: np.random.Generator
) -> tuple[NDArray[np.intp], int, NDArray[np.intp], NDArray[np.intp]]:
    """Return (P,) each point's beam, how many there are, and (Q,) ring and column of those without a return.

    Points of a sweep that does not know its beams are beams of their own, and none is open.
    """
    spec, rows = sweep.spec, np.arange(len(sweep))
    unknown = rows, len(sweep), rows[:0], rows[:0]
    if spec is None or not _within(sweep.ring, spec.rings) or not _within(sweep.column, spec.columns):
        return unknown
    beams = spec.rings * spec.columns
    beam = sweep.ring.astype(np.intp) * spec.columns + sweep.column
    returns = np.bincount(beam, minlength=beams)
    if returns.max(initial=0) > _MOST_RETURNS:
        return unknown
    silent = np.flatnonzero(returns == 0)
    if spec.dropoff_rate > 0.0 and len(silent):
        answering = 1.0 - min(spec.dropoff_rate * beams / len(silent), 1.0)
        silent = silent[rng.random(beams)[silent] < answering]
    return beam, beams, *np.divmod(silent, spec.columns)


def _within(index: NDArray[np.integer], count: int) -> bool:
    return len(index) == 0 or (0 <= index.min() and index.max() < count)
