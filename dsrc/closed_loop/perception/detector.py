"""Detector as a perception: from corrupted sweeps through the radio channel to boxes in the world."""

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.messages.present import Present
from dsrc.closed_loop.perception.senses import Senses, sensed_every_s
from dsrc.closed_loop.types import EgoState, Percept
from dsrc.data.sample import Sample, SampleDetector, make_sample
from dsrc.faults.condition import radio_faults
from dsrc.faults.fault import Faults
from dsrc.faults.kinds import REPLAY
from dsrc.messages.defences import Defence
from dsrc.messages.inbox import Inbox
from dsrc.messages.message import Told, as_detections, counted_in, tells_boxes, told_of
from dsrc.messages.seen_space import SeenSpace, seen_of
from dsrc.models.channel import Receiver
from dsrc.models.device import one_thread
from dsrc.ops.detections import Detections
from sensors.corruptions import Condition
from sensors.frame import Frame
from sensors.recording.encounter_check import BRAKING_MPS2
from sim.boxes import VEHICLES, Boxes
from sim.errors import SettingsError, complaint
from sim.geometry import invert
from sim.radio import IDEAL, MAX_AGE, PRESETS, ChannelSpec, Link
from sim.scenario import Scenario
from sim.traffic.base import Actors


class DetectorPerception:
    """Detections in the sweeps of the ego and its helpers; the detector gets no ground truth.

    Args:
        cooperative: False leaves the ego alone.
        channel: radio channel between the helpers and the ego.
        interval_s: time between percepts, s; messages that may be late are measured as often as LiDARs turn, or as
            this where it is no multiple.
        moved: messages that are late are moved to the present where agents tell boxes, see
            `dsrc.closed_loop.messages.present`; for measurements of what that gives.
        look_ahead_s: reaction time of the stopping distance that the detector's range is shifted ahead to cover, s, by
            half its reach at most; 0: no shift.
        engine: execution of the detector's network, for logs.
        faults: of the episode; those of sensors and radio, and attacks, act here.
        defence: against attacks, see `dsrc.messages.defences`.

    Raises:
        SettingsError: `look_ahead_s` is not finite or below 0, or not 0 for a network that encodes each cloud in its
            agent's own frame; an attack without helpers; a defence, or a replay, where agents tell no boxes.
    """

    def __init__(
        self,
        detector: SampleDetector,
        *,
        cooperative: bool = True,
        condition: Condition | None = None,
        channel: ChannelSpec = PRESETS[IDEAL],
        interval_s: float = 0.1,
        look_ahead_s: float = 0.0,
        engine: str = "fused",
        faults: Faults = (),
        defence: Defence = (),
        moved: bool = True,
    ) -> None:
        self.detector, self.cooperative, self.channel, self.engine = detector, cooperative, channel, engine
        self.faults = faults
        self.senses = Senses(condition or Condition(), cooperative, faults)
        if not (math.isfinite(look_ahead_s) and look_ahead_s >= 0.0):
            raise SettingsError(complaint("perception", "look_ahead_s", "seconds >= 0", f"{look_ahead_s:g}"))
        if look_ahead_s and getattr(detector.settings, "own_frame", False):
            expected = "0 with a network that encodes clouds in the agents' own frames"
            raise SettingsError(complaint("perception", "look_ahead_s", expected, f"{look_ahead_s:g}"))
        self._interval_s, self.look_ahead_s, self._moved = interval_s, look_ahead_s, moved
        self.defence, self._inbox = defence, Inbox(faults, defence)
        self._attacked, self._tells_boxes = any(one.attack for one in faults), tells_boxes(detector)
        if self._inbox.active and not cooperative:
            raise SettingsError(complaint("perception", "helpers", "some, with an attack or a defence", "none"))
        if not self._tells_boxes and (defence or any(one.kind == REPLAY for one in faults)):
            expected = f"agents that tell boxes, as those of late fusion do, with a defence or {REPLAY}"
            raise SettingsError(complaint("perception", "detector", expected, "one that fuses clouds or features"))
        self._ego_id = -1
        self._past: deque[Frame] = deque(maxlen=MAX_AGE + 1)
        self._instant, self._turned_s = 0, -math.inf  # number of the newest measurement; time of the newest turn, s

    believes = True
    """Percepts are in the world as the ego believes it."""

    @property
    def interval_s(self) -> float | None:
        """Time between percepts, s, by which messages are timed; None without any, or where they arrive at once."""
        late = self.channel != PRESETS[IDEAL] or any(fault.radio for fault in self.faults)
        return self._interval_s if self.cooperative and late else None

    @property
    def message_interval_s(self) -> float | None:
        """Time between the helpers' messages, s; None without any, or where they arrive at once."""
        return None if self.interval_s is None else sensed_every_s(self.interval_s, at_once=False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes that the detector names, else vehicles, which all detectors that train here are for."""
        return tuple(getattr(self.detector, "classes", VEHICLES))

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self.senses.reset(scenario, ego_id, seed)
        self._inbox.reset(seed, ego_id)
        self._ego_id = ego_id
        self._past.clear()
        self._instant, self._turned_s = 0, -math.inf
        interval_s = max(self.message_interval_s or self._interval_s, scenario.step_s)
        self._present = Present()
        joined = [part.settings for part in getattr(self.detector, "detectors", ())[1:]]
        self._receiver = Receiver(
            self.channel,
            seed,
            interval_s,
            self.detector.settings,
            joined,
            radio_faults(self.faults, self.channel, interval_s, ego_id),
        )
        honest = self._receiver.payload
        self._more_bytes: dict[tuple[int, int], int] = {}
        self._receiver.payload = lambda frame, row: honest(frame, row) + self._more_bytes.get((frame.index, row), 0)

    @property
    def sensed(self) -> Frame | None:
        """Sweeps of the newest measurement; None before the first."""
        return self._past[0] if self._past else None

    def sample(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> tuple[Sample, tuple[Link, ...]]:
        """Return the detector's input at `now`, unlabelled, and the links to the helpers; arguments as `perceive`."""
        sample = self._sample(self._sense(before, now, claims), now)
        grid = self.detector.settings.request.grid
        return self._receiver.receive(self._past, self._instant, sample, grid)

    def _sample(self, frame: Frame, now: Actors) -> Sample:
        """Return what all agents measured in a frame, unlabelled."""
        request = self.detector.settings.request
        speed_mps = float(np.linalg.norm(now.velocity[now.row(self._ego_id)]))
        ahead_m = _shift_m(speed_mps, self.look_ahead_s, request.grid.range_m[3])
        sample = make_sample(frame, self._ego_id, request, cooperative=self.cooperative, ahead_m=ahead_m)
        none = (Boxes.zeros(),) * len(sample.agent_ids)
        return replace(sample, boxes=Boxes.zeros(), agent_boxes=none)

    def overhear(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> None:
        """Let the helpers measure and send between two percepts, if that is heard later; arguments as `perceive`.

        Else the sensors turn on all the same: the noise of a sweep does not depend on the radio.
        """
        if now.time_s - self._turned_s < sensed_every_s(self._interval_s, at_once=False) - 1e-6:
            return
        if self.message_interval_s is not None:
            self._sense(before, now, claims)
        else:
            self.senses.pass_over(before, now)
            self._turned_s = now.time_s

    def _sense(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Frame:
        frame = self.senses.frame(before, now, claims)
        if self._attacked and not self._tells_boxes:
            self._inbox.check(self.senses.agents[1:])
            # Clouds, or features of them, that lie as the boxes of their helper would.
            shared = [self._inbox.measured(agent, now.boxes, frame.time_s) for agent in frame.agents]
            frame = frame.with_sweeps(shared)
        self._past.appendleft(frame)
        self._instant, self._turned_s = self._instant + 1, now.time_s
        if self._attacked and self._tells_boxes:
            for row, agent in enumerate(frame.agents):
                seen = counted_in(frame, row, self.detector)
                self._more_bytes[frame.index, row] = self._inbox.more_bytes(agent.agent_id, seen, frame.time_s)
        return frame

    def aim(self, ego: EgoState) -> None:
        """Tell attackers where the ego is and goes."""
        self._inbox.aim(ego.box, ego.route, ego.time_s)

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the detected boxes, with scores and classes as detected, without velocities and ids.

        Raises:
            TypeError: the detector returns something else than `Detections`.
        """
        sample, links = self.sample(before, now, claims)
        with one_thread():  # workers beside each other would take the cores from one another
            found, told, seen = self._find(sample, links)
        if not isinstance(found, Detections):
            name = getattr(self.detector, "name", type(self.detector).__name__)
            raise TypeError(f"{name}.detect: expected Detections, found {type(found).__name__}")
        boxes = found.boxes.transform(self._world_from_sample(sample))
        unknown = np.full(len(boxes), -1, np.int64)
        return Percept(
            time_s=now.time_s,
            boxes=replace(boxes, object_id=unknown),
            score=found.score.astype(np.float64),
            velocity=np.full((len(boxes), 2), np.nan),
            links=links,
            seen=seen,
            told=told,
        )

    def _find(self, sample: Sample, links: tuple[Link, ...]) -> tuple[Detections, tuple[Told, ...], SeenSpace]:
        """Return the detections, what became of the helpers' messages, and the seen space."""
        if self._tells_boxes and (self._inbox.active or (self._moved and self.message_interval_s)):
            return self._read(sample, links)
        return self.detector.detect(sample), (), self._seen(sample, links)

    def _seen(self, sample: Sample, links: tuple[Link, ...]) -> SeenSpace:
        """Return the seen space by the sweeps that arrived, each where it is believed to be measured."""
        own = self._past[0].agent(self._ego_id)
        return seen_of([(own, None), *((sent.agent(agent), pose) for agent, sent, pose in self._sent(sample, links))])

    def _sent(self, sample: Sample, links: tuple[Link, ...]) -> list[tuple[int, Frame, NDArray[np.float64]]]:
        """Return of each helper whose message arrived its id, the frame that it is of, and its believed LiDAR pose."""
        sent = {link.sender: self._past[self._instant - link.sent] for link in links if link.received}
        world_from_ego = self._world_from_sample(sample)
        helpers = zip(sample.agent_ids[1:], sample.ego_from_agent[1:], strict=True)
        return [(agent, sent[agent], world_from_ego @ pose) for agent, pose in helpers]

    def _world_from_sample(self, sample: Sample) -> NDArray[np.float64]:
        world_from_lidar = self._past[0].agent(self._ego_id).sweep.world_from_lidar
        return world_from_lidar @ invert(sample.ego_from_agent[0])

    def _read(self, sample: Sample, links: tuple[Link, ...]) -> tuple[Detections, tuple[Told, ...], SeenSpace]:
        """Return the detections of all agents as the ego believes them, what became of them, and the seen space."""
        self._inbox.check(self.senses.agents[1:])
        detector: Any = self.detector
        parts: list[Detections] = detector.detect_each(sample)
        world_from_sample, ego = self._world_from_sample(sample), self._past[0]
        senders = [(self._ego_id, ego, ego.agent(self._ego_id).sweep.world_from_lidar), *self._sent(sample, links)]
        messages = told_of(parts, senders, world_from_sample)
        mail = self._inbox.read(messages[0], messages[1:])
        # Boxes that nobody changed stay as detected, to the bit.
        believed = []
        for one, part, kept in zip(mail.messages, parts, mail.kept, strict=True):
            objects = (
                self._present.moved(one, ego.time_s) if self._moved and one.sender != self._ego_id else one.objects
            )
            same = objects is one.objects and not one.attacked
            believed.append((part if same else as_detections(objects, world_from_sample))[kept])
        return detector.joined(believed), mail.told if self._inbox.active else (), mail.seen


def _shift_m(speed_mps: float, look_ahead_s: float, reach_m: float) -> float:
    """Return the shift of a range that covers `reach_m` ahead of the ego, m."""
    if look_ahead_s == 0.0:
        return 0.0
    stop_m = speed_mps * look_ahead_s + speed_mps**2 / (2.0 * BRAKING_MPS2)
    return float(np.clip(stop_m - reach_m, 0.0, 0.5 * reach_m))
