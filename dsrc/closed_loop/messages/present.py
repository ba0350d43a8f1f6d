"""Messages moved to the present: objects stand where their motion has taken them since the message was measured.

Each sender's messages are tracked by themselves, so that an object moves by the motion that its own sender saw; where
a message states velocities, by these.
"""

from dataclasses import replace

import numpy as np

from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Percept, Tracks
from dsrc.messages.message import SAME_M, Message, Objects
from sim.boxes import Boxes
from sim.geometry import Array

_SAME_S = 1e-6


class Present:
    """Motion of what the senders of an episode tell of."""

    def __init__(self) -> None:
        self._trackers: dict[int, tuple[Tracker, Tracks]] = {}

    def moved(self, message: Message, time_s: float) -> Objects:
        """Return the objects of a message at a later time, by constant velocity and turn rate.

        What was told of once, and stands for all that is known, stays where it is; so does all of a message of now.

        Args:
            message: no older than the one before it of its sender.
            time_s: the present, s.
        """
        told = message.objects
        tracks, age_s = self._tracked(message), time_s - message.time_s
        if age_s <= _SAME_S or not len(told):
            return told
        velocity, rate = np.zeros((len(told), 2)), np.zeros(len(told))
        if len(tracks):
            apart = np.linalg.norm(told.boxes.center[:, None, :2] - tracks.boxes.center[None, :, :2], axis=2)
            nearest = apart.argmin(axis=1)
            known = apart.min(axis=1) <= SAME_M
            velocity[known], rate[known] = tracks.velocity[nearest[known]], tracks.yaw_rate[nearest[known]]
        stated = np.isfinite(told.velocity).all(axis=1)
        velocity[stated] = told.velocity[stated]
        moved = advanced(told.boxes, velocity, rate, np.full(len(told), age_s))
        return Objects(moved, told.score, told.velocity)

    def _tracked(self, message: Message) -> Tracks:
        """Return the tracks of a sender's objects at the instant of its message."""
        tracker, tracks = self._trackers.get(message.sender, (Tracker(), None))
        if tracks is None or message.time_s > tracks.time_s + _SAME_S:
            told = message.objects
            percept = Percept(message.time_s, told.boxes, told.score, told.velocity)
            tracks = tracker.update(percept, message.time_s)
            self._trackers[message.sender] = tracker, tracks
        return tracks


def advanced(boxes: Boxes, velocity: Array, rate: Array, age_s: Array) -> Boxes:
    """Return boxes after (N,) times, by constant (N, 2) velocity and (N,) turn rate."""
    center = boxes.center.copy()
    center[:, :2] += age_s[:, None] * _turned(velocity, 0.5 * age_s * rate)  # the chord of the arc
    return replace(boxes, center=center, yaw=boxes.yaw + age_s * rate)


def _turned(vectors: Array, angle: Array) -> Array:
    """Return (N, 2) vectors turned counter-clockwise by (N,) angles."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * vectors[:, 0] - sin * vectors[:, 1], sin * vectors[:, 0] + cos * vectors[:, 1]], axis=1)
