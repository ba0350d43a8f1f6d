"""Falling snow: flakes take a part of a beam, and a near one can answer louder than the target (Hahner, CVPR 2022).

| severity                         | 1    | 2    | 3    | 4    | 5    |
|----------------------------------|------|------|------|------|------|
| snowfall, mm/h of water          | 0.1  | 0.25 | 0.5  | 1.5  | 5    |
| flakes block, 1/km (extinction)  | 0.25 | 0.39 | 0.57 | 0.97 | 1.81 |

All fall at 2 m/s. Level 3 is the setting of DSRC's code (the published model's light snow); the paper gives no number.

Every flake before a target takes a share of the beam (`snow_beams`) and answers with power reflectivity * share / r^2;
the target answers with intensity * the share that is left / r^2. Echoes less than a pulse apart add up. The sensor
reports the strongest, if it detects it. What differs from the published code: the target keeps its own power (there, a
target behind any flake gets the flake's), the optics are the sweep's sensor instead of an HDL-64E's, the noise floor
is the sensor's detection limit, heavier snow takes more (see `snow_flakes`), and beams across azimuth 0 are whole.
"""

from dataclasses import dataclass, replace
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.levels import at_level, check_range
from sensors.corruptions.receiver import LIGHT_SPEED, least_power, overlap, ring_count
from sensors.corruptions.snow_beams import Meetings, gather, grouped, meet, taken_shares
from sensors.corruptions.snow_flakes import DISC_RADIUS_M, POOL, extinction, flake_pool
from sensors.sweep import ADDED, ATTENUATED, SCATTERED, Sweep

SNOWFALL_MM_H = (0.1, 0.25, 0.5, 1.5, 5.0)

DIVERGENCE_RAD, PULSE_S = 0.003, 1e-8
"""Optics when the sensor is not known (Hahner 2022)."""

SAME_RETURN_M = 0.2
"""An echo nearer than this to the target is the target's."""


class Snow(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        snowfall_mm_h: mm/h of water.
        fall_speed_mps: terminal velocity of the flakes, m/s.
        flake_density: relative to water.
        flake_reflectivity: of a flake that fills the beam.
        range_10_m: see `LidarSpec`; None for the sensor's own, infinity for a receiver that detects everything.
    """

    snowfall_mm_h: float = 0.5
    fall_speed_mps: float = 2.0
    flake_density: float = 0.1
    flake_reflectivity: float = 0.9
    range_10_m: float | None = None

    def __post_init__(self) -> None:
        check_range("Snow", "snowfall_mm_h", self.snowfall_mm_h, 0.0, 50.0)
        check_range("Snow", "fall_speed_mps", self.fall_speed_mps, 0.1, 10.0)
        check_range("Snow", "flake_density", self.flake_density, 0.01, 1.0)
        check_range("Snow", "flake_reflectivity", self.flake_reflectivity, 0.0, 1.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(snowfall_mm_h=at_level(SNOWFALL_MM_H, level))


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """What comes back on each of P rays.

    Attributes:
        left: (P,) share of the beam that reaches the target, [0, 1].
        flake_m: (P,) range of the strongest flake, 0 where there is none or the target is stronger.
        flake_power: (P,) its power, see `receiver`.
    """

    left: NDArray[np.float64]
    flake_m: NDArray[np.float64]
    flake_power: NDArray[np.float64]


def corrupt(sweep: Sweep, severity: int | Snow, rng: np.random.Generator) -> Sweep:
    """Dim, replace or lose the returns; flakes' returns lie on the same rays, nearer, on no object."""
    snow = severity if isinstance(severity, Snow) else Snow.severity(severity)
    if snow.snowfall_mm_h == 0.0 or len(sweep) == 0:
        return sweep
    reach = np.linalg.norm(sweep.points.astype(np.float64), axis=1)
    echoes = listen(sweep, reach, _meetings(sweep, reach, snow, rng), snow)
    scattered = echoes.flake_m > 0.0
    dimmed = sweep.intensity * echoes.left
    power = np.where(scattered, echoes.flake_power, dimmed / np.maximum(reach, 1e-6) ** 2)
    untouched = echoes.left == 1.0

    points = sweep.points.copy()
    points[scattered] = (sweep.points[scattered] * (echoes.flake_m / reach)[scattered, None]).astype(np.float32)
    intensity = np.where(scattered, np.minimum(power * echoes.flake_m**2, 1.0), dimmed)
    fate = np.where(scattered, SCATTERED, np.where(untouched, sweep.fate, ATTENUATED))
    snowed = replace(
        sweep,
        points=points,
        intensity=intensity.astype(np.float32),
        object_id=np.where(scattered, ADDED, sweep.object_id).astype(np.int32),
        fate=fate.astype(np.uint8),
    )
    return snowed[untouched | (power >= least_power(sweep.spec, snow.range_10_m))]


def listen(sweep: Sweep, reach: NDArray[np.float64], meetings: Meetings, snow: Snow) -> Echoes:
    """Work out what comes back when these flakes stand before the targets at these ranges (P,)."""
    share = taken_shares(meetings, _divergence(sweep))
    taken = np.bincount(meetings.beam, share, len(sweep))
    haze = extinction(snow.snowfall_mm_h, snow.fall_speed_mps, snow.flake_density)
    left = np.clip(1.0 - taken, 0.0, 1.0) * np.exp(-haze * np.maximum(reach - DISC_RADIUS_M, 0.0))
    power = snow.flake_reflectivity * share * overlap(meetings.range_m) / meetings.range_m**2
    target = sweep.intensity * left / np.maximum(reach, 1e-6) ** 2

    # Only where all flakes together are louder than the target can one of them be reported.
    loud = (np.bincount(meetings.beam, power, len(sweep)) > target)[meetings.beam]
    row = np.flatnonzero(loud)
    flake_m, flake_power = np.zeros(len(sweep)), np.zeros(len(sweep))
    pulse_m = LIGHT_SPEED * (PULSE_S if sweep.spec is None else sweep.spec.pulse_s)
    for rows, valid in grouped(meetings.beam[row]):
        rows = row[rows]
        beam = meetings.beam[rows[:, 0]]
        range_m = np.c_[meetings.range_m[rows], reach[beam]]
        single = np.c_[np.where(valid, power[rows], 0.0), target[beam]]
        total = _summed(range_m, single, pulse_m)
        best = total.argmax(axis=1)
        line = np.arange(len(beam))
        at = range_m[line, best]
        flake = reach[beam] - at > SAME_RETURN_M
        flake_m[beam[flake]] = at[flake]
        flake_power[beam[flake]] = total[line, best][flake]
    return Echoes(left=left, flake_m=flake_m, flake_power=flake_power)


def _summed(range_m: NDArray[np.float64], power: NDArray[np.float64], pulse_m: float) -> NDArray[np.float64]:
    """Return (G, W) the power where each echo peaks, with what the others of its line (G, W) add there."""
    apart = np.abs(range_m[:, :, None] - range_m[:, None, :])
    kernel = np.where(apart < 0.5 * pulse_m, np.cos(np.pi * apart / pulse_m) ** 2, 0.0)
    return np.where(power > 0.0, np.einsum("gij,gj->gi", kernel, power), 0.0)


def _meetings(sweep: Sweep, reach: NDArray[np.float64], snow: Snow, rng: np.random.Generator) -> Meetings:
    """Give every ring its own sample of the medium and find the flakes before the targets."""
    pool = flake_pool(snow.snowfall_mm_h, snow.fall_speed_mps, snow.flake_density)
    rings = ring_count(sweep)
    sample = rng.integers(POOL, size=rings)
    turn = rng.uniform(0.0, 2.0 * np.pi, rings)
    azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]).astype(np.float64)
    order = np.argsort(sweep.ring, kind="stable")
    bounds = np.searchsorted(sweep.ring[order], np.arange(rings + 1))
    found = []
    for ring in np.flatnonzero(np.diff(bounds)):
        rows = order[bounds[ring] : bounds[ring + 1]]
        met = meet(azimuth[rows], reach[rows], pool[sample[ring]], _divergence(sweep), turn[ring])
        found.append(replace(met, beam=rows[met.beam]))
    return gather(found)


def _divergence(sweep: Sweep) -> float:
    return DIVERGENCE_RAD if sweep.spec is None else sweep.spec.divergence_rad
