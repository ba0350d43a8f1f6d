"""Seen space: places where no road user can stand unseen, by the rays of the sweeps that arrived.

A ray ends at its return: between the sensor and there is nothing. Where it passes lower than `LOW_M` over the road, a
road user of that height would have stopped it, so these places are seen, whatever stands before or behind them: a ray
over the roof of a car sees the road behind it. Heights are those over the plane that the agent stands on. A sector is
seen as far as its neighbours are too, so that no place beside the edge of an occluder counts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sensors.frame import AgentFrame
from sim.geometry import Array, invert, transform_points

LOW_M = 1.0
"""Height of the lowest road user that cannot stand unseen in the seen space, m."""
REACH_M = 120.0

_SECTORS = 480
_OWN_M = 3
"""Distance from its LiDAR within which a vehicle sees everything: where its own body is, m."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Seen space of one agent: sectors around its LiDAR, in rings 1 m wide.

    Attributes:
        agent_id: of the agent.
        time_s: instant of its sweep, s.
        xy: (2,) place of its LiDAR, world frame, m.
        yaw: direction of the first sector's right edge, rad; sectors go counter-clockwise.
        seen: (A, R) sectors and rings that are seen.
    """

    agent_id: int
    time_s: float
    xy: Array
    yaw: float
    seen: NDArray[np.bool_]

    @classmethod
    def everything(cls, agent_id: int, time_s: float, xy: Array, reach_m: float) -> "View":
        """Return the view of an agent from whom nothing within reach is hidden."""
        return cls(agent_id, time_s, np.asarray(xy, np.float64), 0.0, np.ones((1, round(reach_m)), bool))

    @classmethod
    def of(cls, agent: AgentFrame, world_from_lidar: Array | None = None) -> "View":
        """Return what the sweep of an agent proves.

        Args:
            world_from_lidar: (4, 4) pose at which the sweep is believed to be measured; None for the true one.

        Raises:
            DataError: the points are raw and the sensor's path is unknown.
        """
        sweep = agent.sweep
        body_from_lidar = invert(agent.world_from_body) @ sweep.world_from_lidar
        believed = sweep.world_from_lidar if world_from_lidar is None else world_from_lidar
        world_from_body = believed @ invert(body_from_lidar)
        offset = body_from_lidar[:3, 3]
        points = transform_points(body_from_lidar, sweep.compensated_points) - [offset[0], offset[1], 0.0]
        yaw = float(np.arctan2(world_from_body[1, 0], world_from_body[0, 0]))
        sectors = _SECTORS if sweep.spec is None else min(_SECTORS, max(sweep.spec.columns // 2, 8))
        seen = _seen(points, float(offset[2]), sectors)
        seen[:, :_OWN_M] |= agent.kind == "vehicle"
        return cls(agent.agent_id, sweep.time_s, believed[:2, 3].copy(), yaw, seen)

    def sees(self, xy: Array) -> NDArray[np.bool_]:
        """Return (N,) whether (N, 2) places of the world, m, are seen."""
        dx, dy = (np.asarray(xy, np.float64) - self.xy).T
        sectors, rings = self.seen.shape
        turn = np.mod(np.arctan2(dy, dx) - self.yaw, 2.0 * np.pi) * (sectors / (2.0 * np.pi))
        ring = np.hypot(dx, dy).astype(np.int64)
        found = self.seen[np.minimum(turn.astype(np.int64), sectors - 1), np.minimum(ring, rings - 1)]
        return np.asarray(found & (ring < rings))


class SeenSpace:
    """Seen space of the ego and of the helpers whose messages arrived.

    Args:
        views: one function for each agent, ego first, that makes its view when it is first asked for: drivers that do
            not look pay nothing.
    """

    def __init__(self, views: Sequence[Callable[[], View]]) -> None:
        self._makers = views

    @cached_property
    def views(self) -> tuple[View, ...]:
        """Views of the agents, ego first."""
        return tuple(make() for make in self._makers)

    def sees(self, xy: Array) -> NDArray[np.bool_]:
        """Return (N,) whether any agent sees (N, 2) places of the world, m."""
        return np.isfinite(self.seen_s(xy))

    def seen_s(self, xy: Array) -> Array:
        """Return (N,) when (N, 2) places of the world, m, were last seen, s; -inf where nobody sees them.

        The age of a place is the present less that.
        """
        found = np.full(len(xy), -np.inf)
        for view in self.views:
            found = np.where(view.sees(xy), np.maximum(found, view.time_s), found)
        return found


def seen_of(agents: Sequence[tuple[AgentFrame, Array | None]]) -> SeenSpace:
    """Return the seen space of agents, ego first.

    Args:
        agents: each with the pose at which its sweep is believed to be measured, see `View.of`.
    """

    def maker(agent: AgentFrame, pose: Array | None) -> Callable[[], View]:
        return lambda: View.of(agent, pose)

    return SeenSpace([maker(agent, pose) for agent, pose in agents])


def _seen(points: Array, height_m: float, sectors: int) -> NDArray[np.bool_]:
    """Return (A, R) what rays from (0, 0, `height_m`) to (P, 3) points prove; z over the road."""
    rings = round(REACH_M)
    x, y, z = points.T
    end = np.hypot(x, y)
    # Along the ray the height is linear: where it falls below LOW_M, where it rises beyond.
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = end * (LOW_M - height_m) / (z - height_m)
    low_there = z <= LOW_M
    first = np.where(low_there, crosses if height_m > LOW_M else 0.0, 0.0)
    last = np.where(low_there, end, crosses if height_m <= LOW_M else 0.0)
    begin = np.ceil(np.clip(first, 0.0, rings)).astype(np.int64)
    stop = np.floor(np.clip(last, 0.0, rings)).astype(np.int64)
    proves = np.isfinite(first) & np.isfinite(last) & (stop > begin)
    sector = (np.mod(np.arctan2(y, x), 2.0 * np.pi) * (sectors / (2.0 * np.pi))).astype(np.int64) % sectors
    row = sector[proves] * (rings + 1)
    size = sectors * (rings + 1)
    change = np.bincount(row + begin[proves], minlength=size) - np.bincount(row + stop[proves], minlength=size)
    rays = np.cumsum(change.reshape(sectors, rings + 1), axis=1)[:, :-1]
    seen = rays > 0
    seen &= np.roll(seen, 1, axis=0) & np.roll(seen, -1, axis=0)
    return np.asarray(seen)
