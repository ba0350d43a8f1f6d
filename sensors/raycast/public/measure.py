"""From what rays met to what the sensor reports, for an engine that works on whole arrays.

The definition is that of `sensors.raycast.Engine`. Shapes: S sub-rays; r rings, C columns and n = r C beams, ring by
ring; K returns at most per beam, 1 or 2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.optics.noise import LOST_AFTER, RANGE, SECOND_RANGE
from sensors.optics.reflectance import Optics, drop_chance
from sensors.raycast.base import Returns, Shot

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """What the rays of some beams met.

    Attributes:
        hit: (S, n) whether anything was met; the others have any value where nothing was.
        distance: (S, n) float32, m.
        cosine: (S, n) float32.
        material: (S, n) uint8.
        object_id: (S, n) int32.
    """

    hit: NDArray[np.bool_]
    distance: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """Where the beams point and start, along the axes of the world.

    Attributes:
        direction: (3, n) float32 of the beams' axes.
        place: (3, 1 or r, C) float32 of the sensor at each firing, from where it is at the reference time, m.
    """

    direction: Floats
    place: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Echoes:
    """The echoes that are reported, the nearer one first: (K, n) arrays; `power` is their whole power."""

    found: NDArray[np.bool_]
    distance: Floats
    place: "_Place"
    power: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]


def measure(met: Met, aim: Aim, shot: Shot, rings: slice) -> Returns:
    """Return the points of some rings; beams that are lost before must have met nothing."""
    echoes = _single(met, shot.optics) if len(met.hit) == 1 else _merged(met, shot.optics, shot.spec.returns)
    intensity = echoes.place.read(shot.optics.scale)
    if shot.optics.of_material:
        intensity *= echoes.power
    np.minimum(intensity, np.float32(1.0), out=intensity)
    rows = (RANGE, SECOND_RANGE)[: len(echoes.found)]
    range_m = np.concatenate([shot.noise.grid(row, shot.beams.columns, rings).reshape(1, -1) for row in rows])
    range_m *= np.float32(shot.spec.range_noise_m)
    range_m += echoes.distance
    kept = _in_reach(echoes.distance, range_m, shot, rings)
    kept &= echoes.found
    if shot.spec.dropoff_zero_intensity > 0.0:
        kept &= shot.noise.grid(LOST_AFTER, shot.beams.columns, rings).reshape(-1) >= drop_chance(intensity, shot.spec)
    return _pack(echoes, range_m, intensity, kept, aim, shot, rings)


def _in_reach(distance: Floats, measured: Floats, shot: Shot, rings: slice) -> NDArray[np.bool_]:
    """Return (K, n) whether ranges are within those of their beams."""
    reach = shot.beams.reach[rings]
    if (reach != reach[0]).any():
        reach = np.repeat(reach, shot.beams.columns, axis=0)
        near, far = reach[:, 0], reach[:, 1]
    else:
        near, far = reach[0]
    within = distance >= near
    within &= measured >= near
    within &= measured <= far
    return within


def _pack(
    echoes: _Echoes,
    range_m: Floats,
    intensity: Floats,
    kept: NDArray[np.bool_],
    aim: Aim,
    shot: Shot,
    rings: slice,
) -> Returns:
    """Return the points that are kept, from (K, n) arrays."""
    most, columns = len(kept), shot.beams.columns
    if most == 1:
        beam = chosen = np.flatnonzero(kept)
        number = np.ones(len(beam), np.uint8)
    else:
        beam, second = np.divmod(np.flatnonzero(kept.T), most)
        chosen, number = second * kept.shape[1] + beam, (second + 1).astype(np.uint8)
    border = np.arange(rings.stop - rings.start + 1) * columns
    per_ring = np.diff(np.searchsorted(beam, border))
    column = beam - np.repeat(border[:-1], per_ring)
    column_s = np.float32(shot.spec.column_s)
    fired = (np.arange(columns, dtype=np.float32) - np.float32(0.5 * columns)) * column_s
    # Indices are right: "clip" only spares the check.
    time_offset = fired.take(column, mode="clip")
    time_offset += np.repeat(shot.beams.firing_share[rings] * column_s, per_ring)
    world = aim.direction[:, None] * range_m
    on_grid = world.reshape(3, most, -1, columns)
    on_grid += aim.place[:, None]
    world = world.reshape(3, -1).take(chosen, axis=1, mode="clip")
    return Returns(
        points=world.T @ shot.pose[:3, :3].astype(np.float32),
        intensity=intensity.take(chosen, mode="clip"),
        ring=np.repeat(np.arange(rings.start, rings.stop, dtype=np.int16), per_ring),
        column=column.astype(np.int32),
        time_offset=time_offset,
        object_id=echoes.object_id.take(chosen, mode="clip"),
        return_number=number,
        material=echoes.material.take(chosen, mode="clip"),
        cosine=echoes.cosine.take(chosen, mode="clip"),
    )


def _single(met: Met, optics: Optics) -> _Echoes:
    """Return the echoes of beams of one ray."""
    power = _power(met, optics)
    place = _Place.on(optics.need, met.distance, optics.reach_m)
    found = power >= place.read(optics.need)
    found &= met.hit
    return _Echoes(found, met.distance, place, power, met.cosine, met.material, met.object_id)


def _merged(met: Met, optics: Optics, returns: str) -> _Echoes:
    """Return the reported echoes of beams of several rays."""
    subrays, n = met.hit.shape
    power = met.hit * np.float32(1.0 / subrays) * _power(met, optics)
    # What missed comes last and so late that it is an echo of its own, without power.
    distance = np.where(power > 0.0, met.distance, np.float32(4.0 * optics.reach_m + 4.0 * optics.gate_m))
    margin = power / _Place.on(optics.need, met.distance, optics.reach_m).read(optics.need)
    order = np.argsort(distance, axis=0, kind="stable")
    distance, power, margin = (np.take_along_axis(v, order, axis=0) for v in (distance, power, margin))
    starts = np.ones((subrays, n), bool)
    starts[1:] = np.diff(distance, axis=0) > np.float32(optics.gate_m)
    ends = np.ones((subrays, n), bool)
    ends[:-1] = starts[1:]

    # Running sums over each echo; where it ends they are the echo's own.
    best, largest = order.copy(), margin.copy()
    first, moment = distance.copy(), np.zeros_like(distance)
    for ray in range(1, subrays):
        goes_on = ~starts[ray]
        np.copyto(first[ray], first[ray - 1], where=goes_on)
        moment[ray] = goes_on * moment[ray - 1] + margin[ray] * (distance[ray] - first[ray])
        less = goes_on & (largest[ray] <= largest[ray - 1])
        np.copyto(best[ray], best[ray - 1], where=less)
        np.copyto(largest[ray], largest[ray - 1], where=less)
        power[ray] += goes_on * power[ray - 1]
        margin[ray] += goes_on * margin[ray - 1]
    mean = first + moment / np.maximum(margin, np.float32(1e-30))

    chosen, found = _choose(np.where(ends & (margin >= 1.0), margin, 0.0), returns)
    best = np.take_along_axis(best, chosen, axis=0)
    distance = np.take_along_axis(mean, chosen, axis=0)
    return _Echoes(
        found=found,
        distance=distance,
        place=_Place.on(optics.scale, distance, optics.reach_m),
        power=np.take_along_axis(power, chosen, axis=0),
        cosine=np.take_along_axis(met.cosine, best, axis=0),
        material=np.take_along_axis(met.material, best, axis=0),
        object_id=np.take_along_axis(met.object_id, best, axis=0),
    )


def _choose(margin: Floats, returns: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return (K, n) which of the echoes are reported, the nearer one first, and whether there are so many.

    Args:
        margin: (S, n) by distance, 0 where there is no echo that is detected.
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


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Places in a table: the entry below and the share of the way to the next."""

    low: NDArray[np.intp]
    share: Floats

    @classmethod
    def on(cls, table: Floats, values: Floats, end: float) -> "_Place":
        """Find values in a table over [0, end]."""
        # A hair short of the end, so that each place has an entry after it.
        at = values * np.float32((len(table) - 1) / end * (1.0 - 2.0**-22))
        whole = np.floor(at)
        at -= whole
        return cls(whole.astype(np.intp), at)

    def read(self, table: Floats) -> Floats:
        """Return the interpolated values."""
        # Indices are right; "clip" only spares the check.
        value = table.take(self.low, mode="clip")
        step = table[1:].take(self.low, mode="clip")
        step -= value
        step *= self.share
        step += value
        return step


def _power(met: Met, optics: Optics) -> Floats:
    """Return (S, n) returned power over a whole beam."""
    place = _Place.on(optics.power[0], met.cosine, 1.0)
    row = met.material.astype(np.intp)
    row *= optics.power.shape[1]
    row += place.low
    return _Place(row, place.share).read(optics.power.reshape(-1))
