"""Recording: synchronised frames of all agents with ground truth, made of the traffic of a drive.

The traffic of the whole drive is run first: then the agents can be chosen so that all of them have every frame, and
any frame can be made without the frames before it.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass

import trimesh

from sensors.frame import Frame, agent_order
from sensors.recording.agent_selection import choose_agents
from sensors.recording.overlaps import overlapping, without
from sensors.recording.rig import Rig
from sensors.scan.scene import BodyMesh, RayScene
from sim.errors import SettingsError
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import Actors, Traffic

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A drive whose traffic is known and whose frames are made on demand, in any order.

    Attributes:
        rig: LiDARs and static world.
        steps: actors at every traffic step, from the first frame to `margin` steps after the last.
        frame_steps: row in `steps` of each frame.
        margin: traffic steps that cover half a sweep.
        vehicles: connected vehicles, ego first.
    """

    rig: Rig
    steps: tuple[Actors, ...]
    frame_steps: tuple[int, ...]
    margin: int
    vehicles: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.frame_steps)

    @property
    def agent_ids(self) -> tuple[int, ...]:
        """Ids of the agents in the order of `Frame.agents`."""
        return tuple(agent_order([*self.vehicles, *self.rig.roadside]))

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def frame(self, index: int) -> Frame:
        """Return one frame; the same bytes whether or not others were made before."""
        step = self.frame_steps[index]
        before = self.steps[step - self.margin] if step >= self.margin else None
        after = self.steps[step + self.margin]
        return self.rig.frame(index, [*self.vehicles, *self.rig.roadside], self.steps[step], before, after)


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
    """Run the traffic of a whole drive and choose its agents; sweeps are cast when frames are requested.

    In a world of version 2 road users whose bodies overlap others' are left out of the whole drive, see
    `sensors.recording.overlaps`; those who drive behind them do so in the traffic all the same.

    Args:
        traffic: at the time of the first frame; it is stepped half a sweep beyond the last.
        world: static world in the world frame, None for an empty one.
        scenario: rule of the agents, area and roadside units.
        seed: of the choice of agents and of the sensors' noise.
        interval_s: time between frames, a multiple of the traffic's step.
        body_mesh: meshes of actors; left out: those of `sim.bodies.choice`.

    Raises:
        SettingsError: impossible number of frames or interval.
        ScenarioError: too few vehicles stay for the whole drive, or a LiDAR is unknown.
    """
    stride = _stride(traffic.step_s, interval_s, frames)
    rig = Rig(scenario, RayScene(world, body_mesh=body_mesh), seed, visibility=visibility, threads=threads)
    margin = rig.margin(traffic.step_s)
    # Rounded as in a log of the traffic, so that a replay chooses the same agents.
    steps = [traffic.actors.rounded()]
    steps.extend(traffic.step().rounded() for _ in range((frames - 1) * stride + margin))
    if scenario.uneven and scenario.conflict is None:  # whoever meets in an encounter stays
        gone = overlapping(steps, scenario.agents.named)
        steps = [without(actors, gone) for actors in steps]
    frame_steps = tuple(range(0, frames * stride, stride))
    rng = random_generator(seed, Stream.AGENT_SELECTION)
    vehicles = choose_agents([steps[row] for row in frame_steps], scenario, rng)
    log.info("drive of %d frames: vehicles %s, %d roadside units", frames, vehicles, len(rig.roadside))
    return Recording(rig, tuple(steps), frame_steps, margin, tuple(vehicles))


def _stride(step_s: float, interval_s: float, frames: int) -> int:
    if frames < 1:
        raise SettingsError(f"frames: expected at least 1, found {frames}")
    stride = round(interval_s / step_s) if math.isfinite(interval_s) else 0
    if stride < 1 or abs(stride * step_s - interval_s) > 1e-9:
        raise SettingsError(f"interval_s: expected a multiple of the traffic's step of {step_s} s, found {interval_s}")
    return stride
