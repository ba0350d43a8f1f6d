"""LiDAR returns through a scattering medium, shared by fog, snow, rain and spray: attenuated targets and echoes.

A target of clear-air power p returns p times the two-way transmission. The medium returns an echo of its own from
before the target, or from anywhere in an open beam, one without a return. The sensor reports the stronger of the two,
if it reaches the detection threshold; a sensor that reports last returns keeps the target while it detects it (two
returns of one beam are each treated so; a third is not added).

* The target keeps its place and its own intensity, attenuated: `ATTENUATED`, unless an earlier corruption marked it.
* An echo lies on the target's ray, nearer, on no object: `SCATTERED`.
* Points of a sweep were detected, so their power reached the threshold. Where intensities say less (many real sensors
  give 0 to dark targets) the power is the threshold over a uniform number: the target stays with the probability of the
  transmission.
* Open beams are known for sweeps with a sensor and the columns of the points. A sensor that drops beams at random drops
  their echoes too: the expected share of open beams stays silent.

Rays start at the origin of the sweep's frame: in a compensated sweep they truly start at the sensor's place at firing,
less than a metre away at 15 m/s. Echoes in open beams are placed exactly, by their firing. Apply weather before faults
of the sensor: a dead beam counts as open.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.receiver import OVERLAP_START_M, detection_threshold, reported_intensity, target_power
from sensors.deskew import deskew
from sensors.optics.beams import beams_of
from sensors.sweep import (
    ADDED,
    ATTENUATED,
    KEPT,
    SCATTERED,
    UNKNOWN_MATERIAL,
    Sweep,
    make_sweep,
    moved,
    path_at,
    path_of,
)
from sim.geometry import invert
from sim.rows import stacked

_MOST_RETURNS = 2
"""Most returns of one beam: more mean that the columns of a file are unknown."""

NO_SURFACE = {"object_id": ADDED, "fate": SCATTERED, "material": UNKNOWN_MATERIAL, "cosine": 0.0, "return_number": 1}
"""Columns of a return without a surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """L rays of a sweep: those of its P points, then Q open beams.

    Attributes:
        sweep: as measured in clear air.
        open_ring, open_column: (Q,) open beams.
        reach: (L,) range of the target, m; for open beams the farthest reported range.
        power: (L,) of the target in clear air, see `receiver`; 0 for open beams.
        near: (L,) nearest reported range, m.
        threshold: detection threshold, a power.
        beams: number of beams with random numbers, open ones included.
        beam: (L,) index of the beam.
    """

    sweep: Sweep
    open_ring: NDArray[np.intp]
    open_column: NDArray[np.intp]
    reach: NDArray[np.float64]
    power: NDArray[np.float64]
    near: NDArray[np.float64]
    threshold: float
    beams: int
    beam: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.reach)

    def draw(self, table: Callable[[int], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return (L,) random numbers of `table(beams)`, one per beam, so that no target shifts the draws of others."""
        return table(self.beams)[self.beam]

    def floor(self, transmission: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (L,) power that an echo must exceed to be reported.

        Args:
            transmission: (P,) transmission to the points and back.
        """
        floor = np.full(len(self), self.threshold)
        hard = floor[: len(transmission)]
        hard[:] = self.power[: len(transmission)] * transmission
        if self.sweep.spec is None or self.sweep.spec.returns == "strongest":
            np.maximum(hard, self.threshold, out=hard)
        else:
            hard[:] = np.where(hard < self.threshold, self.threshold, np.inf)
        return floor


@dataclass(frozen=True, slots=True, eq=False)
class Echo:
    """Echoes of the medium on L rays.

    Attributes:
        range_m: (L,) range, m; arbitrary without an echo.
        power: (L,) see `receiver`; 0 without an echo.
    """

    range_m: NDArray[np.float64]
    power: NDArray[np.float64]


def rays_of(sweep: Sweep, range_10_m: float | None, rng: np.random.Generator) -> Rays:
    """Return the rays of a sweep with their targets.

    Args:
        sweep: as measured in clear air.
        rng: draws the same numbers for any weather and any targets.
    """
    rows = np.asarray(sweep.points, np.float64)
    reach = np.sqrt(np.einsum("pi,pi->p", rows, rows))
    threshold = detection_threshold(sweep.spec, range_10_m)
    beam, beams, ring, column = _beams_known(sweep, rng)
    faint = rng.random(beams)
    power = target_power(sweep, reach)
    weak = np.flatnonzero(power < threshold)
    power[weak] = threshold / (1.0 - faint[beam[weak]])
    near, far = np.full(len(sweep), OVERLAP_START_M), np.zeros(0)
    if sweep.spec is not None:
        limits = sweep.spec.beam_range
        near = np.maximum(OVERLAP_START_M, limits[np.concatenate([sweep.ring % sweep.spec.rings, ring]), 0])
        far = limits[ring, 1]
        beam = np.concatenate([beam, ring * sweep.spec.columns + column])
    return Rays(
        sweep=sweep,
        open_ring=ring,
        open_column=column,
        reach=np.concatenate([reach, far]),
        power=np.concatenate([power, np.zeros(len(ring))]),
        near=near,
        threshold=threshold,
        beams=beams,
        beam=beam,
    )


def report(
    rays: Rays, transmission: NDArray[np.float64], echo: Echo, shift_m: NDArray[np.float64] | None = None
) -> Sweep:
    """Return the sweep through the medium, sorted by ring and column where echoes were added.

    Args:
        transmission: (P,) transmission to the points and back, [0, 1].
        shift_m: (P,) range error of the targets, m.
    """
    count = len(rays.sweep)
    scattered = echo.power > rays.floor(transmission)
    seen = _seen(rays, transmission, echo, np.flatnonzero(scattered[:count]), shift_m)
    kept = np.flatnonzero(scattered[:count] | (rays.power[:count] * transmission >= rays.threshold))
    answered = count + np.flatnonzero(scattered[count:])
    if len(answered) == 0:
        return seen if len(kept) == count else seen[kept]
    which = answered - count
    answers = Echo(echo.range_m[answered], echo.power[answered])
    added = open_echoes(rays.sweep, rays.open_ring[which], rays.open_column[which], answers)
    order = np.argsort(rays.beam[np.concatenate([kept, answered])], kind="stable")
    return stacked(seen, added)[np.concatenate([kept, count + np.arange(len(added))])[order]]


def _seen(
    rays: Rays,
    transmission: NDArray[np.float64],
    echo: Echo,
    scattered: NDArray[np.intp],
    shift_m: NDArray[np.float64] | None,
) -> Sweep:
    """Return the P points attenuated and shifted, the rows `scattered` replaced by the medium's echo."""
    sweep = rays.sweep
    reach = np.maximum(rays.reach[: len(sweep)], 1e-6)
    columns = {name: getattr(sweep, name).copy() for name in ("points", *NO_SURFACE)}
    if shift_m is not None:
        columns["points"] = (sweep.points * (1.0 + shift_m / reach)[:, None]).astype(np.float32)
    columns["intensity"] = (sweep.intensity * transmission).astype(np.float32)
    columns["fate"][(sweep.fate == KEPT) & (transmission < 1.0)] = ATTENUATED
    place, power = echo.range_m[scattered], echo.power[scattered]
    columns["points"][scattered] = sweep.points[scattered] * (place / reach[scattered])[:, None]
    columns["intensity"][scattered] = reported_intensity(sweep.spec, power, place)
    for name, value in NO_SURFACE.items():
        columns[name][scattered] = value
    return replace(sweep, **columns)


def open_echoes(sweep: Sweep, ring: NDArray[np.intp], column: NDArray[np.intp], echo: Echo) -> Sweep:
    """Return a sweep of the echoes of N beams, on no object, with the sensor and pose of another sweep.

    Args:
        sweep: gives the sensor, its motion and the time.
    """
    spec = sweep.spec
    known = sweep.path is not None and sweep.motion != "raw"
    fired = np.full(len(ring), _middle_s(sweep) - sweep.time_s)
    if spec is not None:  # `spec.time_offset` of these beams: the table of all is slow
        fired += (column - 0.5 * spec.columns + spec.firing_share[ring]) * spec.column_s
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
        **{name: np.full(len(ring), value) for name, value in NO_SURFACE.items()},
    )
    return replace(made, path=sweep.path, motion=sweep.motion)


def open_axis(rays: Rays) -> NDArray[np.float64]:
    """Return (Q, 3) unit directions of the open beams in the sensor's frame at their firing."""
    return _axis(rays.sweep, rays.open_ring, rays.open_column)


def _axis(sweep: Sweep, ring: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float64]:
    if sweep.spec is None:
        return np.zeros((0, 3))
    return beams_of(sweep.spec, _middle_s(sweep)).axis[:, ring, column].T.astype(np.float64)


def _middle_s(sweep: Sweep) -> float:
    """Return the reference time of firing times and rosettes, the middle of the sweep, s."""
    if sweep.motion in ("middle", "raw") or sweep.path is None:
        return sweep.time_s
    return deskew(sweep[:0], "middle").time_s


def _beams_known(
    sweep: Sweep, rng: np.random.Generator
) -> tuple[NDArray[np.intp], int, NDArray[np.intp], NDArray[np.intp]]:
    """Return (P,) each point's beam, the number of beams, and (Q,) ring and column of the open ones.

    Without known beams every point is a beam, and none is open.
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
    silent = np.flatnonzero((returns == 0) & ~spec.blocked.ravel())
    if spec.dropoff_rate > 0.0 and len(silent):
        answering = 1.0 - min(spec.dropoff_rate * beams / len(silent), 1.0)
        silent = silent[rng.random(beams)[silent] < answering]
    return beam, beams, *np.divmod(silent, spec.columns)


def _within(index: NDArray[np.integer], count: int) -> bool:
    return len(index) == 0 or (0 <= index.min() and index.max() < count)
