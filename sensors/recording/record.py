"""Recording: traffic in, synchronised frames of all agents with ground truth out.

The traffic of the whole drive is run first: then the agents can be chosen so that all of them have every frame, and
any frame can be made without the frames before it.

Streams of randomness, all children of the drive's seed by spawn key:

| key                       | what                                             |
|---------------------------|--------------------------------------------------|
| (0,)                      | choice of the agents                             |
| (1, frame, agent mod 2^32)| noise and drop-off of one agent's sweep          |
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from sensors.frame import AgentFrame, Frame, agent_order, count_points
from sensors.presets import scenario_lidars
from sensors.recording.agent_selection import choose_agents
from sensors.recording.mounting import ON_ROOF, Mount, Roadside, on_roadside, on_vehicle, place_roadside
from sensors.scan.lidar import scan_all
from sensors.scan.line_of_sight import lines_of_sight
from sensors.scan.scene import BodyMesh, RayScene
from sensors.scan.visibility import visible_fraction
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.errors import SettingsError
from sim.scenario import Scenario
from sim.traffic.base import Actors, Traffic

log = logging.getLogger(__name__)

TRUTH_RANGE_M = 150.0
"""Ground truth holds the actors within this distance of any agent."""

_AGENT_STREAM, _SWEEP_STREAM = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A drive whose traffic is known and whose frames are made on demand, in any order.

    Attributes:
        scene: the static world.
        steps: the actors at every traffic step, from the first frame to `margin` steps after the last.
        frame_steps: for each frame its row in `steps`.
        margin: traffic steps that cover half a sweep.
        vehicles: connected vehicles, ego first.
        roadside: roadside units.
        vehicle_spec: sensor of the vehicles.
        seed: of noise and drop-off.
        visibility: whether frames tell visible fractions.
        vehicle_mount: where the vehicles' sensors sit.
        threads: see `sensors.scan.lidar.scan_all`.
    """

    scene: RayScene
    steps: tuple[Actors, ...]
    frame_steps: tuple[int, ...]
    margin: int
    vehicles: tuple[int, ...]
    roadside: tuple[Roadside, ...]
    vehicle_spec: LidarSpec
    seed: int
    visibility: bool = True
    vehicle_mount: Mount = ON_ROOF
    threads: int | None = None

    def __len__(self) -> int:
        return len(self.frame_steps)

    @property
    def agent_ids(self) -> tuple[int, ...]:
        """Ids of the agents in the order of `Frame.agents`."""
        return tuple(agent_order([*self.vehicles, *(unit.agent_id for unit in self.roadside)]))

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def frame(self, index: int) -> Frame:
        """Make one frame; the same bytes whether or not others were made before."""
        step = self.frame_steps[index]
        now = self.steps[step]
        before = self.steps[step - self.margin] if step >= self.margin else None
        after = self.steps[step + self.margin] if step + self.margin < len(self.steps) else None
        return make_frame(
            self.scene,
            now,
            before,
            after,
            vehicles=self.vehicles,
            vehicle_spec=self.vehicle_spec,
            roadside=self.roadside,
            seed=self.seed,
            index=index,
            visibility=self.visibility,
            vehicle_mount=self.vehicle_mount,
            threads=self.threads,
        )


def simulate(
    traffic: Traffic,
    world: trimesh.Trimesh | None,
    scenario: Scenario,
    seed: int,
    frames: int,
    interval_s: float = 0.1,
    *,
    start: int = 0,
) -> Iterator[Frame]:
    """Run the traffic of a drive and yield its frames from number `start` on; see `record`."""
    recording = record(traffic, world, scenario, seed, frames, interval_s)
    return (recording.frame(index) for index in range(start, len(recording)))


def record(
    traffic: Traffic,
    world: trimesh.Trimesh | None,
    scenario: Scenario,
    seed: int,
    frames: int,
    interval_s: float = 0.1,
    *,
    body_mesh: BodyMesh | None = None,
    visibility: bool = True,
    threads: int | None = None,
) -> Recording:
    """Run the traffic of a whole drive and choose its agents; sweeps are cast when frames are asked for.

    Args:
        traffic: at the time of the first frame; it is stepped half a sweep beyond the last.
        world: static world in the world frame, None for one without any.
        scenario: gives agents, area and roadside units.
        seed: of the choice of agents and of the sensors' noise.
        frames: number of frames.
        interval_s: time between frames, a multiple of the traffic's step.
        body_mesh: meshes of actors; those of `sim.bodies.choice` when left out.
        visibility: measure visible fractions.
        threads: see `sensors.scan.lidar.scan_all`.

    Raises:
        SettingsError: a number of frames or an interval that cannot be.
        ScenarioError: too few vehicles stay for the whole drive, or a LiDAR is not known.
    """
    stride = _stride(traffic.step_s, interval_s, frames)
    vehicle_spec, roadside_specs = scenario_lidars(scenario)
    longest_s = max(spec.period_s for spec in (vehicle_spec, *roadside_specs))
    margin = max(1, math.ceil(0.5 * longest_s / traffic.step_s - 1e-9))
    # Rounded as a log of the traffic has them: a replay gives the same frames.
    steps = [traffic.actors.rounded()]
    steps.extend(traffic.step().rounded() for _ in range((frames - 1) * stride + margin))
    frame_steps = tuple(range(0, frames * stride, stride))
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_AGENT_STREAM,)))
    vehicles = choose_agents([steps[row] for row in frame_steps], scenario, rng)
    log.info("drive of %d frames: vehicles %s, %d roadside units", frames, vehicles, len(scenario.agents.roadside))
    scene = RayScene(world, body_mesh=body_mesh)
    return Recording(
        scene=scene,
        steps=tuple(steps),
        frame_steps=frame_steps,
        margin=margin,
        vehicles=tuple(vehicles),
        roadside=place_roadside(scene, scenario.agents.roadside),
        vehicle_spec=vehicle_spec,
        seed=seed,
        visibility=visibility,
        vehicle_mount=Mount(scenario.agents.mount_xyz_m, scenario.agents.mount_pitch_deg),
        threads=threads,
    )


def make_frame(
    scene: RayScene,
    now: Actors,
    before: Actors | None = None,
    after: Actors | None = None,
    *,
    vehicles: Sequence[int],
    vehicle_spec: LidarSpec,
    roadside: Sequence[Roadside] = (),
    seed: int,
    index: int,
    visibility: bool = True,
    vehicle_mount: Mount = ON_ROOF,
    threads: int | None = None,
) -> Frame:
    """Scan one instant by all agents; a live simulation, which has no `after` yet, may leave it out.

    With `visibility` the frame tells visible fractions too, see `sensors.scan.visibility`.
    """
    specs = [vehicle_spec, *(unit.spec for unit in roadside)]
    scene = scene.with_bodies(now, before, after, reach_s=0.5 * max(spec.period_s for spec in specs))
    sensors = {
        agent_id: on_vehicle(scene, now, agent_id, vehicle_spec, vehicle_mount, _sweep_rng(seed, index, agent_id))
        for agent_id in vehicles
    }
    sensors |= {
        unit.agent_id: on_roadside(unit, now.time_s, _sweep_rng(seed, index, unit.agent_id)) for unit in roadside
    }
    sweeps = dict(zip(sensors, scan_all(scene, list(sensors.values()), threads=threads), strict=True))
    bodies = {unit.agent_id: unit.world_from_body for unit in roadside}
    ordered = tuple(
        _roadside_frame(agent_id, bodies[agent_id], sweeps[agent_id])
        if agent_id in bodies
        else _vehicle_frame(now, agent_id, sweeps[agent_id])
        for agent_id in agent_order(list(sensors))
    )
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
        visible_fraction=visible_fraction(scene, ordered_sensors, truth.object_id) if visibility else unmeasured,
    )
    return replace(frame, sight=lines_of_sight(scene, frame))


def _vehicle_frame(now: Actors, agent_id: int, sweep: Sweep) -> AgentFrame:
    row = now.row(agent_id)
    speed = float(np.linalg.norm(now.velocity[row]))
    return AgentFrame(agent_id, "vehicle", now.world_from_body()[row], speed, sweep)


def _roadside_frame(agent_id: int, world_from_body: NDArray[np.float64], sweep: Sweep) -> AgentFrame:
    return AgentFrame(agent_id, "roadside", world_from_body, 0.0, sweep)


def _near_agents(now: Actors, agents: Sequence[AgentFrame]) -> NDArray[np.bool_]:
    """Return (N,) whether actors are within `TRUTH_RANGE_M` of any agent."""
    near = np.zeros(len(now), bool)
    for agent in agents:
        offset = now.boxes.center[:, :2] - agent.world_from_body[:2, 3]
        near |= np.hypot(offset[:, 0], offset[:, 1]) <= TRUTH_RANGE_M
    return near


def _sweep_rng(seed: int, index: int, agent_id: int) -> np.random.Generator:
    key = (_SWEEP_STREAM, index, agent_id % 2**32)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def _stride(step_s: float, interval_s: float, frames: int) -> int:
    """Return the traffic steps per frame."""
    if frames < 1:
        raise SettingsError(f"frames: expected at least 1, found {frames}")
    stride = round(interval_s / step_s) if math.isfinite(interval_s) else 0
    if stride < 1 or abs(stride * step_s - interval_s) > 1e-9:
        raise SettingsError(f"interval_s: expected a multiple of the traffic's step of {step_s} s, found {interval_s}")
    return stride
