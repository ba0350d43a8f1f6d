"""What the ego perceives: the truth, or what a detector makes of the agents' sweeps."""

from collections import deque
from typing import Any, Protocol

import numpy as np

from dsrc.data.sample import Sample, make_sample
from dsrc.models.channel import Receiver
from dsrc.ops.detections import Detections
from sensors.corruptions import CLEAN, PAPER, Family, corrupt_frame
from sensors.frame import Frame
from sensors.presets import get_lidar
from sensors.recording.record import make_frame, place_roadside
from sensors.scan.scene import RayScene
from sim.boxes import Boxes
from sim.radio import IDEAL, MAX_AGE, PRESETS, ChannelSpec, Link
from sim.scenario import Scenario
from sim.traffic.base import Actors


class Perception(Protocol):
    """Gives the ego boxes of what is around it, in the world frame."""

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


class SampleDetector(Protocol):
    """Anything that detects in samples, see `dsrc.models.detector.Detector`."""

    @property
    def settings(self) -> Any:
        """Settings with at least `grid`; `max_agents`, when there, limits the collaborators."""
        ...

    def detect(self, sample: Sample) -> Detections:
        """Return detections in the ego LiDAR's frame."""
        ...


class TruthPerception:
    """Every road user near the ego, as it is.

    Args:
        reach_m: how far the ego sees.
    """

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
    """Sweeps of the ego and its collaborators, corrupted if asked, through a detector.

    Collaborators are the connected vehicles that the scenario names, or at every instant those nearest to the ego, and
    its roadside units.
    The rays of one sweep fire in the half rotation before and after an instant; the future half is extrapolated.

    Args:
        detector: finds boxes in samples.
        cooperative: False leaves the ego alone.
        corruption: kind or `clean`.
        severity: 1 to 5.
        family: of the corruption's settings.
        channel: through which the collaborators are heard.
    """

    def __init__(
        self,
        detector: SampleDetector,
        cooperative: bool = True,
        corruption: str = CLEAN,
        severity: int = PAPER,
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
        self._scene: RayScene | None = None
        self._built: tuple[Scenario, int] | None = None

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode; the static world is built once per scenario and seed."""
        from sim.world.build import build_world

        if self._scene is None or self._built != (scenario, seed):
            self._scene, self._built = RayScene(build_world(scenario, seed)), (scenario, seed)
        self._scenario, self._ego_id, self._seed = scenario, ego_id, seed
        self._roadside = place_roadside(self._scene, scenario.agents.roadside) if self.cooperative else ()
        self._index = 0
        self._past: deque[Frame] = deque(maxlen=MAX_AGE + 1)
        self._receiver = Receiver(self.channel, seed, scenario.step_s, self.detector.settings)

    def sense(self, before: Actors, now: Actors) -> Frame:
        """Scan the instant by the ego and its collaborators and corrupt the sweeps."""
        if self._scene is None:
            raise RuntimeError("DetectorPerception.sense before reset")
        frame = make_frame(
            self._scene,
            now,
            before,
            vehicles=[self._ego_id, *self._collaborators(now)],
            vehicle_spec=get_lidar(self._scenario.agents.lidar),
            roadside=self._roadside,
            seed=self._seed,
            index=self._index,
            visibility=False,  # nobody asks for it while the clock runs
        )
        self._index += 1
        return corrupt_frame(frame, self.corruption, self.severity, self._seed, self.family, ego_id=self._ego_id)

    def perceive(self, before: Actors, now: Actors) -> Boxes:
        """Return the detected boxes, world frame."""
        frame = self.sense(before, now)
        settings = self.detector.settings
        agents = getattr(settings, "max_agents", 5)
        sample = make_sample(frame, self._ego_id, settings.grid, max_agents=agents, cooperative=self.cooperative)
        self._past.appendleft(frame)
        sample, self.links = self._receiver.receive(self._past, self._index - 1, sample, settings.grid)
        world_from_lidar = frame.agent(self._ego_id).sweep.world_from_lidar
        return self.detector.detect(sample).boxes.transform(world_from_lidar)

    def _collaborators(self, now: Actors) -> list[int]:
        """Return the connected vehicles that the scenario names, else the nearest, as many as its rule gives."""
        if not self.cooperative:
            return []
        if self._scenario.agents.named:
            ids = [int(now.boxes.object_id[now.name.index(n)]) for n in self._scenario.agents.named if n in now.name]
            return [helper for helper in ids if helper != self._ego_id]
        ego = now.row(self._ego_id)
        distance = np.linalg.norm(now.boxes.center[:, :2] - now.boxes.center[ego, :2], axis=1)
        fit = now.boxes.is_vehicle & (distance <= self._scenario.agents.within_m)
        fit[ego] = False
        nearest = np.flatnonzero(fit)[np.argsort(distance[fit], kind="stable")]
        return [int(i) for i in now.boxes.object_id[nearest[: max(self._scenario.agents.vehicles - 1, 0)]]]
