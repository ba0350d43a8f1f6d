"""Ground truth as a perception: of all road users nearby, or of those that the LiDARs can see."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.perception.senses import Senses
from dsrc.closed_loop.types import EgoState, Percept
from dsrc.faults.fault import Faults
from dsrc.messages.defences import Defence
from dsrc.messages.inbox import Inbox, Mail
from dsrc.messages.message import Message, Objects
from dsrc.messages.seen_space import SeenSpace, View, seen_of
from dsrc.ops.iou import bev_iou, rotated_nms
from sensors.corruptions import Condition
from sensors.frame import AgentFrame, Frame
from sensors.recording.encounter_check import UNSEEN_POINTS
from sim.boxes import concatenate
from sim.rows import stacked
from sim.scenario import Scenario
from sim.traffic.base import Actors

_OVERLAP = 0.1
"""Intersection over union from which on a told object is one that the ego knows of."""
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

    It does believe those of an attack, which are boxes: helpers tell it the true boxes of those that they see, and
    where they are themselves.

    Args:
        reach_m: range from the ego, m.
        least_points: of one LiDAR on a road user that is seen; as many as an encounter's proof denies the ego.
        cooperative: the helpers' LiDARs see too, without a radio between: the best that any sharing could give.
        faults: of the episode; attacks act here.
        defence: against them, see `dsrc.messages.defences`.
    """

    def __init__(
        self,
        reach_m: float = REACH_M,
        least_points: int = UNSEEN_POINTS,
        *,
        cooperative: bool = False,
        faults: Faults = (),
        defence: Defence = (),
    ) -> None:
        super().__init__(reach_m)
        self.least_points, self.cooperative, self.faults = least_points, cooperative, faults
        self._senses = Senses(Condition(), cooperative)
        self.defence, self._inbox = defence, Inbox(faults, defence)

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        super().reset(scenario, ego_id, seed)
        self._senses.reset(scenario, ego_id, seed)
        self._inbox.reset(seed, ego_id)

    def aim(self, ego: EgoState) -> None:
        """Tell attackers where the ego is and goes."""
        self._inbox.aim(ego.box, ego.route, ego.time_s)

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the other actors within reach and sight, with their ids and velocities."""
        near = super().perceive(before, now, claims)
        frame = self._senses.frame(before, now, {})
        agents = sorted(frame.agents, key=lambda agent: agent.agent_id != self._ego_id)
        if self._inbox.active:
            self._inbox.check(self._senses.agents[1:])
            own, *told = (self._message(agent, frame, near) for agent in agents)
            return _believed(near, self._inbox.read(own, told))
        seen = frame.truth.object_id[frame.points_on.max(axis=0) >= self.least_points]
        known = np.union1d(seen, self._senses.agents)  # helpers tell where they are
        rows = np.isin(now.boxes.object_id, np.intersect1d(near.boxes.object_id, known))
        return _percept(now, rows, seen_of([(agent, None) for agent in agents]))

    def _message(self, agent: AgentFrame, frame: Frame, near: Percept) -> Message:
        """Return what an agent tells of the road users near the ego."""
        points = frame.points_on[frame.agents.index(agent)]
        known = np.union1d(frame.truth.object_id[points >= self.least_points], [agent.agent_id])
        rows = np.isin(near.boxes.object_id, known)
        objects = Objects(near.boxes[rows], near.score[rows], near.velocity[rows])
        return Message.honest(agent.agent_id, near.time_s, agent.world_from_body, objects, partial(View.of, agent))


def _believed(near: Percept, mail: Mail) -> Percept:
    """Return the road users that messages tell of: the true ones among those near the ego once, false ones beside them.

    A told object that overlaps another one is the same.
    """
    objects = [one.objects[kept] for one, kept in zip(mail.messages, mail.kept, strict=True)]
    every = stacked(*objects)
    where = {object_id: row for row, object_id in enumerate(near.boxes.object_id.tolist())}
    rows = np.array([where.get(object_id, -1) for object_id in every.boxes.object_id.tolist()], np.int64)
    true = rows >= 0
    true[true] = (every.boxes.array[true] == near.boxes.array[rows[true]]).all(axis=1)
    known = np.unique(rows[true])
    boxes, others = near.boxes[known], every[~true]
    if len(others):
        apart = bev_iou(others.boxes.array, boxes.array).max(axis=1, initial=0.0) <= _OVERLAP
        others = others[apart]
        others = others[rotated_nms(others.boxes.array, others.score, _OVERLAP)]
    unknown = replace(others.boxes, object_id=np.full(len(others), -1, np.int64))
    return Percept(
        near.time_s,
        concatenate([boxes, unknown]),
        np.concatenate([near.score[known], others.score]),
        np.concatenate([near.velocity[known], others.velocity]),
        seen=mail.seen,
        told=mail.told,
    )


def _percept(now: Actors, rows: NDArray[np.bool_], seen: SeenSpace) -> Percept:
    """Return some actors as they are."""
    boxes = now.boxes[rows]
    return Percept(now.time_s, boxes, np.ones(len(boxes)), now.velocity[rows].copy(), seen=seen)
