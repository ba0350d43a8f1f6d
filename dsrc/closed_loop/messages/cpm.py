"""Collective Perception Messages of ETSI TS 103 324 V2.1.1 (2023-06) over time: when which objects are told.

* A message is made at most every 0.1 s and at least every second (6.1.2.1; Table F.1): here at each sweep at which an
  object is told, or after a second.
* An object is new when it is first detected: no confirmed track is demanded. The threshold of perception quality, more
  than 3 (Table F.1), leaves out nothing that a sweep detects: as the mean of detection success, confidence and age in
  tenths of a second, 15 at most each (7.1.8.6), that has 4 or more. Until the sender's tracker has confirmed it, an
  object is told without its motion, which is optional; then it is told again, since the change of an unstated speed is
  unknown.
* Vehicles and motorcycles, Type-B, are told when they are new, have moved more than 4 m, changed their speed by more
  than 0.5 m/s or their direction by 4 degrees, or were told a second ago (6.1.2.3, rule 2). What is slower than 0.5 m/s
  has no direction: that of a standing track is noise.
* Pedestrians and bicycles, Type-A: one when it is new; all of them when one was told half a second ago (6.1.2.3,
  rule 1).
* With a rule of redundancy mitigation, what others told is left out, see `dsrc.messages.cpm`, and makes no other due.

The rules were compared with those in Artery's `CpService`, which quotes the clause. No object is told ahead of the next
event, which the clause allows.

Times are those of the sweep, to the millisecond. Objects are tracks: the message states velocities and turn rates.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.messages.present import advanced
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Percept, Tracks
from dsrc.messages.cpm import Cpm, quantised, redundant
from dsrc.messages.message import Objects
from sim.boxes import CLASSES, Boxes
from sim.geometry import Array, wrap_angle

SHORTEST_S = 0.1
"""`T_GenCpmMin`: shortest time between two messages, s."""
LONGEST_S = 1.0
"""`T_GenCpmMax`: longest time between two messages, and after which an object of Type-B is told again, s."""
MOVED_M, FASTER_MPS, TURNED_DEG = 4.0, 0.5, 4.0
"""Least change of an object of Type-B since it was told (Table F.1)."""
FORGOTTEN_S = 1.5
"""Age from which a receiver drops an object: it would have been told again, even if one message was lost, s."""
_TYPE_A = [CLASSES.index(name) for name in ("pedestrian", "bicycle")]
_SLACK_S = 1e-6


@dataclass(frozen=True, slots=True)
class _Told:
    """An object as it was told last; `velocity` is NaN where none was stated."""

    time_s: float
    xy: Array
    velocity: Array


class CpmSender:
    """Sender of an agent over an episode: it tracks what it detects and tells of it by the rules.

    Args:
        rule: of redundancy mitigation, see `dsrc.messages.cpm`.
    """

    def __init__(self, rule: str = "") -> None:
        self._tracker, self._rule = Tracker(), rule
        self._told: dict[int, _Told] = {}
        self._sent_s = -np.inf
        self._before = self._told, self._sent_s

    def message(self, detected: Objects, time_s: float, place: Array, heard: Sequence[Cpm] = ()) -> Cpm | None:
        """Return the message of an instant, None where none is made; instants come in their order.

        Args:
            detected: objects that the agent detects now, world frame.
            place: (2,) of the agent, world frame, m.
            heard: messages of others, for redundancy mitigation.
        """
        self._tracker.update(Percept(time_s, detected.boxes, detected.score, detected.velocity), time_s)
        tracks, sure = self._tracker.perceived()
        tracks = replace(
            tracks,
            velocity=np.where(sure[:, None], tracks.velocity, np.nan),
            yaw_rate=np.where(sure, tracks.yaw_rate, 0.0),
        )
        if time_s - self._sent_s < SHORTEST_S - _SLACK_S:
            return None
        objects = Objects(tracks.boxes, tracks.score, tracks.velocity)
        left = redundant(self._rule, objects, place, heard, time_s)
        due = self._due(tracks, left, time_s) & ~left
        if not due.any() and time_s - self._sent_s < LONGEST_S - _SLACK_S:
            return None
        told = tracks[due]
        self._before = dict(self._told), self._sent_s
        for number, xy, velocity in zip(
            told.boxes.object_id.tolist(), told.boxes.center[:, :2], told.velocity, strict=True
        ):
            self._told[number] = _Told(time_s, xy, velocity)
        self._sent_s = time_s
        return Cpm(round(time_s, 3), *quantised(objects[due], told.yaw_rate), place)

    def withdraw(self) -> None:
        """Take the last message back, which the channel did not let out: its objects are yet to be told."""
        self._told, self._sent_s = self._before

    def _due(self, tracks: Tracks, left: NDArray[np.bool_], time_s: float) -> NDArray[np.bool_]:
        """Return (N,) which tracks are told now, but for those that are left to others."""
        soft = np.isin(tracks.boxes.label, _TYPE_A)
        due, soft_due = np.zeros(len(tracks), bool), False
        for row, number in enumerate(tracks.boxes.object_id.tolist()):
            last, velocity = self._told.get(number), tracks.velocity[row]
            if last is None or np.isnan(last.velocity).any() > np.isnan(velocity).any():
                due[row] = True
                continue
            age_s = time_s - last.time_s + _SLACK_S
            if soft[row]:
                soft_due |= age_s >= 0.5 * LONGEST_S and not left[row]
                continue
            speeds = np.linalg.norm([last.velocity, velocity], axis=1)
            turned = wrap_angle(np.diff(np.arctan2([last.velocity[1], velocity[1]], [last.velocity[0], velocity[0]])))
            due[row] = (
                age_s >= LONGEST_S
                or np.linalg.norm(tracks.boxes.center[row, :2] - last.xy) > MOVED_M
                or abs(speeds[1] - speeds[0]) > FASTER_MPS
                or (speeds.min() > FASTER_MPS and abs(turned[0]) >= np.radians(TURNED_DEG))
            )
        return due | (soft & soft_due)


class CpmPicture:
    """What a receiver knows of one sender's objects: each as it was told last."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[float, Cpm, int]] = {}
        self.heard: set[int] = set()
        """Numbers of the instants whose messages were taken in."""

    def hear(self, message: Cpm) -> None:
        """Take in a message; one that others have overtaken tells only what they did not."""
        for row, number in enumerate(message.objects.boxes.object_id.tolist()):
            if number not in self._known or self._known[number][0] < message.time_s:
                self._known[number] = message.time_s, message, row

    def objects(self, time_s: float) -> Objects:
        """Return the objects moved to the present by their stated motion; one without it once, where it was."""
        self._known = {key: one for key, one in self._known.items() if time_s - one[0] <= FORGOTTEN_S}
        known = list(self._known.values())
        rows = [message.objects.boxes.array[row] for _, message, row in known]
        label = np.array([message.objects.boxes.label[row] for _, message, row in known], np.int64)
        velocity = np.array([message.objects.velocity[row] for _, message, row in known]).reshape(-1, 2)
        rate = np.array([message.rate[row] for _, message, row in known])
        score = np.array([message.objects.score[row] for _, message, row in known])
        age_s = time_s - np.array([since for since, _, _ in known])
        boxes = Boxes.from_array(np.array(rows).reshape(-1, 7), label=label)
        moving = np.isfinite(velocity).all(axis=1)
        self._known = {key: one for (key, one), lasts in zip(self._known.items(), moving, strict=True) if lasts}
        return Objects(advanced(boxes, np.nan_to_num(velocity), rate, age_s), score, velocity)
