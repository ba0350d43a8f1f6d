"""Measurement of beams: from the hits of rays to the points that a sensor reports, on whole arrays.

The definition is that of `sensors.raycast.Engine`. Shapes: S sub-rays; R rings, C columns and n = R C beams, ring by
ring; K returns at most per beam, 1 or 2.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sensors.optics.noise import LOST_AFTER, RANGE, SECOND_RANGE
from sensors.optics.reflectance import Optics, drop_chance
from sensors.raycast.base import Returns, SweepRequest
from sensors.sweep import STATIC

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """Nearest hits of the rays of a sweep.

    Attributes:
        hit: (S, n) bool; the other columns are undefined where nothing was hit.
        distance: (S, n) float32, m; the reach where nothing was hit.
        cosine: (S, n) float32.
        material: (S, n) uint8.
        object_id: (S, n) int32.
    """

    hit: NDArray[np.bool_]
    distance: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]

    @classmethod
    def none(cls, subrays: int, reach: Floats) -> Self:
        """Return rays of (n,) reach that have hit nothing."""
        shape = subrays, len(reach)
        return cls(
            hit=np.zeros(shape, bool),
            distance=np.tile(reach, (subrays, 1)),
            cosine=np.zeros(shape, np.float32),
            material=np.zeros(shape, np.uint8),
            object_id=np.full(shape, STATIC, np.int32),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Echoes:
    """Reported echoes, the nearer one first: (K, n) arrays; `power` is their whole power."""

    found: NDArray[np.bool_]
    distance: Floats
    place: "_Place"
    power: Floats
    cosine: Floats
    material: NDArray[np.uint8]
    object_id: NDArray[np.int32]


def measure(hits: RayHits, axis: NDArray[np.float64], place: NDArray[np.float64], request: SweepRequest) -> Returns:
    """Return the points of a sweep.

    Args:
        hits: of the rays; none of beams that are lost before.
        axis: (3, n) directions of the beams along the axes of the world.
        place: (3, n) of the sensor at each firing along them, from where it is at the reference time, m.
    """
    spec, columns = request.spec, request.beams.columns
    echoes = _single(hits, request.optics) if len(hits.hit) == 1 else _merged(hits, request.optics, spec.returns)
    intensity = echoes.place.read(request.optics.scale)
    if request.optics.of_material:
        intensity = intensity * echoes.power
    intensity = np.minimum(intensity, np.float32(1.0))
    noise = np.stack([request.noise.grid(row, columns).ravel() for row in (RANGE, SECOND_RANGE)[: len(echoes.found)]])
    measured = echoes.distance + np.float32(spec.range_noise_m) * noise
    near, far = np.repeat(request.beams.reach, columns, axis=0).T
    kept = echoes.found & (echoes.distance >= near) & (measured >= near) & (measured <= far)
    if spec.dropoff_zero_intensity > 0.0:
        kept &= request.noise.grid(LOST_AFTER, columns).ravel() >= drop_chance(intensity, spec)

    beam, number = np.nonzero(kept.T)
    world = axis[:, beam] * measured[number, beam] + place[:, beam]
    ring, column = np.divmod(beam, columns)
    return Returns(
        points=(world.T @ request.pose[:3, :3]).astype(np.float32),
        intensity=intensity[number, beam],
        ring=ring.astype(np.int16),
        column=column.astype(np.int32),
        time_offset=spec.time_offset[ring, column].astype(np.float32),
        object_id=echoes.object_id[number, beam],
        return_number=(number + 1).astype(np.uint8),
        material=echoes.material[number, beam],
        cosine=echoes.cosine[number, beam],
    )


def _single(hits: RayHits, optics: Optics) -> _Echoes:
    power = _power(hits, optics)
    place = _Place.on(optics.need, hits.distance, optics.reach_m)
    found = power >= place.read(optics.need)
    found &= hits.hit
    return _Echoes(found, hits.distance, place, power, hits.cosine, hits.material, hits.object_id)


def _merged(hits: RayHits, optics: Optics, returns: str) -> _Echoes:
    """Return the reported echoes of beams of several rays."""
    subrays, n = hits.hit.shape
    power = hits.hit * np.float32(1.0 / subrays) * _power(hits, optics)
    # Misses sort last and so far that they are echoes of their own, without power.
    distance = np.where(power > 0.0, hits.distance, np.float32(4.0 * optics.reach_m + 4.0 * optics.gate_m))
    margin = power / _Place.on(optics.need, hits.distance, optics.reach_m).read(optics.need)
    order = np.argsort(distance, axis=0, kind="stable")
    distance, power, margin = (np.take_along_axis(v, order, axis=0) for v in (distance, power, margin))
    starts = np.ones((subrays, n), bool)
    starts[1:] = np.diff(distance, axis=0) > np.float32(optics.gate_m)
    ends = np.ones((subrays, n), bool)
    ends[:-1] = starts[1:]

    # Running sums over each echo, complete at its end.
    best, largest = order.copy(), margin.copy()
    first, moment = distance.copy(), np.zeros_like(distance)
    for ray in range(1, subrays):
        joined = ~starts[ray]
        np.copyto(first[ray], first[ray - 1], where=joined)
        moment[ray] = joined * moment[ray - 1] + margin[ray] * (distance[ray] - first[ray])
        less = joined & (largest[ray] <= largest[ray - 1])
        np.copyto(best[ray], best[ray - 1], where=less)
        np.copyto(largest[ray], largest[ray - 1], where=less)
        power[ray] += joined * power[ray - 1]
        margin[ray] += joined * margin[ray - 1]
    mean = first + moment / np.maximum(margin, np.float32(1e-30))

    chosen, found = _choose(np.where(ends & (margin >= 1.0), margin, 0.0), returns)
    best = np.take_along_axis(best, chosen, axis=0)
    distance = np.take_along_axis(mean, chosen, axis=0)
    return _Echoes(
        found=found,
        distance=distance,
        place=_Place.on(optics.scale, distance, optics.reach_m),
        power=np.take_along_axis(power, chosen, axis=0),
        cosine=np.take_along_axis(hits.cosine, best, axis=0),
        material=np.take_along_axis(hits.material, best, axis=0),
        object_id=np.take_along_axis(hits.object_id, best, axis=0),
    )


def _choose(margin: Floats, returns: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return (K, n) rows of the reported echoes, the nearer one first, and whether each exists.

    Args:
        margin: (S, n) by distance, 0 where there is no echo that is detected.
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
    """Places in a table: the entry below and the fraction to the next."""

    low: NDArray[np.intp]
    share: Floats

    @classmethod
    def on(cls, table: Floats, values: Floats, end: float) -> "_Place":
        """Find values in a table over [0, end]."""
        # A hair short of the end, so that each place has an entry after it.
        at = np.minimum(values, np.float32(end)) * np.float32((len(table) - 1) / end * (1.0 - 2.0**-22))
        low = np.floor(at)
        return cls(low.astype(np.intp), at - low)

    def read(self, table: Floats) -> Floats:
        """Return the interpolated values."""
        value = table[self.low]
        return value + self.share * (table[1:][self.low] - value)


def _power(hits: RayHits, optics: Optics) -> Floats:
    """Return (S, n) returned power over a whole beam."""
    place = _Place.on(optics.power[0], hits.cosine, 1.0)
    row = hits.material.astype(np.intp) * optics.power.shape[1] + place.low
    return _Place(row, place.share).read(optics.power.reshape(-1))
