"""Shares of a beam on flakes, by Hahner et al. (CVPR 2022).

A beam is a fan of 3 mrad in the plane of its ring around its azimuth. A disc takes what lies between its tangents, as
far as no nearer disc does, if its range in the plane is less than that of the target in space; the target gets the
rest.

Quirk: in a beam across azimuth 0 a disc that lies wholly on the negative side is taken for
one a full turn away. It keeps its share, shades no disc on the other side, and the target then counts as wholly seen,
so that shares sum to more than 1.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.geometry import Array

_TURN = 2.0 * np.pi
_CELLS = 4_000_000


class Shares(NamedTuple):
    """M discs in B beams, by beam and then by range.

    Attributes:
        beam: (M,) row of the beam.
        range_m: (M,) range of the disc, m.
        share: (M,) share of the beam, 0 for hidden discs.
        target: (B,) remaining share of the target.
    """

    beam: NDArray[np.int64]
    range_m: Array
    share: Array
    target: Array


def shares_of(azimuth: Array, target_m: Array, discs: Array, divergence: float) -> Shares:
    """Return the shares of discs in the beams of one ring.

    Args:
        azimuth: (B,) of the beams, rad.
        target_m: (B,) range of their targets.
        discs: (F, 3) x, y, radius, m.
        divergence: full width of a beam, rad.
    """
    beam, range_m, low, high = _meetings(azimuth, target_m, np.asarray(discs, np.float64), divergence)
    axis = np.mod(azimuth + np.pi, _TURN) - np.pi
    astray = (np.abs(axis)[beam] < 0.5 * divergence) & (axis[beam] + high <= 0.0)
    away = np.where(astray, _TURN, 0.0)
    share = _owned_shares(beam, low + away, high + away) / divergence
    target = 1.0 - np.bincount(beam, share, len(azimuth))
    target[beam[astray]] = 1.0
    return Shares(beam, range_m, share, np.clip(target, 0.0, 1.0))


def _meetings(
    azimuth: Array, target_m: Array, discs: Array, divergence: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return beam, range and clipped edges from the beam's axis of every disc before a target, by beam and range."""
    range_m = np.hypot(discs[:, 0], discs[:, 1])
    discs, range_m = (a[range_m < target_m.max(initial=0.0)] for a in (discs, range_m))
    half = 0.5 * divergence
    width = np.arcsin(np.minimum(discs[:, 2] / np.maximum(range_m, 1e-12), 1.0))
    center = np.mod(np.arctan2(discs[:, 1], discs[:, 0]), _TURN)
    turned = np.mod(azimuth, _TURN)
    order = np.argsort(turned, kind="stable")
    direction = np.concatenate([turned[order] - _TURN, turned[order], turned[order] + _TURN])
    first = np.searchsorted(direction, center - width - half, side="right")
    number = np.maximum(np.searchsorted(direction, center + width + half, side="left") - first, 0)
    disc = np.repeat(np.arange(len(discs)), number)
    place = np.repeat(first - np.cumsum(number) + number, number) + np.arange(len(disc))
    beam = order[place % len(order)] if len(order) else place
    before = range_m[disc] < target_m[beam]
    disc, place, beam = disc[before], place[before], beam[before]
    offset = center[disc] - direction[place]
    sorting = np.lexsort((range_m[disc], beam))
    low, high = (np.clip(offset + side * width[disc], -half, half)[sorting] for side in (-1.0, 1.0))
    return beam[sorting], range_m[disc][sorting], low, high


def _owned_shares(beam: NDArray[np.int64], low: Array, high: Array) -> Array:
    """Return (M,) length of each interval that no earlier one of its beam covers."""
    share = np.zeros(len(beam))
    start = np.flatnonzero(np.diff(beam, prepend=-1))
    number = np.diff(np.append(start, len(beam)))
    width = 1
    while (number > width // 2).any():
        # Beams with about as many discs are done together, as rows of a rectangle.
        alike = np.flatnonzero((number > width // 2) & (number <= width))
        lines = max(1, _CELLS // (2 * width * width))
        for part in np.split(alike, range(lines, len(alike), lines)):
            real = np.arange(width) < number[part, None]
            rows = np.where(real, start[part, None] + np.arange(width), 0)
            owned = _owned(np.where(real, low[rows], 0.0), np.where(real, high[rows], 0.0))
            share[rows[real]] = owned[real]
        width *= 2
    return share


def _owned(low: Array, high: Array) -> Array:
    """Return (G, W) length of each interval of a row that no earlier one covers."""
    edges = np.sort(np.concatenate([low, high], axis=1), axis=1)
    length = np.diff(edges, axis=1)
    middle = edges[:, :-1] + 0.5 * length
    covers = (low[:, None] <= middle[..., None]) & (middle[..., None] < high[:, None])
    owner = np.arange(len(low))[:, None] * low.shape[1] + covers.argmax(axis=2)
    length[~covers.any(axis=2)] = 0.0
    owned = np.bincount(owner.ravel(), length.ravel(), low.size)
    return np.asarray(owned, np.float64).reshape(low.shape)
