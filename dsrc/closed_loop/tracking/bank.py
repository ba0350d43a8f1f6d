"""Rows of the tracker: the boxes of a percept, and the tracks."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.tracking.filter import YAW, Parameters, State, rotated
from dsrc.closed_loop.types import Percept
from sim.boxes import CLASSES, VEHICLES
from sim.rows import Rows

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_TWO_WHEELERS = ("motorcycle", "bicycle")
KIND = np.array([0 if name in VEHICLES else 1 if name in _TWO_WHEELERS else 2 for name in CLASSES])
"""Kind of road user by label, which decides how it moves."""
GROUP = np.minimum(KIND, 1)
"""Group of road users by label; a detection and a track of two groups are never one object. Detectors change between a
pedestrian and a bicycle from percept to percept, but a vehicle is neither."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured(Rows):
    """Boxes of a percept in an order of their own values, best score first.

    Attributes:
        time_s: instant of the measurement, s.
        box: (N, 7) x, y, z, l, w, h, yaw.
        label: (N,) class.
        score: (N,) 0 to 1.
        velocity: (N, 2) m/s.
        reported: (N,) whether the velocity is measured.
        variance: (N, 2, 2) of the centres, m2.
    """

    SHARED: ClassVar = ("time_s",)

    time_s: float
    box: Array
    label: Integers
    score: Array
    velocity: Array
    reported: NDArray[np.bool_]
    variance: Array

    @classmethod
    def of(cls, percept: Percept, table: Array, reported_m: float) -> Self:
        """Return the boxes of a percept.

        Args:
            percept: N boxes in any order.
            table: (7, 12) `Parameters` by label.
            reported_m: standard deviation of the centre of a box whose velocity is measured, m.

        Raises:
            ValueError: a number is not finite, or a score is outside 0 to 1.
        """
        box, label, score = percept.boxes.array, percept.boxes.label, percept.score.astype(np.float64)
        if not (np.isfinite(percept.time_s) and np.isfinite(box).all()):
            raise ValueError("Percept: expected a finite time and boxes, found NaN or infinity")
        if not ((score >= 0.0) & (score <= 1.0)).all():
            raise ValueError(f"Percept.score must be in 0 to 1, got {score.min()} to {score.max()}")
        reported = np.asarray(np.isfinite(percept.velocity).all(axis=1))
        velocity = np.where(reported[:, None], percept.velocity, 0.0)
        order = np.lexsort((*velocity.T, label, *box.T[::-1], -score))
        box, label, reported = box[order], label[order], reported[order]
        p = Parameters.of(table[label])
        across = np.where(reported, reported_m, p.position_m) ** 2
        along = across + np.where(reported, 0.0, p.length_error * box[:, 3]) ** 2
        variance = rotated(box[:, 6], along, across)
        return cls(percept.time_s, box, label, score[order], velocity[order], reported, variance)


@dataclass(frozen=True, slots=True, eq=False)
class Bank(Rows):
    """Tracks at one instant, in order of birth.

    Attributes:
        time_s: instant, s; -infinity before the first percept.
        state: estimates of the motion.
        z: (N,) height of the centre, m.
        sizes: (N, 7, 3) by class, m; 0 of those that no detection had.
        counts: (N, 7) number of detections by class.
        votes: (N, 7) sum of the scores by class.
        push: (N,) running mean of the residuals along the heading, standard deviations.
        facing: (N,) running mean of +1 for detected headings near the track's, -1 for opposite ones.
        score: (N,) confidence.
        evidence: (N,) logarithm of the odds that it is a road user and no series of ghosts.
        needed: (N,) least number of them that confirms it.
        seen_s: (N,) instant of the last detection, s.
        birth: (N,) number of the detection that started it.
        number: (N,) number of the track, -1 while it is tentative.
    """

    SHARED: ClassVar = ("time_s",)

    time_s: float
    state: State
    z: Array
    sizes: Array
    counts: Integers
    votes: Array
    push: Array
    facing: Array
    score: Array
    evidence: Array
    needed: Integers
    seen_s: Array
    birth: Integers
    number: Integers

    @property
    def label(self) -> Integers:
        """(N,) class of most votes, of those that a detection had."""
        return np.where(self.counts > 0, self.votes, -1.0).argmax(axis=1)

    @property
    def hits(self) -> Integers:
        """(N,) number of detections."""
        return self.counts.sum(axis=1)

    @property
    def size(self) -> Array:
        """(N, 3) size as of its class, m."""
        return self.sizes[np.arange(len(self.z)), self.label]

    @property
    def box(self) -> Array:
        """(N, 7) x, y, z, l, w, h, yaw."""
        return np.column_stack([self.state.mean[:, :2], self.z, self.size, self.state.mean[:, YAW]])
