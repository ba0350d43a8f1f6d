"""Constant-velocity tracker: detections of single instants to moving obstacles."""

from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sim.boxes import Boxes, concatenate


class TrackerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of association and memory.

    Attributes:
        gate: greatest distance of a detection from a track's prediction, m.
        gain: weight of a new velocity measurement, 0 to 1.
        forget_s: longest time without a detection before a track is dropped, s.
    """

    gate: float = 3.0
    gain: float = 0.5
    forget_s: float = 0.4


@dataclass(slots=True)
class Tracker:
    """Tracker of boxes in the world frame: Hungarian nearest neighbours, smoothed velocities.

    Attributes:
        settings: association and memory.
        boxes: N tracked boxes; `object_id` is the track's number.
        velocity: (N, 2) m/s.
    """

    settings: TrackerSettings = field(default_factory=TrackerSettings)
    boxes: Boxes = field(default_factory=Boxes.zeros)
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    _unseen_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    _time_s: float | None = None
    _next_id: int = 0

    def update(self, detected: Boxes, time_s: float) -> tuple[Boxes, NDArray[np.float64]]:
        """Advance to `time_s` by its detections; return the boxes and velocities (N, 2), m/s, of all tracks."""
        dt = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        predicted = self.boxes.center.copy()
        predicted[:, :2] += self.velocity * dt
        distance = np.linalg.norm(predicted[:, None, :2] - detected.center[None, :, :2], axis=2)
        tracks, found = linear_sum_assignment(np.minimum(distance, 1e3))
        near = distance[tracks, found] <= self.settings.gate
        tracks, found = tracks[near], found[near]

        velocity = self.velocity.copy()
        if dt > 0.0:
            measured = (detected.center[found, :2] - self.boxes.center[tracks, :2]) / dt
            velocity[tracks] += self.settings.gain * (measured - velocity[tracks])
        missed = np.setdiff1d(np.arange(len(self.boxes)), tracks)
        unseen = self._unseen_s[missed] + dt
        missed = missed[unseen <= self.settings.forget_s]
        fresh = np.setdiff1d(np.arange(len(detected)), found)

        seen = replace(detected[found], object_id=self.boxes.object_id[tracks])
        coasting = replace(self.boxes[missed], center=predicted[missed])
        born = replace(detected[fresh], object_id=self._next_id + np.arange(len(fresh)))
        self._next_id += len(fresh)
        self.boxes = concatenate([seen, coasting, born])
        self.velocity = np.concatenate([velocity[tracks], velocity[missed], np.zeros((len(fresh), 2))])
        self._unseen_s = np.concatenate(
            [np.zeros(len(tracks)), unseen[unseen <= self.settings.forget_s], np.zeros(len(fresh))]
        )
        return self.boxes, self.velocity
