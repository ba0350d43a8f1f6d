"""Snow in flat discs, one per ring, as published (Hahner et al., CVPR 2022): what comes back from each beam.

Every flake before a target takes a share of the beam (`snow_beams`) and answers with power reflectivity * share / r^2;
the target answers with its own power times the share that is left, on the way there and back. Echoes less than half a
pulse apart add up. `snow` says why this overstates far flakes.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.medium import Echo, Sight, open_axis
from sensors.corruptions.receiver import overlap
from sensors.corruptions.rings import rings_of
from sensors.corruptions.snow_beams import Meetings, gather, grouped, meet, taken_shares
from sensors.corruptions.snow_flakes import DISC_RADIUS_M, flake_pool
from sensors.corruptions.strongest import SAME_RETURN_M, UNKNOWN_DIVERGENCE_RAD, Particles
from sensors.optics import LIGHT_SPEED
from sensors.spec import LidarSpec

UNKNOWN_PULSE_S = 1e-8
"""Length at half power of the pulse when the sensor is not known (Hahner 2022)."""


def listen(sight: Sight, snow: Particles, rng: np.random.Generator) -> tuple[NDArray[np.float64], Echo]:
    """Return (P,) the transmission to the points and back, and the loudest flakes.

    Raises:
        DataError: the sweep does not say which ring its points are of, and it cannot be found out.
    """
    spec = sight.sweep.spec
    if len(sight) == 0:
        return np.zeros(0), Echo(np.zeros(0), np.zeros(0))
    meetings = _meetings(sight, snow, rng)
    share = taken_shares(meetings, _fan(spec))
    left = np.clip(1.0 - np.bincount(meetings.beam, share, len(sight)), 0.0, 1.0)
    # Cross-section, half the extinction.
    left *= np.exp(-0.5 * snow.extinction * np.maximum(sight.reach - DISC_RADIUS_M, 0.0))
    seen = (meetings.range_m >= sight.near[meetings.beam]) * overlap(meetings.range_m)
    power = snow.reflectivity * share * seen / meetings.range_m**2
    pulse_m = LIGHT_SPEED * (UNKNOWN_PULSE_S if spec is None else spec.pulse_s)
    through = (left**2)[: len(sight.sweep)]
    echo = loudest(meetings, power, sight.power * left**2, sight.floor(through), sight.reach, pulse_m)
    return through, echo


def loudest(
    meetings: Meetings,
    power: NDArray[np.float64],
    target: NDArray[np.float64],
    floor: NDArray[np.float64],
    reach: NDArray[np.float64],
    pulse_m: float,
) -> Echo:
    """Return the loudest flake of each line of sight, if it is louder than what else there is.

    Args:
        meetings: M flakes in beams.
        power: (M,) of each flake alone.
        target: (L,) power of the targets.
        floor: (L,) power that the flake must exceed.
        reach: (L,) their ranges, m.
        pulse_m: the pulse's length at half power, m.
    """
    echo = Echo(np.zeros(len(reach)), np.zeros(len(reach)))
    # Only where all flakes together are louder can one of them be reported.
    together = np.bincount(meetings.beam, power, len(reach))
    row = np.flatnonzero((together > floor)[meetings.beam])
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
        echo.range_m[beam[flake]] = at[flake]
        echo.power[beam[flake]] = total[line, best][flake]
    return echo


def _summed(range_m: NDArray[np.float64], power: NDArray[np.float64], pulse_m: float) -> NDArray[np.float64]:
    """Return (G, W) the power where each echo peaks, with what the others of its line (G, W) add there."""
    apart = np.abs(range_m[:, :, None] - range_m[:, None, :])
    kernel = np.where(apart < 0.5 * pulse_m, np.cos(np.pi * apart / pulse_m) ** 2, 0.0)
    return np.where(power > 0.0, np.einsum("gij,gj->gi", kernel, power), 0.0)


def _meetings(sight: Sight, snow: Particles, rng: np.random.Generator) -> Meetings:
    """Give every ring its own sample of the medium and find the flakes before the targets."""
    pool = flake_pool(snow)
    rings = rings_of(sight.sweep, "snow")
    disc = rng.integers(len(pool.discs), size=rings.count)
    turn = rng.uniform(0.0, 2.0 * np.pi, rings.count)
    ray = np.concatenate([sight.sweep.points, open_axis(sight)])
    azimuth = np.arctan2(ray[:, 1], ray[:, 0])
    ring = np.concatenate([rings.ring, sight.open_ring])
    order = np.argsort(ring, kind="stable")
    bounds = np.searchsorted(ring[order], np.arange(rings.count + 1))
    found = []
    for number in np.flatnonzero(np.diff(bounds)):
        rows = order[bounds[number] : bounds[number + 1]]
        flakes = pool.flakes(disc[number], snow)
        met = meet(azimuth[rows], sight.reach[rows], flakes, _fan(sight.sweep.spec), turn[number])
        found.append(replace(met, beam=rows[met.beam]))
    return gather(found)


def _fan(spec: LidarSpec | None) -> float:
    """Return the full width of a beam in the plane of its ring, rad."""
    return UNKNOWN_DIVERGENCE_RAD if spec is None else spec.divergence_rad or UNKNOWN_DIVERGENCE_RAD
