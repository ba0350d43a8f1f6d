"""Which flakes stand in which beams, and how much of a beam each of them takes.

A beam is a fan of full width `divergence` in the plane of its ring. Of every direction in it the nearest flake takes
all; the target gets what is left.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.snow_flakes import Flakes

_CHUNK = 4_000_000
"""Cells of the largest temporary array."""


@dataclass(frozen=True, slots=True, eq=False)
class Meetings:
    """M meetings of a flake with a beam, sorted by beam, then by range.

    Attributes:
        beam: (M,) row of the beam.
        range_m: (M,) range of the flake, less than that of the beam's target.
        low, high: (M,) the flake's edges as angles from the beam's axis, clipped to the beam, rad.
    """

    beam: NDArray[np.int64]
    range_m: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.beam)


def meet(
    azimuth: NDArray[np.float64], target_m: NDArray[np.float64], flakes: Flakes, divergence: float, turn: float = 0.0
) -> Meetings:
    """Find the flakes before the targets of the beams of one ring.

    Args:
        azimuth: (B,) directions of the beams, rad.
        target_m: (B,) ranges of their targets.
        flakes: the medium.
        divergence: full width of a beam, rad.
        turn: angle by which the medium is turned, rad.
    """
    near = int(np.searchsorted(flakes.range_m, target_m.max(initial=0.0)))
    half = 0.5 * divergence
    reach = half + flakes.half_width[:near]
    center = np.mod(flakes.azimuth[:near] + turn, 2.0 * np.pi)
    row, direction = _unrolled(azimuth, float(reach.max(initial=0.0)))
    first = np.searchsorted(direction, center - reach, side="right")
    count = np.searchsorted(direction, center + reach, side="left") - first
    hits = np.flatnonzero(count > 0)
    flake = np.repeat(hits, count[hits])
    place = np.repeat(first[hits], count[hits]) + _count_up(count[hits])
    before = flakes.range_m[flake] < target_m[row[place]]
    flake, place = flake[before], place[before]
    offset = center[flake] - direction[place]
    return Meetings(
        beam=row[place],
        range_m=flakes.range_m[flake],
        low=np.clip(offset - flakes.half_width[flake], -half, half),
        high=np.clip(offset + flakes.half_width[flake], -half, half),
    )


def gather(meetings: list[Meetings]) -> Meetings:
    """Join the meetings of several rings, whose beams have different rows, and sort them."""
    beam = np.concatenate([m.beam for m in meetings] or [np.zeros(0, np.int64)])
    fields = {
        name: np.concatenate([getattr(m, name) for m in meetings] or [np.zeros(0)])
        for name in ("range_m", "low", "high")
    }
    order = np.lexsort((fields["range_m"], beam))
    return Meetings(beam=beam[order], **{name: values[order] for name, values in fields.items()})


def taken_shares(meetings: Meetings, divergence: float) -> NDArray[np.float64]:
    """Return (M,) the share of its beam that each flake takes, in [0, 1]; per beam they sum to at most 1."""
    shares = np.zeros(len(meetings))
    for rows, valid in grouped(meetings.beam):
        low = np.where(valid, meetings.low[rows], 0.0)
        high = np.where(valid, meetings.high[rows], 0.0)
        shares[rows[valid]] = (_owned(low, high) / divergence)[valid]
    return np.clip(shares, 0.0, 1.0)


def grouped(beam: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Yield the meetings as rectangles, beams with about as many meetings together.

    Yields:
        (G, W) rows of meetings, one line per beam and nearest first, and (G, W) which of them are real.
    """
    start = np.flatnonzero(np.r_[True, beam[1:] != beam[:-1]]) if len(beam) else np.zeros(0, np.int64)
    count = np.diff(np.r_[start, len(beam)])
    width = 1
    while (count > width // 2).any():
        chosen = np.flatnonzero((count > width // 2) & (count <= width))
        lines = max(1, _CHUNK // (2 * width * width))
        for part in np.split(chosen, range(lines, len(chosen), lines)):
            slots = np.arange(width)
            valid = slots < count[part, None]
            yield np.where(valid, start[part, None] + slots, 0), valid
        width *= 2


def _owned(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (G, W) what each interval owns, where of a line's intervals the first that covers a place owns it."""
    lines, width = low.shape
    if width == 1:
        return high - low
    edges = np.sort(np.concatenate([low, high], axis=1), axis=1)
    length = np.diff(edges, axis=1)
    middle = edges[:, :-1] + 0.5 * length
    covers = (low[:, None, :] <= middle[:, :, None]) & (middle[:, :, None] < high[:, None, :])
    owner = covers.argmax(axis=2)
    owned = np.where(covers.any(axis=2), length, 0.0)
    slot = np.arange(lines)[:, None] * width + owner
    total = np.bincount(slot.ravel(), weights=owned.ravel(), minlength=lines * width)
    return np.asarray(total, np.float64).reshape(lines, width)


def _unrolled(azimuth: NDArray[np.float64], margin: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return rows and directions of the beams, ascending over [0, 2 pi), with those near the seam on both its sides."""
    turned = np.mod(azimuth, 2.0 * np.pi)
    row = np.argsort(turned, kind="stable")
    turned = turned[row]
    head = int(np.searchsorted(turned, margin, side="right"))
    tail = int(np.searchsorted(turned, 2.0 * np.pi - margin, side="left"))
    rows = np.concatenate([row[tail:], row, row[:head]])
    return rows, np.concatenate([turned[tail:] - 2.0 * np.pi, turned, turned[:head] + 2.0 * np.pi])


def _count_up(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 0 .. n-1 for every n of `counts`, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
