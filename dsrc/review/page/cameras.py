"""Camera poses: overview, chase and bird's eye, and motion with the ego."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.review.view import FrameView
from sim.geometry import pose_angles

FOV_RAD = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Pose of a camera: (3,) position, (3,) point looked at and (3,) up direction, review frame."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    up: NDArray[np.float64]


def _heading(view: FrameView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Position (3,) of the ego and its heading (3,) in the plane."""
    body = view.ego.review_from_body
    yaw = float(pose_angles(body)[0])
    return body[:3, 3], np.array([np.cos(yaw), np.sin(yaw), 0.0])


def chase(view: FrameView, distance_m: float = 34.0, height_m: float = 21.0, ahead_m: float = 14.0) -> CameraPose:
    """Pose behind and above the ego, looking ahead of it."""
    place, forward = _heading(view)
    up = np.array([0.0, 0.0, 1.0])
    return CameraPose(place - distance_m * forward + height_m * up, place + ahead_m * forward, up)


def birds_eye(view: FrameView, height_m: float = 110.0) -> CameraPose:
    """Pose above the ego, its heading upwards on the screen.

    The viewer has perspective cameras that orbit about an up direction: a small tilt keeps that defined.
    """
    place, forward = _heading(view)
    up = np.array([0.0, 0.0, 1.0])
    return CameraPose(place + height_m * up - 0.02 * height_m * forward, place, up)


def overview(view: FrameView) -> CameraPose:
    """Pose of the start: high and to the side, with the cooperating agents in view."""
    place, forward = _heading(view)
    agents = np.array([agent.review_from_body[:3, 3] for agent in view.agents])
    near = agents[np.linalg.norm((agents - place)[:, :2], axis=1) < 80.0]
    middle = 0.5 * (place + near.mean(axis=0))
    spread = float(np.clip(np.linalg.norm((near - middle)[:, :2], axis=1).max(initial=0.0), 22.0, 50.0))
    left = np.array([-forward[1], forward[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return CameraPose(middle + spread * (-1.5 * forward + 0.6 * left + 1.15 * up), middle + 0.15 * spread * forward, up)


def followed(position: NDArray[np.float64], before: FrameView, after: FrameView, turn: bool) -> NDArray[np.float64]:
    """Point moved with the ego from one frame to another.

    Args:
        position: (3,) review frame.
        before: frame of the given point.
        after: frame of the returned point.
        turn: turn it with the ego's heading too.
    """
    place, forward = _heading(before)
    new_place, new_forward = _heading(after)
    offset = position - place
    if turn:
        cos = float(forward @ new_forward)
        sin = float(forward[0] * new_forward[1] - forward[1] * new_forward[0])
        offset = np.array([cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1], offset[2]])
    return new_place + offset
