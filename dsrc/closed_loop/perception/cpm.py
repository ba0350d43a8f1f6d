"""Detector whose helpers send ETSI's Collective Perception Messages in place of all their boxes."""

from dataclasses import replace
from typing import Any

from dsrc.closed_loop.messages.cpm import CpmPicture, CpmSender
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.data.sample import Sample, SampleDetector
from dsrc.messages.cpm import Cpm, placed
from dsrc.messages.message import Objects, Told, as_detections, as_objects, tells_boxes
from dsrc.messages.seen_space import SeenSpace
from dsrc.models.device import one_thread
from dsrc.ops.detections import Detections
from sensors.frame import Frame
from sim.errors import SettingsError, complaint
from sim.geometry import invert
from sim.radio import MAX_AGE, Link
from sim.scenario import Scenario
from sim.traffic.base import Actors


class CpmPerception(DetectorPerception):
    """Late fusion of what helpers tell by the rules of `dsrc.closed_loop.messages.cpm`.

    Each helper detects and tracks at every sweep, and its messages have the size of their objects. The ego keeps every
    object as it was told last, moved to the present.

    Args:
        rule: of redundancy mitigation, see `dsrc.messages.cpm`.

    Raises:
        SettingsError: as `DetectorPerception`; a detector whose agents do not tell boxes.
    """

    def __init__(self, detector: SampleDetector, *, rule: str = "", **settings: Any) -> None:
        super().__init__(detector, **settings)
        self._rule = rule

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        if not tells_boxes(self.detector):
            expected = "agents that tell boxes, as those of late fusion do"
            raise SettingsError(complaint("perception", "detector", expected, "one that fuses clouds or features"))
        super().reset(scenario, ego_id, seed)
        self._receiver.payload = self._bytes
        self._senders: dict[int, CpmSender] = {}
        self._pictures: dict[int, CpmPicture] = {}
        self._messages: dict[int, dict[int, Cpm | None]] = {}

    def _sense(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Frame:
        frame = super()._sense(before, now, claims)
        sample = self._sample(frame, now)
        with one_thread():
            parts = self.detector.detect_each(sample)  # type: ignore[attr-defined]  # see `reset`
        own, *told = (as_objects(part, self._world_from_sample(sample)) for part in parts)
        self._own: Objects = own
        made = self._messages[frame.index] = dict[int, Cpm | None]()
        for agent, one in zip(sample.agent_ids[1:], told, strict=True):
            said = (message for each in self._messages.values() for name, message in each.items() if name != agent)
            heard = [message for message in said if message is not None]
            place = frame.agent(agent).sweep.world_from_lidar[:2, 3]
            sender = self._senders.setdefault(agent, CpmSender(self._rule))
            made[agent] = sender.message(one, frame.time_s, place, heard)
        if len(self._messages) > MAX_AGE + 1:
            del self._messages[next(iter(self._messages))]
        for agent, message in made.items():
            if message is not None and self._receiver.held(self._past, self._instant, agent, self._ego_id):
                self._senders[agent].withdraw()
                made[agent] = None
        return frame

    def _bytes(self, frame: Frame, row: int) -> int:
        message = self._messages.get(frame.index, {}).get(frame.agents[row].agent_id)
        return 0 if message is None else message.bytes

    def _find(self, sample: Sample, links: tuple[Link, ...]) -> tuple[Detections, tuple[Told, ...], SeenSpace]:
        world_from_sample, now = self._world_from_sample(sample), self._past[0]
        parts = [as_detections(self._own, world_from_sample)]
        for link in links:
            picture = self._pictures.setdefault(link.sender, CpmPicture())
            arrived = self._receiver.arrived(self._past, self._instant, link.sender, self._ego_id)
            for number in set(arrived) - picture.heard:
                picture.heard.add(number)
                sent = self._past[self._instant - number]
                if (message := self._messages.get(sent.index, {}).get(link.sender)) is not None:
                    picture.hear(self._believed(message, link.sender, number))
            parts.append(as_detections(picture.objects(now.time_s), world_from_sample))
        return self.detector.joined(parts), (), self._seen(sample, links)  # type: ignore[attr-defined]

    def _believed(self, message: Cpm, agent_id: int, number: int) -> Cpm:
        """Return a message whose sender errs about where it is, by the error of the channel."""
        frame = self._past[self._instant - number]
        sender = frame.agent(agent_id)
        pose = self._receiver.believed_pose(sender, frame.time_s, number)
        if pose is sender.sweep.world_from_lidar:
            return message
        return replace(message, objects=placed(message, pose @ invert(sender.sweep.world_from_lidar)))
