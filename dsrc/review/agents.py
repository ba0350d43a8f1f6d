"""Agents as drawn: thinned, coloured sweeps, communication links, and what each of them helped to find."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import COMM_RANGE_M
from dsrc.evaluation.sharing.stored import SharedFrame
from dsrc.review.palette import FATE_NAMES, agent_color
from dsrc.review.points import lost_rows, point_colors, subsample
from dsrc.review.state import ReviewState
from dsrc.review.view import AgentShare, AgentView, DetectionDetails, HelpView, ObjectDetails
from sensors.frame import Frame
from sensors.sweep import SCATTERED, Sweep
from sim.boxes import Boxes
from sim.geometry import invert, transform_points

HARM = 0.05
"""Score that an agent takes from a box to count as harm: every message moves scores a little."""
_SAME_M = 0.05
"""Distance at which two detections are one: shares are stored in millimetres, and computed on one thread."""


def agent_view(
    frame: Frame,
    row: int,
    state: ReviewState,
    ego_id: int,
    review_from_world: NDArray[np.float64],
    recorded: Frame | None = None,
) -> AgentView:
    """View of an agent.

    Args:
        row: of the agent in the frame.
        recorded: the frame before the corruption, to show what that removed; left out: nothing is.
    """
    agent = frame.agents[row]
    visible = agent.agent_id not in state.hidden
    rows = subsample(agent.sweep, state.max_points if visible else 0)
    made = 0
    if state.color_by in ("verdict", "agent") and agent.sweep.fate.any():
        of_corruption = agent.sweep.fate.take(rows) == SCATTERED
        rows, made = rows[np.argsort(of_corruption, kind="stable")], int(of_corruption.sum())
    drawn = None if len(rows) == len(agent.sweep) and made == 0 else rows
    body_from_lidar = invert(agent.world_from_body) @ agent.sweep.world_from_lidar
    lost_points = np.zeros((0, 3), np.float32)
    if recorded is not None and visible and agent.sweep is not recorded.agents[row].sweep:
        lost_points = _lost_points(recorded.agents[row].sweep, agent.sweep, state.max_points)
    rgb, fate = agent_color(row), agent.sweep.fate
    # As recorded all are untouched; counting that in every frame takes time.
    fates = np.bincount(fate, minlength=len(FATE_NAMES)) if fate.any() else [len(fate), *[0] * (len(FATE_NAMES) - 1)]
    return AgentView(
        agent_id=agent.agent_id,
        kind=agent.kind,
        is_ego=agent.agent_id == ego_id,
        visible=visible,
        rgb=rgb,
        review_from_lidar=review_from_world @ agent.sweep.world_from_lidar,
        review_from_body=review_from_world @ agent.world_from_body,
        points=agent.sweep.points if drawn is None else agent.sweep.points.take(drawn, axis=0),
        colors=point_colors(agent.sweep, state.color_by, rgb, body_from_lidar[2], drawn, state.theme),
        total=len(agent.sweep),
        speed=agent.speed,
        lost=agent.sweep.lost,
        fates=tuple(map(int, fates)),
        made=made,
        lost_points=lost_points,
    )


def _lost_points(recorded: Sweep, corrupted: Sweep, max_points: int) -> NDArray[np.float32]:
    """(L, 3) points that a corruption removed, at most `max_points`, in the frame of the corrupted sweep."""
    gone = recorded[lost_rows(recorded, corrupted)]
    gone = gone[subsample(gone, max_points)]
    if np.array_equal(recorded.world_from_lidar, corrupted.world_from_lidar):
        return gone.points
    moved = invert(corrupted.world_from_lidar) @ recorded.world_from_lidar
    return np.asarray(transform_points(moved, gone.points), np.float32)


def links(agents: tuple[AgentView, ...]) -> NDArray[np.float64]:
    """(K, 2, 3) lines from the ego's sensor to the sensors in communication range."""
    ego = next(agent for agent in agents if agent.is_ego).review_from_lidar[:3, 3]
    others = [agent.review_from_lidar[:3, 3] for agent in agents if not agent.is_ego]
    linked = [other for other in others if np.hypot(*(other - ego)[:2]) <= COMM_RANGE_M]
    return np.array([[ego, other] for other in linked], np.float64).reshape(-1, 2, 3)


def help_view(shared: SharedFrame, agent_ids: Sequence[int], review_from_lidar: NDArray[np.float64]) -> HelpView:
    """Boxes of a frame by the agent to whom most of their score is due.

    Args:
        agent_ids: agents of the frame, in its order.
        review_from_lidar: (4, 4) of the ego's LiDAR.
    """
    ids = [one.object_id for one in shared.boxes]
    boxes = Boxes.from_array([one.box for one in shared.boxes], object_id=ids).transform(review_from_lidar)
    true, found = np.array(ids, np.int64) != -1, np.array([one.team > 0.0 for one in shared.boxes], bool)
    owner = np.array([max(one.share, key=one.share.__getitem__) for one in shared.boxes], np.int64)
    harmed = np.array([min(one.share.values()) <= -HARM for one in shared.boxes], bool)
    return HelpView(
        found=tuple(boxes[true & found & (owner == agent)] for agent in agent_ids),
        made=tuple(boxes[~true & (owner == agent)] for agent in agent_ids),
        missed=boxes[true & ~found],
        harmed=boxes[true & harmed],
    )


def with_shares(
    details: ObjectDetails | DetectionDetails,
    shared: SharedFrame,
    titles: Mapping[int, str],
    place: NDArray[np.floating] | None,
) -> ObjectDetails | DetectionDetails:
    """Details of an object or a detection with the agents' shares in it, where these are known.

    Args:
        titles: displayed names by agent, in the order of the frame.
        place: (3,) centre of a detection in the ego LiDAR's frame, m; None for an object.
    """
    hit = isinstance(details, ObjectDetails) or details.verdict == "true"
    for one in shared.boxes:
        near = place is not None and one.object_id == -1 and np.hypot(*(place[:2] - one.box[:2])) < _SAME_M
        if one.object_id == details.object_id if hit else near:
            ego_first = sorted(filter(one.share.__contains__, titles), key=lambda i: i != shared.ego_id)
            shares = (AgentShare(titles[i], one.share[i], one.without[i]) for i in ego_first)
            return replace(details, shares=tuple(shares))
    return details
