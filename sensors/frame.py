"""AgentFrame and Frame: one synchronised instant of all agents with its ground truth."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import Sweep
from sim.boxes import Boxes

AgentKind = Literal["vehicle", "roadside"]


@dataclass(frozen=True, slots=True, eq=False)
class AgentFrame:
    """What one agent knows at one instant.

    Attributes:
        agent_id: the object id of a vehicle; negative for a roadside unit.
        kind: `vehicle` or `roadside`.
        world_from_body: (4, 4) float64; the body frame's origin is the centre of the footprint at road level.
        speed: m/s.
        sweep: its LiDAR sweep.
    """

    agent_id: int
    kind: AgentKind
    world_from_body: NDArray[np.float64]
    speed: float
    sweep: Sweep


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Everything at one instant: the unit of storage, training, evaluation and review.

    Attributes:
        index: number of the frame in its drive.
        time_s: simulation time, s.
        agents: A agents, in order of their id as text (the order of their folders), roadside units last.
        truth: N ground-truth boxes in the world frame, agents' own bodies included, rows sorted by object id.
        velocity: (N, 2) float64 ground-truth velocity in the world, m/s.
        points_on: (A, N) int32 LiDAR points that each agent has on each object.
    """

    index: int
    time_s: float
    agents: tuple[AgentFrame, ...]
    truth: Boxes
    velocity: NDArray[np.float64]
    points_on: NDArray[np.int32]

    def __post_init__(self) -> None:
        n = len(self.truth)
        if self.velocity.shape != (n, 2):
            raise ValueError(f"Frame.velocity must have shape ({n}, 2), got {self.velocity.shape}")
        if self.points_on.shape != (len(self.agents), n):
            raise ValueError(f"Frame.points_on must have shape ({len(self.agents)}, {n}), got {self.points_on.shape}")

    def agent(self, agent_id: int) -> AgentFrame:
        """Return the agent of this id; KeyError when there is none."""
        for agent in self.agents:
            if agent.agent_id == agent_id:
                return agent
        raise KeyError(agent_id)

    def with_sweeps(self, sweeps: list[Sweep]) -> "Frame":
        """Return the frame with the agents' sweeps replaced, in order; ground truth and counts stay."""
        agents = tuple(replace(a, sweep=s) for a, s in zip(self.agents, sweeps, strict=True))
        return replace(self, agents=agents)


def agent_order(agent_ids: list[int]) -> list[int]:
    """Sort agents as the OPV2V tools do: by folder name as text, roadside units (negative) last."""
    return sorted(agent_ids, key=lambda a: (a < 0, str(a)))


def count_points(sweep: Sweep, object_ids: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return (N,) points of the sweep on each object of `object_ids` (N, sorted ascending)."""
    if len(object_ids) == 0:
        return np.zeros(0, np.int32)
    slot = np.searchsorted(object_ids, sweep.object_id)
    slot[slot == len(object_ids)] = 0
    hit = object_ids[slot] == sweep.object_id
    return np.bincount(slot[hit], minlength=len(object_ids)).astype(np.int32)
