"""What an ego hears of its helpers in single frames: their boxes, as they are or as ETSI's messages, lies, defences.

Without a route a liar takes the ego to go straight on. Messages are judged at the instant that they are of: one that
the channel brings late has no witness but those of its own instant.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, SampleDetector, first_agents, make_sample
from dsrc.faults.condition import faults_of
from dsrc.faults.kinds import Bias
from dsrc.messages.attacks import Attacks, Lie
from dsrc.messages.cpm import Cpm, placed, told_at_once
from dsrc.messages.defences import Defence
from dsrc.messages.inbox import Inbox
from dsrc.messages.message import Message, Objects, Told, as_detections, as_objects, counted_in, told_of
from dsrc.messages.seen_space import View
from dsrc.models.channel import Receiver
from dsrc.ops.detections import Detections
from dsrc.options.told import BOXES, CPM
from sensors.corruptions import Condition, ego_of
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.geometry import invert, pose_angles
from sim.radio import MAX_AGE, Link

_CAR_M = (4.5, 1.9, 1.5)
_AHEAD_M = 200.0


def lies(condition: Condition) -> bool:
    """Whether helpers lie under a condition."""
    return any(fault.attack for fault in faults_of(condition))


def fabricated(frame: Frame, condition: Condition, seed: int) -> Frame:
    """Return a frame whose liars share clouds, or features of them, that lie; `seed` is the drive's."""
    attacks = _attacks(frame, condition, seed)
    return frame.with_sweeps([attacks.measured(agent, frame.truth, frame.time_s) for agent in frame.agents])


def misplaced(frame: Frame, condition: Condition, seed: int) -> Frame:
    """Return a frame whose liars say to be elsewhere, and lie about nothing else; `seed` is the drive's."""
    if not any(isinstance(fault.settings, Bias) for fault in faults_of(condition) if fault.attack):
        return frame
    told = fabricated(frame, condition, seed)
    return frame.with_sweeps(
        [
            replace(own.sweep, world_from_lidar=said.sweep.world_from_lidar)
            for own, said in zip(frame.agents, told.agents, strict=True)
        ]
    )


def lies_in(
    frame: Frame, condition: Condition, seed: int, helpers: Sequence[int], ages: Mapping[int, float | None]
) -> dict[int, Lie]:
    """Return what helpers lie about in a frame, of those who lie under a condition and whose message arrived.

    Args:
        seed: the drive's.
        ages: of the helpers' messages, s; None for a lost one. Helpers that are not named were heard at once.
    """
    if not lies(condition):
        return {}
    attacks = _attacks(frame, condition, seed)
    since = {one: age for one in helpers if (age := ages.get(one, 0.0)) is not None}
    told = {one: attacks.lie(one, frame.truth, frame.time_s - age) for one, age in since.items()}
    return {one: lie for one, lie in told.items() if len(lie.ghosts) or lie.removed or lie.misplaced}


def _attacks(frame: Frame, condition: Condition, seed: int) -> Attacks:
    ego_id = ego_of(frame)
    attacks = Attacks(faults_of(condition), seed, ego_id)
    attacks.aim(*_way(frame, ego_id), frame.time_s)
    return attacks


def _way(frame: Frame, ego_id: int) -> tuple[Boxes, NDArray[np.float64]]:
    """Return the ego's box and the (2, 2) line straight ahead of it, world frame."""
    own = frame.truth[frame.truth.object_id == ego_id]
    if not len(own):
        pose = frame.agent(ego_id).world_from_body
        place = pose[:3, 3] + [0.0, 0.0, 0.5 * _CAR_M[2]]
        own = Boxes.from_array([*place, *_CAR_M, pose_angles(pose)[0]])
    start, yaw = own.center[0, :2], own.yaw[0]
    return own, np.array([start, start + _AHEAD_M * np.array([np.cos(yaw), np.sin(yaw)])])


class Listener:
    """Ego whose helpers tell boxes, over a drive.

    Args:
        detector: each of its agents detects alone, see `dsrc.messages.message.tells_boxes`.
        messages: of `dsrc.options.told.MESSAGES`; "" for the boxes that the detector finds in the clouds that
            arrived, whose bytes are those of a detector with late fusion.
        condition: its attacks act.
        seed: of the drive.
        receiver: of the messages; None where they arrive at once.
    """

    def __init__(
        self,
        detector: SampleDetector,
        messages: str,
        condition: Condition,
        defence: Defence,
        seed: int,
        receiver: Receiver | None,
    ) -> None:
        self._detector: Any = detector
        self._says, self._exact = bool(messages), messages == BOXES
        self._rule = "" if self._exact else messages.removeprefix(CPM).removeprefix("-")
        self._inbox, self._seed = Inbox(faults_of(condition), defence), seed
        self._made: dict[int, tuple[Objects, dict[int, Cpm]]] = {}
        self._condition = condition
        if receiver is not None:
            self._honest = self._said_bytes if self._says else receiver.payload
            receiver.payload = self._bytes

    def measure(self, past: Sequence[Frame], recorded: Sequence[Frame], whole: Sample) -> None:
        """Take the frames, now and before, newest first, as they are and as recorded, and what all measure now."""
        self._past, self._recorded, self._agents = past, recorded, len(whole.agent_ids)
        if self._says:
            self._made = {index: one for index, one in self._made.items() if index >= past[0].index - MAX_AGE}
            self._made[past[0].index] = self._say(past[0], whole)

    def detect(self, sample: Sample, links: Sequence[Link], position: int) -> tuple[Detections, tuple[Told, ...]]:
        """Return what the ego believes, and what became of the messages where anybody lies or defends.

        Args:
            sample: as received.
            links: of all helpers; none where messages arrive at once.
            position: of the frame in the drive.
        """
        now, ego_id = self._past[0], sample.agent_ids[0]
        world_from_sample = now.agent(ego_id).sweep.world_from_lidar
        sent = {link.sender: self._past[position - link.sent] for link in links if link.received}
        senders = [
            (agent, sent.get(agent, now), world_from_sample @ pose)
            for agent, pose in zip(sample.agent_ids, sample.ego_from_agent, strict=True)
        ]
        if self._says:
            messages = [self._message(agent, frame, pose) for agent, frame, pose in senders]
            parts = [as_detections(one.objects, world_from_sample) for one in messages]
        else:
            parts = self._detector.detect_each(sample)
            messages = told_of(parts, senders, world_from_sample)
        self._inbox.reset(self._seed, ego_id, 0.0)
        self._inbox.aim(*_way(now, ego_id), now.time_s)
        mail = self._inbox.read(messages[0], messages[1:])
        # Boxes that nobody changed stay as detected, to the bit.
        believed = [
            (as_detections(one.objects, world_from_sample) if one.attacked else part)[kept]
            for one, part, kept in zip(mail.messages, parts, mail.kept, strict=True)
        ]
        return self._detector.joined(believed), mail.told if self._inbox.active else ()

    def _message(self, agent: int, frame: Frame, pose: NDArray[np.float64]) -> Message:
        own, messages = self._said(frame)
        sender = frame.agent(agent)
        said = messages.get(agent)
        objects = own if said is None else placed(said, pose @ invert(sender.sweep.world_from_lidar))
        return Message.honest(agent, frame.time_s, pose, objects, lambda: View.of(sender, pose))

    def _said(self, frame: Frame) -> tuple[Objects, dict[int, Cpm]]:
        """Return what the ego detects in a frame, and the messages of its helpers."""
        if frame.index not in self._made:
            age = next(k for k, one in enumerate(self._past) if one is frame)
            sample = make_sample(frame, None, self._detector.settings.request, recorded=self._recorded[age])
            self._made[frame.index] = self._say(frame, first_agents(sample, self._agents))
        return self._made[frame.index]

    def _say(self, frame: Frame, sample: Sample) -> tuple[Objects, dict[int, Cpm]]:
        pose = frame.agent(sample.agent_ids[0]).sweep.world_from_lidar
        own, *found = (as_objects(part, pose) for part in self._detector.detect_each(sample))
        others = sample.agent_ids[1:]
        places = {agent: frame.agent(agent).sweep.world_from_lidar[:2, 3] for agent in others}
        return own, told_at_once(dict(zip(others, found, strict=True)), places, frame.time_s, self._rule, self._exact)

    def _said_bytes(self, frame: Frame, row: int) -> int:
        message = self._said(frame)[1].get(frame.agents[row].agent_id)
        return 0 if message is None else message.bytes

    def _bytes(self, frame: Frame, row: int) -> int:
        agent, honest = frame.agents[row].agent_id, self._honest(frame, row)
        if not (honest and lies(self._condition)):
            return honest
        if self._says:
            seen = self._said(frame)[1][agent].objects.boxes
        else:
            seen = counted_in(frame, row, self._detector)
        return honest + _attacks(frame, self._condition, self._seed).more_bytes(agent, seen, frame.time_s)
