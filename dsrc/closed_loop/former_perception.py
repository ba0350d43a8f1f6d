"""Perception of the ego: ground truth, or a detector on the agents' sweeps."""

from collections import deque
from dataclasses import replace
from typing import Protocol

import numpy as np

from dsrc.data.sample import SampleDetector, make_sample
from dsrc.models.channel import Receiver
from sensors.corruptions import CLEAN, DEFAULT_SEVERITY, Family, corrupt_frame
from sensors.frame import Frame
from sensors.recording.rig import Rig
from sensors.scan.scene import RayScene
from sim.boxes import Boxes
from sim.radio import IDEAL, MAX_AGE, PRESETS, ChannelSpec, Link
from sim.scenario import Scenario
from sim.traffic.base import Actors


class Perception(Protocol):
    """Perception of the ego: boxes of the objects around it, world frame.

    Attributes:
        cooperative: whether it uses messages of helpers.
    """

    cooperative: bool

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        ...

    def perceive(self, before: Actors, now: Actors) -> Boxes:
        """Return boxes in the world frame.

        Args:
            before: the actors one traffic step ago.
            now: the actors now.
        """
        ...


class TruthPerception:
    """Ground truth of the road users near the ego.

    Args:
        reach_m: range, m.
    """

    cooperative = False

    def __init__(self, reach_m: float = 70.0) -> None:
        self.reach_m = reach_m

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self._ego_id = ego_id

    def perceive(self, before: Actors, now: Actors) -> Boxes:
        """Return the boxes of all other actors within reach, world frame."""
        ego = now.boxes.center[now.row(self._ego_id)]
        near = np.linalg.norm(now.boxes.center[:, :2] - ego[:2], axis=1) <= self.reach_m
        return now.boxes[near & (now.boxes.object_id != self._ego_id)]


class DetectorPerception:
    """Detections in the sweeps of the ego and its collaborators, corrupted on request.

    Frames are those of `sensors.recording.rig`, as in a recorded drive of the same traffic, counted in traffic steps
    since the start; the half of a sweep after an instant is extrapolated. Collaborators are chosen once, at the start
    (`Rig.carriers`), beside the scenario's roadside units. The detector gets no ground truth.

    Args:
        detector: finds boxes in samples.
        cooperative: False leaves the ego alone.
        corruption: kind or `clean`.
        severity: 1 to 5.
        family: of the corruption's settings.
        channel: radio channel between the collaborators and the ego.
    """

    def __init__(
        self,
        detector: SampleDetector,
        cooperative: bool = True,
        corruption: str = CLEAN,
        severity: int = DEFAULT_SEVERITY,
        family: Family = "physical",
        channel: ChannelSpec = PRESETS[IDEAL],
    ) -> None:
        self.detector = detector
        self.cooperative = cooperative
        self.corruption = corruption
        self.severity = severity
        self.family = family
        self.channel = channel
        self.links: tuple[Link, ...] = ()
        self._rig: Rig | None = None

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode; the static world is built once per scenario and seed."""
        from sim.world.build import build_world

        if self._rig is None or (self._rig.scenario, self._rig.seed) != (scenario, seed):
            self._rig = Rig(scenario, RayScene(build_world(scenario, seed)), seed, visibility=False)
        self._ego_id, self._index = ego_id, 0
        self._agents: tuple[int, ...] = ()
        self._steps: deque[Actors] = deque(maxlen=self._rig.margin(scenario.step_s) + 1)
        self._past: deque[Frame] = deque(maxlen=MAX_AGE + 1)
        self._receiver = Receiver(self.channel, seed, scenario.step_s, self.detector.settings)

    def sense(self, before: Actors, now: Actors) -> Frame:
        """Scan the instant by the ego and its collaborators and corrupt the sweeps."""
        if self._rig is None:
            raise RuntimeError("DetectorPerception.sense before reset")
        if not self._steps:
            self._steps.append(before)
            carriers = self._rig.carriers(before, self._ego_id)
            self._agents = (*carriers, *self._rig.roadside) if self.cooperative else (self._ego_id,)
        self._steps.append(now)
        self._index += 1
        oldest = self._steps[0] if len(self._steps) == self._steps.maxlen else None
        present = [agent for agent in self._agents if agent < 0 or agent in now.boxes.object_id]
        frame = self._rig.frame(self._index, present, now, oldest)
        return corrupt_frame(frame, self.corruption, self.severity, self._rig.seed, self.family, ego_id=self._ego_id)

    def perceive(self, before: Actors, now: Actors) -> Boxes:
        """Return the detected boxes, world frame."""
        frame = self.sense(before, now)
        settings = self.detector.settings
        agents = getattr(settings, "max_agents", 5)
        sample = make_sample(frame, self._ego_id, settings.grid, max_agents=agents, cooperative=self.cooperative)
        self._past.appendleft(frame)
        sample, self.links = self._receiver.receive(self._past, self._index, sample, settings.grid)
        unlabelled = replace(sample, boxes=Boxes.zeros(), agent_boxes=(Boxes.zeros(),) * len(sample.agent_ids))
        world_from_lidar = frame.agent(self._ego_id).sweep.world_from_lidar
        return self.detector.detect(unlabelled).boxes.transform(world_from_lidar)
