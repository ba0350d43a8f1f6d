"""Defences: which objects of the helpers' messages an ego refuses, by the messages and the seen space alone.

* `agreement`: refuses what nobody else tells and the ego's own free space contradicts.
* `free-space`: refuses what stands in space that the ego or another helper sees as free and tells nothing of.
* `motion`: refuses a message whose sender, or most of whose objects, moved as nothing moves since its last one that was
  believed.
* `trust`: ignores a helper while the others refused something in too many of its last messages.

Free space is that of rays (`dsrc.messages.seen_space`): where no road user can be unseen, and the witness tells of
none. Objects lower than these rays are not judged, nor those so far or narrow that rays pass beside them in one sector,
nor those of an instant at which nobody looked. A witness says nothing of the place where it is itself. What was refused
stays so for some seconds where it is told again, since a witness has blind places close to it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dsrc.messages.message import Message, near_any
from dsrc.messages.seen_space import LOW_M, View
from dsrc.options.told import DEFENCES, NO_DEFENCE
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint, did_you_mean
from sim.geometry import wrap_angle

Defence = tuple[str, ...]

_SAME_S = 0.05
"""Largest difference of two instants that are one, s."""
_REFUSED_S = 3.0
"""Time for which an object stays refused after a witness contradicted it, s."""
_KEPT_S = 1.0
"""Age up to which views are kept for messages that arrive late, s."""
_CORE = 0.6
"""Share of the length and width of a box that must be free: its edges may be looked under or past."""
_SECTORS = 2.0
"""Sectors of a view that the narrower side of this part must be as wide as."""
_BODY_M = 1.0
"""Distance of a witness from a box at which the place may be its own, m."""
_SLACK_M, _HARD_MPS2, _FASTEST_MPS = 0.5, 10.0, 60.0
"""Error of a place, m, and the largest acceleration, m/s2, and speed, m/s, of a road user."""
_SLACK_RAD, _TURN_RADPS = np.radians(10.0), np.radians(120.0)
_UNMEASURED_MPS = 40.0
"""Speed that an object without a measured velocity may have, m/s."""
_MOVING_MPS = 1.0
_JUMP_M, _ALIKE_M = 30.0, 0.2
"""Distance within which an object that vanished may have jumped to, and difference of the sizes of one object, m."""
_FORGETS_S = 1.0
"""Time constant of a helper's record, s."""
_DOUBT = 0.3
"""Share of its messages, the newest counting most, with something refused from which on a helper is ignored."""


def parse_defence(text: str, where: str = "drive") -> Defence:
    """Return the defences of a text, names between commas or `none`, in the order in which they act.

    Raises:
        SettingsError: an unknown or repeated name, or `trust` without another one whose refusals it counts.
    """
    names = [name.strip() for name in text.split(",")]
    if names == [NO_DEFENCE]:
        return ()
    if NO_DEFENCE in names:
        raise SettingsError(complaint(where, "defence", f"'{NO_DEFENCE}' alone", text))
    if "" in names[1:]:
        raise SettingsError(complaint(where, "defence", "a name between two commas", f"nothing in '{text}'"))
    for name in names:
        if name not in DEFENCES:
            expected = f"{NO_DEFENCE}, or one of {', '.join(DEFENCES)} or several between commas"
            hint = did_you_mean(name, (*DEFENCES, NO_DEFENCE))
            raise SettingsError(complaint(where, "defence", expected, name or "nothing", hint))
        if names.count(name) > 1:
            raise SettingsError(complaint(where, "defence", "names that differ", f"{name} twice"))
    if names == ["trust"]:
        raise SettingsError(complaint(where, "defence", "another one beside trust, whose refusals it counts", "trust"))
    return tuple(name for name in DEFENCES if name in names)


@dataclass(frozen=True, slots=True)
class Witness:
    """What an agent sees, and the boxes that it tells of then."""

    view: View
    boxes: Boxes


@dataclass(slots=True)
class _Record:
    """What an ego remembers of a helper.

    Attributes:
        last: its newest message that `motion` believed.
        velocity: (2,) of the helper by its last two, m/s; None before.
        doubt: share of its messages with something refused, the newest counting most.
        doubt_s: instant of `doubt`.
        proven: boxes that a witness contradicted, and when.
    """

    last: Message | None = None
    velocity: NDArray[np.float64] | None = None
    doubt: float = 0.0
    doubt_s: float | None = None
    proven: list[tuple[float, Boxes]] = field(default_factory=list)


@dataclass(slots=True)
class Defences:
    """Defences of an ego over an episode.

    Attributes:
        names: of `dsrc.options.told.DEFENCES`.
    """

    names: Defence
    _records: dict[int, _Record] = field(default_factory=dict)
    _seen: deque[Witness] = field(default_factory=deque)

    def refused(self, own: Message, told: Sequence[Message]) -> list[NDArray[np.bool_]]:
        """Return for each helper's message (N,) objects that are refused; instants come in their order.

        Args:
            own: what the ego itself perceives now.
            told: messages of the helpers.
        """
        if not self.names:
            return [np.zeros(len(one.objects), bool) for one in told]
        records = [self._records.setdefault(one.sender, _Record()) for one in told]
        ignored = [record.doubt > _DOUBT for record in records]
        if {"agreement", "free-space"} & set(self.names):
            self._look([own, *(one for one, deaf in zip(told, ignored, strict=True) if not deaf)], own.time_s)
        found = []
        for one, record in zip(told, records, strict=True):
            bad = np.zeros(len(one.objects), bool)
            others = [each for each in self._seen if each.view.agent_id != one.sender]
            then = [each for each in others if abs(each.view.time_s - one.time_s) <= _SAME_S]
            ego = [each for each in then if each.view.agent_id == own.sender]
            if "agreement" in self.names:
                bad |= disagrees(one, [other for other in told if other is not one], ego)
            if "free-space" in self.names:
                bad |= in_free_space(one, then)
            bad |= self._again(one, record, bad, ego)
            if "motion" in self.names:
                bad |= self._jumps(one, record)
            if "trust" in self.names:
                self._weigh(one, record, bool(bad.any()))
                bad |= record.doubt > _DOUBT
            found.append(bad)
        return found

    def _look(self, messages: Sequence[Message], now_s: float) -> None:
        """Keep what is seen for messages that are of the same instants."""
        known = {(each.view.agent_id, each.view.time_s) for each in self._seen}
        self._seen.extend(
            Witness(one.view(), one.objects.boxes) for one in messages if (one.sender, one.time_s) not in known
        )
        self._seen = deque(each for each in self._seen if each.view.time_s >= now_s - _KEPT_S)

    def _again(
        self, message: Message, record: _Record, bad: NDArray[np.bool_], own: Sequence[Witness]
    ) -> NDArray[np.bool_]:
        """Return (N,) objects that stand where the sender's were refused before, and which the ego does not see."""
        boxes = message.objects.boxes
        record.proven = [(time_s, old) for time_s, old in record.proven if message.time_s - time_s <= _REFUSED_S]
        found = np.zeros(len(boxes), bool)
        for _, old in record.proven:
            found |= near_any(boxes, old)
        for each in own:
            found &= ~near_any(boxes, each.boxes)
        if bad.any():
            record.proven.append((message.time_s, boxes[bad]))
        return found

    def _jumps(self, message: Message, record: _Record) -> bool:
        last = record.last
        if last is not None and last.time_s == message.time_s:
            return False
        if last is not None and (not sender_moves(last, message, record.velocity) or objects_jump(last, message)):
            return True
        if last is not None:
            record.velocity = (message.pose[:2, 3] - last.pose[:2, 3]) / (message.time_s - last.time_s)
        record.last = message
        return False

    def _weigh(self, message: Message, record: _Record, refused: bool) -> None:
        if record.doubt_s == message.time_s:
            return
        passed_s = _SAME_S if record.doubt_s is None else message.time_s - record.doubt_s
        record.doubt += (1.0 - np.exp(-passed_s / _FORGETS_S)) * (refused - record.doubt)
        record.doubt_s = message.time_s


def in_free_space(message: Message, witnesses: Sequence[Witness]) -> NDArray[np.bool_]:
    """Return (N,) whether a witness has an object's place as free and tells of none there.

    Args:
        witnesses: others than the sender, at the instant of the message.
    """
    boxes = message.objects.boxes
    found = np.zeros(len(boxes), bool)
    if not len(boxes):
        return found
    places, tall = _core(boxes), boxes.size[:, 2] >= LOW_M
    wide_m = _CORE * boxes.size[:, :2].min(axis=1)
    for each in witnesses:
        view = each.view
        away_m = np.linalg.norm(boxes.center[:, :2] - view.xy, axis=1)
        judged = tall & (away_m > 0.5 * boxes.size[:, 0] + _BODY_M)
        judged &= wide_m >= _SECTORS * away_m * 2.0 * np.pi / view.seen.shape[0]
        judged &= ~near_any(boxes, each.boxes)
        found |= judged & view.sees(places.reshape(-1, 2)).reshape(len(boxes), -1).all(axis=1)
    return found


def disagrees(message: Message, others: Sequence[Message], own: Sequence[Witness]) -> NDArray[np.bool_]:
    """Return (N,) objects of a message that no other helper tells of and that stand in the ego's own free space.

    Args:
        others: of the other helpers.
        own: the ego at the instant of the message.
    """
    told = np.zeros(len(message.objects), bool)
    for other in others:
        told |= near_any(message.objects.boxes, other.objects.boxes)
    return np.asarray(~told & in_free_space(message, own))


def sender_moves(before: Message, now: Message, velocity: NDArray[np.float64] | None) -> bool:
    """Return whether a sender can have moved from one message's pose to another's.

    Args:
        velocity: (2,) of the sender before, m/s; None where it is unknown.
    """
    passed_s = now.time_s - before.time_s
    if before.sender < 0:
        velocity = np.zeros(2)  # a roadside unit stands
    still = np.zeros(2) if velocity is None else velocity
    off_m = float(np.linalg.norm(now.pose[:2, 3] - before.pose[:2, 3] - still * passed_s))
    faster_m = _FASTEST_MPS * passed_s if velocity is None else 0.5 * _HARD_MPS2 * passed_s**2
    headings = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in (before.pose, now.pose)]
    turned = abs(float(wrap_angle(headings[1] - headings[0])))
    return off_m <= _SLACK_M + faster_m and turned <= _SLACK_RAD + _TURN_RADPS * passed_s


def objects_jump(before: Message, now: Message) -> bool:
    """Return whether more moving objects jumped between two messages of a sender than went on, as after a cut in time.

    An object goes on where one was predicted. One jumped that did not, while another of its size vanished nearby.
    Those that stand tell nothing, as far as velocities are measured.
    """
    passed_s = now.time_s - before.time_s
    old, new = before.objects, now.objects
    if not len(old) or not len(new):
        return False
    measured = np.asarray(np.isfinite(old.velocity).all(axis=1))
    ahead = old.boxes.center[:, :2] + np.nan_to_num(old.velocity) * passed_s
    reach = _SLACK_M + np.where(measured, 0.5 * _HARD_MPS2 * passed_s**2, _UNMEASURED_MPS * passed_s)
    apart = np.linalg.norm(new.boxes.center[:, None, :2] - ahead, axis=2)
    goes_on = apart <= reach
    alike = np.abs(new.boxes.size[:, None] - old.boxes.size).max(axis=2) <= _ALIKE_M
    vanished = ~goes_on.any(axis=0)
    jumped = ~goes_on.any(axis=1) & np.any(alike & vanished & (apart <= _JUMP_M), axis=1)
    moving = ~measured | (np.linalg.norm(old.velocity, axis=1) > _MOVING_MPS)
    return bool(jumped.sum() > goes_on[:, moving].any(axis=1).sum())


def _core(boxes: Boxes) -> NDArray[np.float64]:
    """Return (N, 15, 2) places in the middle part of footprints."""
    along, aside = np.meshgrid(np.linspace(-0.5, 0.5, 5) * _CORE, np.linspace(-0.5, 0.5, 3) * _CORE)
    local = np.stack([along.ravel() * boxes.size[:, :1], aside.ravel() * boxes.size[:, 1:2]], axis=2)
    cos, sin = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    turned = np.stack([cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], axis=2)
    return np.asarray(boxes.center[:, None, :2] + turned)
