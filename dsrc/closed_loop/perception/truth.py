"""Ground truth as a perception: of all road users nearby, or of those that the LiDARs can see."""

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.perception.senses import Senses
from dsrc.closed_loop.seen_space import SeenSpace, View, seen_of
from dsrc.closed_loop.types import Percept
from sensors.corruptions import Condition
from sensors.recording.encounter_check import UNSEEN_POINTS
from sim.scenario import Scenario
from sim.traffic.base import Actors

REACH_M = 150.0
"""Range of the truth, m: overtaking needs to see 4 s ahead at a closing speed of up to 44 m/s, with 70 m it crashes."""


class TruthPerception:
    """Ground truth of the road users near the ego; it has no helpers, hence hears no lie.

    Args:
        reach_m: range, m.
    """

    cooperative = False

    def __init__(self, reach_m: float = REACH_M) -> None:
        self.reach_m = reach_m

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self._ego_id = ego_id

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return all other actors within reach, with their ids and velocities."""
        ego = now.boxes.center[now.row(self._ego_id), :2]
        near = np.linalg.norm(now.boxes.center[:, :2] - ego, axis=1) <= self.reach_m
        view = View.everything(self._ego_id, now.time_s, ego, self.reach_m)
        return _percept(now, near & (now.boxes.object_id != self._ego_id), SeenSpace([lambda: view]))


class SightPerception(TruthPerception):
    """Ground truth of the road users on which a LiDAR has points now: a perfect detector, which believes no lie.

    Args:
        reach_m: range from the ego, m.
        least_points: of one LiDAR on a road user that is seen; as many as an encounter's proof denies the ego.
        cooperative: the helpers' LiDARs see too, without a radio between: the best that any sharing could give.
    """

    def __init__(
        self, reach_m: float = REACH_M, least_points: int = UNSEEN_POINTS, *, cooperative: bool = False
    ) -> None:
        super().__init__(reach_m)
        self.least_points, self.cooperative = least_points, cooperative
        self._senses = Senses(Condition(), cooperative)

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        super().reset(scenario, ego_id, seed)
        self._senses.reset(scenario, ego_id, seed)

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the other actors within reach and sight, with their ids and velocities."""
        near = super().perceive(before, now, claims)
        frame = self._senses.frame(before, now, {})
        seen = frame.truth.object_id[frame.points_on.max(axis=0) >= self.least_points]
        known = np.union1d(seen, self._senses.agents)  # helpers tell where they are
        rows = np.isin(now.boxes.object_id, np.intersect1d(near.boxes.object_id, known))
        agents = sorted(frame.agents, key=lambda agent: agent.agent_id != self._ego_id)
        return _percept(now, rows, seen_of([(agent, None) for agent in agents]))


def _percept(now: Actors, rows: NDArray[np.bool_], seen: SeenSpace) -> Percept:
    """Return some actors as they are."""
    boxes = now.boxes[rows]
    return Percept(now.time_s, boxes, np.ones(len(boxes)), now.velocity[rows].copy(), seen=seen)
