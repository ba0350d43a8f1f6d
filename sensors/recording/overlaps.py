"""Road users whose bodies overlap others', which SUMO does not see: to it a long body is a line on its lane."""

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

from sim.collisions import overlapping_pairs
from sim.traffic.base import Actors

DEEP_M = 0.15
"""Depth of an overlap from which on one of two bodies is left out, m."""


def overlapping(steps: Sequence[Actors], kept: Collection[str] = ()) -> set[int]:
    """Return the ids without which no two road users of a drive overlap at any step.

    Of two that overlap a parked car goes first, since nobody drives for it, then who overlaps more others, then the
    larger one.

    Args:
        steps: actors at every step.
        kept: names of those who stay, also where they overlap each other.
    """
    size: dict[int, float] = {}
    parked: set[int] = set()
    stays: set[int] = set()
    pairs: set[tuple[int, int]] = set()
    for actors in steps:
        boxes = actors.boxes
        if len(found := overlapping_pairs(boxes, -0.5 * DEEP_M)):
            ids = boxes.object_id[found]
            pairs |= {(int(one), int(other)) for one, other in ids}
            rows = np.unique(found)
            size |= dict(zip(boxes.object_id[rows].tolist(), boxes.size[rows, :2].prod(axis=1).tolist(), strict=True))
            parked |= set(boxes.object_id[rows][actors.parked()[rows]].tolist())
            stays |= {int(boxes.object_id[row]) for row in rows if actors.name[row] in kept}
    gone: set[int] = set()
    while left := [pair for pair in pairs if not gone & set(pair) and not set(pair) <= stays]:
        counts = Counter(one for pair in left for one in pair if one not in stays)
        gone.add(max(counts, key=lambda one: (one in parked, counts[one], size[one], one)))
    return gone


def without(actors: Actors, gone: Collection[int]) -> Actors:
    """Return actors without some ids."""
    stays = ~np.isin(actors.boxes.object_id, list(gone))
    return actors if stays.all() else actors[stays]
