"""From what rays met to what the sensor reports, for an engine that works on whole arrays.

The definition is that of `sensors.raycast.Engine`. Shapes: S sub-rays, n beams: those of some rings, ring by ring,
K returns at most per beam.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.noise import LOST_AFTER, LOST_BEFORE, RANGE, SECOND_RANGE
from sensors.optics import Optics, drop_chance
from sensors.raycast.base import Returns, Shot

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """What the rays of some beams met.

    Attributes:
        distance: (S, n) float32, m.
        cosine: (S, n) float32.
        material: (S, n) uint8.
        object_id: (S, n) int32.
        hit: (S, n) whether anything was met; the others have any value where nothing was.
    """

    distance: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]
    hit: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """The echoes that are reported, the nearer one first: (K, n) arrays; `power` is their whole power."""

    distance: Floats
    power: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]
    found: NDArray[np.bool_]


def measure(met: Met, shot: Shot, rings: slice, point_motion: tuple[Floats, Floats]) -> Returns:
    """Return the points of some rings.

    Args:
        met: what their rays met.
        shot: the sweep.
        rings: which.
        point_motion: (3, 3, 1 or r, C) rotation and (3, 1 or r, C) place of the sensor at each firing, in the frame of
            the points.
    """
    spec, beams = shot.spec, shot.beams
    echoes = _single(met, shot.optics) if len(met.hit) == 1 else _merged(met, shot.optics, spec.returns)
    count, n = echoes.found.shape
    numbers = [shot.noise.grid(row, beams.columns, rings).reshape(n) for row in (RANGE, SECOND_RANGE)[:count]]
    near, far = (np.repeat(limit, beams.columns) for limit in beams.reach[rings].T)

    intensity = _read(shot.optics.scale, echoes.distance / np.float32(shot.optics.reach_m))
    if shot.optics.of_material:
        intensity *= echoes.power
    np.minimum(intensity, 1.0, out=intensity)
    measured = echoes.distance + np.float32(spec.range_noise_m) * np.stack(numbers)
    kept = echoes.found & (echoes.distance >= near) & (measured >= near) & (measured <= far)
    if spec.dropoff_rate > 0.0:
        kept &= shot.noise.grid(LOST_BEFORE, beams.columns, rings).reshape(n) >= np.float32(spec.dropoff_rate)
    if spec.dropoff_zero_intensity > 0.0:
        kept &= shot.noise.grid(LOST_AFTER, beams.columns, rings).reshape(n) >= drop_chance(intensity, spec)

    beam, number = np.divmod(np.flatnonzero(kept.T), count)
    row, column = np.divmod(beam, beams.columns)
    chosen = number * n + beam
    reach = measured.take(chosen)
    rotation, place = point_motion
    at = row if rotation.shape[2] > 1 else np.zeros_like(row)
    axis = beams.axis[:, rings, : beams.columns].reshape(3, n)[:, beam]
    points = np.zeros((len(beam), 3), np.float32)
    for i in range(3):
        direction = sum(rotation[i, j][at, column] * axis[j] for j in range(3))
        points[:, i] = direction * reach + place[i][at, column]
    ring = (row + rings.start).astype(np.int16)
    fired = column.astype(np.float32) + beams.firing_share[ring] - np.float32(0.5 * beams.columns)
    return Returns(
        points=points,
        intensity=intensity.take(chosen),
        ring=ring,
        column=column.astype(np.int32),
        time_offset=fired * np.float32(spec.column_s),
        object_id=echoes.object_id.take(chosen),
        return_number=(number + 1).astype(np.uint8),
        material=echoes.material.take(chosen),
        cosine=echoes.cosine.take(chosen),
    )


def _single(met: Met, optics: Optics) -> Echoes:
    """Return the echoes of beams of one ray."""
    power = _power(met, optics)
    found = met.hit & (power >= _need(met, optics))
    return Echoes(met.distance, power, met.cosine, met.material, met.object_id, found)


def _merged(met: Met, optics: Optics, returns: str) -> Echoes:
    """Return the reported echoes of beams of several rays."""
    subrays, n = met.hit.shape
    # What missed comes last and so late that it is an echo of its own, without power.
    distance = np.where(met.hit, met.distance, np.float32(4.0 * optics.reach_m + 4.0 * optics.gate_m))
    share = met.hit * np.float32(1.0 / subrays)
    power = share * _power(met, optics)
    margin = power / _need(met, optics)
    order = np.argsort(distance, axis=0, kind="stable")
    distance, power, margin = (np.take_along_axis(v, order, axis=0) for v in (distance, power, margin))
    starts = np.ones((subrays, n), bool)
    starts[1:] = np.diff(distance, axis=0) > np.float32(optics.gate_m)
    ends = np.ones((subrays, n), bool)
    ends[:-1] = starts[1:]

    # Running sums over each echo; where it ends they are the echo's own.
    first, moment, largest = (np.zeros(n, np.float32) for _ in range(3))
    best = np.zeros((subrays, n), np.int64)
    mean = np.zeros((subrays, n), np.float32)
    for ray in range(subrays):
        new = starts[ray]
        if ray > 0:
            power[ray] += np.where(new, 0.0, power[ray - 1])
        first = np.where(new, distance[ray], first)
        moment = np.where(new, 0.0, moment) + margin[ray] * (distance[ray] - first)
        better = new | (margin[ray] > largest)
        largest = np.where(better, margin[ray], largest)
        best[ray] = np.where(better, order[ray], best[ray - 1])
        if ray > 0:
            margin[ray] += np.where(new, 0.0, margin[ray - 1])
        mean[ray] = first + moment / np.maximum(margin[ray], np.float32(1e-30))

    margin = np.where(ends & (margin >= 1.0), margin, 0.0)
    chosen, found = _choose(margin, returns)
    best = np.take_along_axis(best, chosen, axis=0)
    return Echoes(
        distance=np.take_along_axis(mean, chosen, axis=0),
        power=np.take_along_axis(power, chosen, axis=0),
        cosine=np.take_along_axis(met.cosine, best, axis=0),
        material=np.take_along_axis(met.material, best, axis=0),
        object_id=np.take_along_axis(met.object_id, best, axis=0),
        found=found,
    )


def _choose(margin: Floats, returns: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return (K, n) which of the echoes, by distance, are reported, and whether there are so many.

    Args:
        margin: (S, n) 0 where there is no echo that is detected.
        returns: see `LidarSpec`.
    """
    strongest = margin.argmax(axis=0)[None]
    last = len(margin) - 1 - (margin > 0.0)[::-1].argmax(axis=0)[None]
    if returns != "dual":
        chosen = strongest if returns == "strongest" else last
        return chosen, np.take_along_axis(margin, chosen, axis=0) > 0.0
    others = margin.copy()
    np.put_along_axis(others, strongest, 0.0, axis=0)
    other = np.where(last == strongest, others.argmax(axis=0), last)
    both = np.take_along_axis(others, other, axis=0) > 0.0
    first = np.where(both, np.minimum(strongest, other), strongest)
    chosen = np.concatenate([first, np.maximum(strongest, other)])
    return chosen, np.concatenate([np.take_along_axis(margin, first, axis=0) > 0.0, both])


def _power(met: Met, optics: Optics) -> Floats:
    bins = optics.power.shape[1] - 1
    at = met.cosine * np.float32(bins)
    low = np.minimum(at.astype(np.int32), bins - 1)
    share = at - low.astype(np.float32)
    low += met.material * np.int32(bins + 1)
    table = optics.power.reshape(-1)
    value = table.take(low)
    return value + share * (table.take(low + 1) - value)


def _need(met: Met, optics: Optics) -> Floats:
    return _read(optics.need, met.distance / np.float32(optics.reach_m))


def _read(table: Floats, place: Floats) -> Floats:
    """Return values of a table at places in [0, 1], linearly interpolated."""
    at = np.minimum(place, np.float32(1.0)) * np.float32(len(table) - 1)
    low = np.minimum(at.astype(np.int32), len(table) - 2)
    value = table.take(low)
    return value + (at - low.astype(np.float32)) * (table.take(low + 1) - value)
