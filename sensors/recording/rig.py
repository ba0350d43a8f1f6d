"""Rig: LiDARs of a scenario's agents and the frames they measure, in recordings and in the closed loop alike."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.frame import AgentFrame, Frame, agent_order, count_points
from sensors.presets import scenario_lidars
from sensors.recording.agent_selection import nearest_agents
from sensors.recording.mounting import Mount, on_roadside, on_vehicle, place_roadside
from sensors.scan.lidar import Sensor, scan_all
from sensors.scan.line_of_sight import lines_of_sight
from sensors.scan.scene import RayScene
from sensors.scan.visibility import visible_fraction
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import Actors

TRUTH_RANGE_M = 150.0
"""Distance from any agent within which actors are ground truth."""


class Rig:
    """LiDARs of a scenario's agents: mounts, carriers, sensing margin and noise.

    Attributes:
        scenario: rule of the agents, area and roadside units.
        scene: static world.
        seed: of noise and drop-off.
        vehicle_spec: LiDAR of the vehicles.
        mount: place of the vehicles' LiDARs.
        roadside: roadside units by id, -1, -2, ...
        period_s: longest sweep, s.
    """

    def __init__(
        self,
        scenario: Scenario,
        scene: RayScene,
        seed: int,
        *,
        vehicle_spec: LidarSpec | None = None,
        visibility: bool = True,
        threads: int | None = None,
    ) -> None:
        """Mount the LiDARs and place the roadside units on the ground.

        Args:
            vehicle_spec: LiDAR of the vehicles; left out: the scenario's.

        Raises:
            ScenarioError: unknown LiDAR preset.
        """
        preset, roadside_specs = scenario_lidars(scenario)
        self.scenario, self.scene, self.seed = scenario, scene, seed
        self.vehicle_spec = preset if vehicle_spec is None else vehicle_spec
        self.mount = Mount(scenario.agents.mount_xyz_m, scenario.agents.mount_pitch_deg)
        self.roadside = {unit.agent_id: unit for unit in place_roadside(scene, scenario.agents.roadside)}
        self.period_s = max(spec.period_s for spec in (self.vehicle_spec, *roadside_specs))
        self._visibility, self._threads = visibility, threads

    def margin(self, step_s: float) -> int:
        """Return the traffic steps of `step_s` that cover half the longest sweep, at least 1."""
        return max(1, math.ceil(0.5 * self.period_s / step_s - 1e-9))

    def carriers(self, actors: Actors, ego_id: int) -> tuple[int, ...]:
        """Return the connected vehicles of a drive whose future is unknown, ego first; see `nearest_agents`."""
        return tuple(nearest_agents(actors, self.scenario, ego_id))

    def frame(
        self,
        index: int,
        agents: Sequence[int],
        now: Actors,
        before: Actors | None = None,
        after: Actors | None = None,
        only_for: Mapping[int, Actors] | None = None,
    ) -> Frame:
        """Return the frame of one instant: sweeps of all agents and ground truth.

        Actors are rounded as in a log of the traffic, so that a replay gives the same frame.

        Args:
            index: number of the frame; it selects the random numbers.
            agents: ids of vehicles in `now` and of roadside units.
            before: actors `margin` steps earlier; left out: extrapolated.
            after: actors `margin` steps later; left out, as in a live simulation: extrapolated at constant velocity.
            only_for: false actors by the agent whose LiDAR alone measures them; they are no ground truth.
        """
        now = now.rounded()
        before = None if before is None else before.rounded()
        after = None if after is None else after.rounded()
        scene = self._scene(now, before, after)
        sensors = {agent_id: self._sensor(scene, now, agent_id, index) for agent_id in agents}
        scenes = {one: self._scene(_beside(now, false), before, after) for one, false in (only_for or {}).items()}
        honest = [agent_id for agent_id in sensors if agent_id not in scenes]
        sweeps = dict(zip(honest, self._scan(scene, [sensors[agent_id] for agent_id in honest]), strict=True))
        for agent_id in sensors.keys() & scenes.keys():
            (sweeps[agent_id],) = self._scan(scenes[agent_id], [sensors[agent_id]])
        ordered = tuple(self._agent_frame(now, agent_id, sweeps[agent_id]) for agent_id in agent_order(list(sensors)))
        near = _near_agents(now, ordered)
        truth = now.boxes[near]
        counts = [count_points(agent.sweep, truth.object_id) for agent in ordered]
        ordered_sensors = [sensors[agent.agent_id] for agent in ordered]
        unmeasured = np.zeros((0, 0), np.float32)
        frame = Frame(
            index=index,
            time_s=now.time_s,
            agents=ordered,
            truth=truth,
            velocity=now.velocity[near],
            points_on=np.stack(counts) if counts else np.zeros((0, len(truth)), np.int32),
            acceleration=now.acceleration[near],
            signals=now.signals[near],
            lane=tuple(now.lane[row] for row in np.flatnonzero(near)),
            # Drives of level worlds keep the bytes that they had before boxes had a tilt.
            tilt=np.column_stack([now.pitch, now.roll])[near] if self.scenario.uneven else np.zeros((0, 2)),
            visible_fraction=(
                visible_fraction(scene, ordered_sensors, truth.object_id) if self._visibility else unmeasured
            ),
        )
        return replace(frame, sight=lines_of_sight(scene, frame))

    def _scene(self, now: Actors, before: Actors | None, after: Actors | None) -> RayScene:
        if after is None and before is not None:
            after = _coasted(now, now.time_s - before.time_s).rounded()
        return self.scene.with_bodies(now, before, after, reach_s=0.5 * self.period_s)

    def _scan(self, scene: RayScene, sensors: list[Sensor]) -> list[Sweep]:
        return scan_all(scene, sensors, threads=self._threads)

    def _sensor(self, scene: RayScene, now: Actors, agent_id: int, index: int) -> Sensor:
        rng = random_generator(self.seed, Stream.LIDAR_NOISE, index, agent_id)
        if agent_id in self.roadside:
            return on_roadside(self.roadside[agent_id], now.time_s, rng)
        return on_vehicle(scene, now, agent_id, self.vehicle_spec, self.mount, rng)

    def _agent_frame(self, now: Actors, agent_id: int, sweep: Sweep) -> AgentFrame:
        if agent_id in self.roadside:
            return AgentFrame(agent_id, "roadside", self.roadside[agent_id].world_from_body, 0.0, sweep)
        row = now.row(agent_id)
        speed = float(np.linalg.norm(now.velocity[row]))
        return AgentFrame(agent_id, "vehicle", now.world_from_body()[row], speed, sweep)


def _coasted(now: Actors, ahead_s: float) -> Actors:
    """Return the actors `ahead_s` later at constant velocity."""
    center = now.boxes.center.copy()
    center[:, :2] += ahead_s * now.velocity
    return replace(now, time_s=now.time_s + ahead_s, boxes=replace(now.boxes, center=center))


def _beside(now: Actors, false: Actors) -> Actors:
    """Return the actors of an instant with false ones under new ids, higher than all others."""
    first = int(now.boxes.object_id.max(initial=0)) + 1
    boxes = replace(false.boxes, object_id=first + np.arange(len(false)))
    return now.joined(replace(false, time_s=now.time_s, boxes=boxes).rounded())


def _near_agents(now: Actors, agents: Sequence[AgentFrame]) -> NDArray[np.bool_]:
    """Return (N,) whether actors are within `TRUTH_RANGE_M` of any agent."""
    near = np.zeros(len(now), bool)
    for agent in agents:
        offset = now.boxes.center[:, :2] - agent.world_from_body[:2, 3]
        near |= np.hypot(offset[:, 0], offset[:, 1]) <= TRUTH_RANGE_M
    return near
