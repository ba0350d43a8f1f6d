"""Camera poses: overview, chase and bird's eye, and the frame of the scene in which the camera stands still.

The browser reports the pose of its camera late. A camera that is moved with the ego would therefore be set back to
where it was, again and again; here the world moves instead, and the camera is the user's alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.review.state import Camera
from dsrc.review.view import FrameView
from sim.geometry import invert, pose_angles, pose_matrix

FOV_RAD = 0.9
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Pose of a camera: (3,) position, (3,) point looked at and (3,) up direction."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    up: NDArray[np.float64]

    def moved(self, transform: NDArray[np.float64]) -> "CameraPose":
        """Pose after a (4, 4) transform that keeps the vertical."""
        turn, shift = transform[:3, :3], transform[:3, 3]
        return CameraPose(turn @ self.position + shift, turn @ self.look_at + shift, self.up)


def _heading(view: FrameView) -> tuple[NDArray[np.float64], float]:
    """Position (3,) of the ego and its yaw, review frame."""
    body = view.ego.review_from_body
    return body[:3, 3], float(pose_angles(body)[0])


def scene_from_review(camera: Camera, view: FrameView) -> NDArray[np.float64]:
    """(4, 4) pose of the review frame in the scene, whose camera stands still.

    The scene is the review frame for a free camera, the ego's planar frame for one that chases it, and a frame at the
    ego that does not turn for one above it.
    """
    if camera == "free":
        return np.eye(4)
    place, yaw = _heading(view)
    return invert(np.asarray(pose_matrix(place, yaw if camera == "chase" else 0.0), np.float64))


def chase(view: FrameView, distance_m: float = 34.0, height_m: float = 21.0, ahead_m: float = 14.0) -> CameraPose:
    """Pose behind and above the ego, looking ahead of it, review frame."""
    place, yaw = _heading(view)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return CameraPose(place - distance_m * forward + height_m * UP, place + ahead_m * forward, UP)


def birds_eye(view: FrameView, height_m: float = 110.0) -> CameraPose:
    """Pose above the ego, its heading upwards on the screen, review frame.

    The viewer has perspective cameras that orbit about an up direction: a small tilt keeps that defined.
    """
    place, yaw = _heading(view)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return CameraPose(place + height_m * UP - 0.02 * height_m * forward, place, UP)


def overview(view: FrameView) -> CameraPose:
    """Pose of the start: high and to the side, with the cooperating agents in view, review frame."""
    place, yaw = _heading(view)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    agents = np.array([agent.review_from_body[:3, 3] for agent in view.agents])
    near = agents[np.linalg.norm((agents - place)[:, :2], axis=1) < 80.0]
    middle = 0.5 * (place + near.mean(axis=0))
    spread = float(np.clip(np.linalg.norm((near - middle)[:, :2], axis=1).max(initial=0.0), 22.0, 50.0))
    left = np.array([-forward[1], forward[0], 0.0])
    return CameraPose(middle + spread * (-1.5 * forward + 0.6 * left + 1.15 * UP), middle + 0.15 * spread * forward, UP)


def close_to(target: NDArray[np.float64], pose: CameraPose, distance_m: float = 24.0) -> CameraPose:
    """Pose that looks at a point (3,) from the side of an earlier pose, at a distance and from above."""
    away = (pose.position - target)[:2]
    length = float(np.hypot(*away))
    side = away / length if length > 1.0 else np.array([-1.0, 0.0])
    return CameraPose(target + distance_m * np.array([0.8 * side[0], 0.8 * side[1], 0.6]), target, UP)
