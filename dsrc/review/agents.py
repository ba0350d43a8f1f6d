"""Agents as drawn: thinned, coloured sweeps and communication links."""

import numpy as np
from numpy.typing import NDArray

from dsrc.review.labs.lost import lost_rows
from dsrc.review.palette import FATE_NAMES, agent_color
from dsrc.review.points import point_colors, subsample
from dsrc.review.state import ReviewState
from dsrc.review.view import AgentView
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.geometry import invert, transform_points

COMM_RANGE_M = 70.0
"""Communication range, m; the default of `make_sample`."""


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
        frame: as shown.
        row: of the agent in the frame.
        state: of the page.
        ego_id: agent that detects.
        review_from_world: (4, 4).
        recorded: the frame before the corruption, to show what that removed; left out: nothing is.
    """
    agent = frame.agents[row]
    visible = agent.agent_id not in state.hidden
    rows = subsample(agent.sweep, state.max_points if visible else 0)
    drawn = None if len(rows) == len(agent.sweep) else rows
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
        colors=point_colors(agent.sweep, state.color_by, rgb, body_from_lidar[2], drawn),
        total=len(agent.sweep),
        lost=agent.sweep.lost,
        fates=tuple(map(int, fates)),
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
