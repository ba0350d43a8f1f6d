"""AgentFrame and Frame: one synchronised instant of all agents with its ground truth."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import Sweep
from sim.boxes import Boxes

AgentKind = Literal["vehicle", "roadside"]

BY_EGO, BY_HELPER, BY_NOBODY = range(3)
"""Values of `Frame.seen_by`."""


@dataclass(frozen=True, slots=True, eq=False)
class AgentFrame:
    """One agent at one instant: pose, speed and sweep.

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
    """One instant of all agents with ground truth: the unit of storage, training, evaluation and review.

    Attributes:
        index: number of the frame in its drive.
        time_s: simulation time, s.
        agents: A agents, in order of their id as text (the order of their folders), roadside units last.
        truth: N ground-truth boxes in the world frame, agents' own bodies included, rows sorted by object id.
        velocity: (N, 2) float64 ground-truth velocity in the world, m/s.
        points_on: (A, N) int32 LiDAR points that each agent has on each object.
        acceleration: (N, 2) float64 in the world, m/s2; NaN where unknown.
        signals: (N,) int32 lights, bits of `sim.traffic.base.SIGNALS`; 0 where unknown.
        lane: (N,) names of lanes in the road network; "" off the lanes and where unknown.
        visible_fraction: (A, N) float32 share of an agent's rays on an object that nothing else blocks, see
            `sensors.scan.visibility`; NaN where not measured, for an agent's own body, and where no ray would hit even
            the object alone.
        sight: (A, A) int8 `sim.radio.Obstruction` between the agents' antennas; -1 where unknown.

    The last five may be left out: unknown.
    """

    index: int
    time_s: float
    agents: tuple[AgentFrame, ...]
    truth: Boxes
    velocity: NDArray[np.float64]
    points_on: NDArray[np.int32]
    acceleration: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    signals: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    lane: tuple[str, ...] = ()
    visible_fraction: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    sight: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, 0), np.int8))

    def __post_init__(self) -> None:
        agents, n = len(self.agents), len(self.truth)
        unknown: dict[str, Any] = {
            "acceleration": np.full((n, 2), np.nan),
            "signals": np.zeros(n, np.int32),
            "lane": ("",) * n,
            "visible_fraction": np.full((agents, n), np.nan, np.float32),
            "sight": np.full((agents, agents), -1, np.int8),
        }
        for name, value in unknown.items():
            if np.size(getattr(self, name)) == 0:
                object.__setattr__(self, name, value)
        shapes = {
            "velocity": (n, 2),
            "points_on": (agents, n),
            "acceleration": (n, 2),
            "signals": (n,),
            "lane": (n,),
            "visible_fraction": (agents, n),
            "sight": (agents, agents),
        }
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ValueError(f"Frame.{name} must have shape {shape}, got {found}")

    def agent(self, agent_id: int) -> AgentFrame:
        """Return the agent of this id; KeyError when missing."""
        for agent in self.agents:
            if agent.agent_id == agent_id:
                return agent
        raise KeyError(agent_id)

    def seen_by(self, ego_id: int, points: int = 1) -> NDArray[np.uint8]:
        """Return (N,) observers of the objects: `BY_EGO`, `BY_HELPER` (another agent, not the ego) or `BY_NOBODY`.

        Args:
            ego_id: one of the agents; KeyError for any other id.
            points: least number of points on an object for an agent to see it. Counts are those of the recorded
                sweeps, before any corruption.
        """
        enough = self.points_on >= points
        row = self.agents.index(self.agent(ego_id))
        seen = np.full(len(self.truth), BY_NOBODY, np.uint8)
        seen[enough.any(axis=0)] = BY_HELPER
        seen[enough[row]] = BY_EGO
        return seen

    def of_agents(self, rows: list[int]) -> "Frame":
        """Return the frame with some of its agents, by their rows; all ground truth stays."""
        return replace(
            self,
            agents=tuple(self.agents[row] for row in rows),
            points_on=self.points_on[rows],
            visible_fraction=self.visible_fraction[rows],
            sight=self.sight[rows][:, rows],
        )

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
