"""Agents as drawn: thinned, coloured sweeps and communication links."""

import numpy as np
from numpy.typing import NDArray

from dsrc.review.palette import agent_color
from dsrc.review.points import point_colors, subsample
from dsrc.review.state import ReviewState
from dsrc.review.view import AgentView
from sensors.frame import Frame
from sim.geometry import invert

COMM_RANGE_M = 70.0
"""Communication range, m; the default of `make_sample`."""


def agent_view(
    frame: Frame, row: int, state: ReviewState, ego_id: int, review_from_world: NDArray[np.float64]
) -> AgentView:
    """View of the agent in a row of the frame under a state."""
    agent = frame.agents[row]
    visible = agent.agent_id not in state.hidden
    rows = subsample(agent.sweep, state.max_points if visible else 0)
    sweep = agent.sweep if len(rows) == len(agent.sweep) else agent.sweep[rows]
    body_from_lidar = invert(agent.world_from_body) @ agent.sweep.world_from_lidar
    rgb = agent_color(row)
    return AgentView(
        agent_id=agent.agent_id,
        kind=agent.kind,
        is_ego=agent.agent_id == ego_id,
        visible=visible,
        rgb=rgb,
        review_from_lidar=review_from_world @ agent.sweep.world_from_lidar,
        review_from_body=review_from_world @ agent.world_from_body,
        points=sweep.points,
        colors=point_colors(sweep, state.color_by, rgb, -float(body_from_lidar[2, 3])),
        total=len(agent.sweep),
        lost=agent.sweep.lost,
    )


def links(agents: tuple[AgentView, ...]) -> NDArray[np.float64]:
    """(K, 2, 3) lines from the ego's sensor to the sensors in communication range."""
    ego = next(agent for agent in agents if agent.is_ego).review_from_lidar[:3, 3]
    others = [agent.review_from_lidar[:3, 3] for agent in agents if not agent.is_ego]
    linked = [other for other in others if np.hypot(*(other - ego)[:2]) <= COMM_RANGE_M]
    return np.array([[ego, other] for other in linked], np.float64).reshape(-1, 2, 3)
