"""Detector as a perception: from corrupted sweeps through the radio channel to boxes in the world."""

import math
from collections import deque
from dataclasses import replace
from functools import partial

import numpy as np

from dsrc.closed_loop.perception.senses import Senses
from dsrc.closed_loop.seen_space import SeenSpace, seen_of
from dsrc.closed_loop.types import Percept
from dsrc.data.sample import Sample, SampleDetector, make_sample
from dsrc.faults.fault import Faults
from dsrc.models.channel import Receiver
from dsrc.models.device import one_thread
from dsrc.ops.detections import Detections
from sensors.corruptions import Condition
from sensors.frame import Frame
from sensors.recording.encounter_check import BRAKING_MPS2
from sim.boxes import VEHICLES, Boxes
from sim.errors import SettingsError, complaint
from sim.geometry import invert
from sim.radio import IDEAL, MAX_AGE, PRESETS, ChannelSpec, Link, changed_spec
from sim.scenario import Scenario
from sim.traffic.base import Actors


class DetectorPerception:
    """Detections in the sweeps of the ego and its helpers; the detector gets no ground truth.

    Args:
        cooperative: False leaves the ego alone.
        channel: radio channel between the helpers and the ego.
        interval_s: time between percepts, s, thus between the helpers' messages.
        look_ahead_s: reaction time of the stopping distance that the detector's range is shifted ahead to cover, s, by
            half its reach at most; 0: no shift.
        engine: execution of the detector's network, for logs.
        faults: of the episode; those of sensors and radio act here.

    Raises:
        SettingsError: `look_ahead_s` is not finite or below 0, or not 0 for a network that encodes each cloud in its
            agent's own frame.
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
    ) -> None:
        self.detector, self.cooperative, self.channel, self.engine = detector, cooperative, channel, engine
        self.faults = faults
        self.senses = Senses(condition or Condition(), cooperative, faults)
        if not (math.isfinite(look_ahead_s) and look_ahead_s >= 0.0):
            raise SettingsError(complaint("perception", "look_ahead_s", "seconds >= 0", f"{look_ahead_s:g}"))
        if look_ahead_s and getattr(detector.settings, "own_frame", False):
            expected = "0 with a network that encodes clouds in the agents' own frames"
            raise SettingsError(complaint("perception", "look_ahead_s", expected, f"{look_ahead_s:g}"))
        self._interval_s, self.look_ahead_s = interval_s, look_ahead_s
        self._ego_id = -1
        self._past: deque[Frame] = deque(maxlen=MAX_AGE + 1)

    believes = True
    """Percepts are in the world as the ego believes it."""

    @property
    def message_interval_s(self) -> float | None:
        """Time between the helpers' messages, s; None without any, or where they arrive at once."""
        late = self.channel != PRESETS[IDEAL] or any(fault.radio for fault in self.faults)
        return self._interval_s if self.cooperative and late else None

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes that the detector names, else vehicles, which all detectors that train here are for."""
        return tuple(getattr(self.detector, "classes", VEHICLES))

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self.senses.reset(scenario, ego_id, seed)
        self._ego_id = ego_id
        self._past.clear()
        interval_s = max(self._interval_s, scenario.step_s)
        joined = [part.settings for part in getattr(self.detector, "detectors", ())[1:]]
        radio = [fault for fault in self.faults if fault.radio]
        self._receiver = Receiver(
            self.channel,
            seed,
            interval_s,
            self.detector.settings,
            joined,
            partial(_faulted, self.channel, tuple(radio), interval_s, ego_id) if radio else None,
        )

    @property
    def sensed(self) -> Frame | None:
        """Sweeps of the newest measurement; None before the first."""
        return self._past[0] if self._past else None

    def sample(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> tuple[Sample, tuple[Link, ...]]:
        """Return the detector's input at `now`, unlabelled, and the links to the helpers; arguments as `perceive`."""
        frame, request = self.senses.frame(before, now, claims), self.detector.settings.request
        speed_mps = float(np.linalg.norm(now.velocity[now.row(self._ego_id)]))
        ahead_m = _shift_m(speed_mps, self.look_ahead_s, request.grid.range_m[3])
        sample = make_sample(frame, self._ego_id, request, cooperative=self.cooperative, ahead_m=ahead_m)
        self._past.appendleft(frame)
        sample, links = self._receiver.receive(self._past, self.senses.index, sample, request.grid)
        none = (Boxes.zeros(),) * len(sample.agent_ids)
        return replace(sample, boxes=Boxes.zeros(), agent_boxes=none), links

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the detected boxes, with scores and classes as detected, without velocities and ids.

        Raises:
            TypeError: the detector returns something else than `Detections`.
        """
        sample, links = self.sample(before, now, claims)
        with one_thread():  # workers beside each other would take the cores from one another
            found = self.detector.detect(sample)
        if not isinstance(found, Detections):
            name = getattr(self.detector, "name", type(self.detector).__name__)
            raise TypeError(f"{name}.detect: expected Detections, found {type(found).__name__}")
        world_from_lidar = self._past[0].agent(self._ego_id).sweep.world_from_lidar
        boxes = found.boxes.transform(world_from_lidar @ invert(sample.ego_from_agent[0]))
        unknown = np.full(len(boxes), -1, np.int64)
        return Percept(
            time_s=now.time_s,
            boxes=replace(boxes, object_id=unknown),
            score=found.score.astype(np.float64),
            velocity=np.full((len(boxes), 2), np.nan),
            links=links,
            seen=self._seen(sample, links),
        )

    def _seen(self, sample: Sample, links: tuple[Link, ...]) -> SeenSpace:
        """Return the seen space by the sweeps that arrived, each where it is believed to be measured."""
        own = self._past[0].agent(self._ego_id)
        sent = {link.sender: self._past[self.senses.index - link.sent] for link in links if link.received}
        world_from_ego = own.sweep.world_from_lidar @ invert(sample.ego_from_agent[0])
        helpers = zip(sample.agent_ids[1:], sample.ego_from_agent[1:], strict=True)
        told = [(sent[agent_id].agent(agent_id), world_from_ego @ pose) for agent_id, pose in helpers]
        return seen_of([(own, None), *told])


def _faulted(spec: ChannelSpec, faults: Faults, interval_s: float, ego_id: int, index: int, sender: int) -> ChannelSpec:
    """Return the settings of the messages that an agent sends in an instant; the first instant of an episode is 1."""
    time_s = (index - 1) * interval_s
    for fault in faults:
        if fault.at(time_s) and fault.on(sender, ego_id):
            spec = changed_spec(spec, fault.radio)
    return spec


def _shift_m(speed_mps: float, look_ahead_s: float, reach_m: float) -> float:
    """Return the shift of a range that covers `reach_m` ahead of the ego, m."""
    if look_ahead_s == 0.0:
        return 0.0
    stop_m = speed_mps * look_ahead_s + speed_mps**2 / (2.0 * BRAKING_MPS2)
    return float(np.clip(stop_m - reach_m, 0.0, 0.5 * reach_m))
