"""Camera of a browser, its poses, and the frame of the scene in which it stands still.

The browser reports the pose of its camera late. A camera that is moved with the ego would therefore be set back to
where it was, again and again; here the world moves instead, and the camera is the user's alone.
"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from dsrc.review.state import Camera, Follow, ReviewState
from dsrc.review.view import SELECTED, FrameView
from sim.geometry import invert, pose_angles, pose_matrix

FOV_RAD = 0.9
UP = np.array([0.0, 0.0, 1.0])
LATE_S = 5.0
"""Longest time after which a browser still reports poses of its own from before the one that it was given, s."""
_REMEMBERED = 200


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


def _heading(view: FrameView, follow: Follow = "ego") -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Position (3,) of what is followed, its yaw and the (3,) direction ahead, review frame."""
    body, boxes = view.ego.review_from_body, view.layers[SELECTED]
    place, yaw = body[:3, 3], float(pose_angles(body)[0])
    if follow == "selected" and len(boxes):
        place, yaw = boxes.center[0] - [0.0, 0.0, 0.5 * boxes.size[0, 2]], float(boxes.yaw[0])
    return place, yaw, np.array([np.cos(yaw), np.sin(yaw), 0.0])


def scene_from_review(camera: Camera, view: FrameView, follow: Follow = "ego") -> NDArray[np.float64]:
    """(4, 4) pose of the review frame in the scene, whose camera stands still.

    The scene is the review frame for a free camera, the planar frame of the ego, or of the selected box, for one that
    chases it, and a frame there that does not turn for one above it.
    """
    if camera == "free":
        return np.eye(4)
    place, yaw, _ = _heading(view, follow)
    return invert(np.asarray(pose_matrix(place, yaw if camera == "chase" else 0.0), np.float64))


def chase(view: FrameView, follow: Follow = "ego") -> CameraPose:
    """Pose behind and above what is followed, looking ahead of it, review frame."""
    distance_m, height_m, ahead_m = 34.0, 21.0, 14.0
    place, _, forward = _heading(view, follow)
    return CameraPose(place - distance_m * forward + height_m * UP, place + ahead_m * forward, UP)


def birds_eye(view: FrameView, follow: Follow = "ego", height_m: float = 110.0) -> CameraPose:
    """Pose above what is followed, its heading upwards on the screen, review frame.

    The viewer has perspective cameras that orbit about an up direction: a small tilt keeps that defined.
    """
    place, _, forward = _heading(view, follow)
    return CameraPose(place + height_m * UP - 0.02 * height_m * forward, place, UP)


def overview(view: FrameView, _follow: Follow = "ego") -> CameraPose:
    """Pose of the start: high and to the side, with the cooperating agents in view, review frame.

    In an episode with whom the ego meets in view, if that is selected.
    """
    place, _, forward = _heading(view)
    meets = view.moment is not None and view.selected is not None
    others = np.array([agent.review_from_body[:3, 3] for agent in view.agents])
    others = np.stack([place, view.selected]) if meets else others  # type: ignore[list-item]
    near = others[np.linalg.norm((others - place)[:, :2], axis=1) < 80.0]
    middle = near.mean(axis=0) if meets else 0.5 * (place + near.mean(axis=0))
    least = 15.0 if meets else 22.0
    spread = float(np.clip(np.linalg.norm((near - middle)[:, :2], axis=1).max(initial=0.0), least, 50.0))
    left = np.array([-forward[1], forward[0], 0.0])
    ahead = -0.2 if meets else 0.15
    away = spread * (-1.5 * forward + 0.6 * left + 1.15 * UP)
    return CameraPose(middle + (1.2 if meets else 1.0) * away, middle + ahead * spread * forward, UP)


def close_to(target: NDArray[np.float64], pose: CameraPose, distance_m: float = 24.0) -> CameraPose:
    """Pose that looks at a point (3,) from the side of an earlier pose, at a distance and from above."""
    away = (pose.position - target)[:2]
    length = float(np.hypot(*away))
    side = away / length if length > 1.0 else np.array([-1.0, 0.0])
    return CameraPose(target + distance_m * np.array([0.8 * side[0], 0.8 * side[1], 0.6]), target, UP)


PRESETS: dict[str, Callable[[FrameView, Follow], CameraPose]] = {"chase": chase, "bev": birds_eye}
"""Poses of the cameras that follow; a free one starts with the overview."""


class BrowserCamera:
    """Camera of one browser, in a scene that moves with what the camera follows; threads share it.

    Poses are set and reported in the event loop of the server: viser sends what differs from the last report, and sets
    the point looked at relative to it, so that a report, or another thread, in between would leave the camera astray.

    Attributes:
        scene_from_review: (4, 4) pose of the review frame in the scene, as drawn last.
        drawn: state that was drawn last, None before the first.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        loop: asyncio.AbstractEventLoop,
        start: CameraPose | None = None,
        on_move: Callable[[CameraPose], None] = lambda _: None,
    ) -> None:
        """Take the camera of a browser.

        Args:
            loop: event loop of the server.
            start: first pose, in the scene; None for that of the state.
            on_move: called in the event loop with a pose that other cells lack.
        """
        self.scene_from_review = np.eye(4)
        self.drawn: ReviewState | None = None
        self._client, self._loop, self._wanted, self._on_move = client, loop, start, on_move
        self._preset: Camera | None = None
        self._given: tuple[CameraPose, bool] | None = None
        self._given_at = 0.0
        # Given before that, and not reported yet as far as is known.
        self._earlier: deque[CameraPose] = deque(maxlen=_REMEMBERED)
        self._look_again: asyncio.TimerHandle | None = None
        self._lock = threading.Lock()
        client.camera.on_update(self._reported)

    @property
    def pose(self) -> CameraPose | None:
        """Pose in the scene as the browser reported it last; None before it is known."""
        camera = self._client.camera
        if not np.isfinite(camera.position).all():
            return None
        return CameraPose(np.array(camera.position), np.array(camera.look_at), UP)

    def place(self, preset: Camera) -> None:
        """Place it with the next frame as a preset has it."""
        with self._lock:
            self._preset = preset

    def reset(self) -> None:
        """Place it with the next frame as at the start."""
        with self._lock:
            self._preset = self.drawn = None

    def fly_to(self, target: NDArray[np.float64]) -> bool:
        """Place it with the next frame near a point (3,) of the review frame, m; False before its pose is known."""
        given = self._given
        # A browser that was placed and has not said so yet still reports where it was before.
        pose = self.pose if given is None else given[0]
        if pose is None:
            return False
        with self._lock:
            self._preset = None
            self._wanted = close_to(target, pose.moved(invert(self.scene_from_review)))
        return True

    def follow(self, view: FrameView, state: ReviewState) -> NDArray[np.float64]:
        """Place it for a frame, or leave it to the user; return the (4, 4) pose of the review frame in the scene."""
        gone = state.follow == "selected" and view.selected is None and self.drawn is not None
        # What is followed and is gone for a while leaves the picture where it is.
        after = self.scene_from_review if gone else scene_from_review(state.camera, view, state.follow)
        pose = self._next(view, state, after)
        if pose is not None:
            asyncio.run_coroutine_threadsafe(self._place(pose), self._loop).result()
        # Only now: until a browser is placed, what it reports is nobody's wish.
        self.scene_from_review, self.drawn = after, state
        return after

    def _next(self, view: FrameView, state: ReviewState, after: NDArray[np.float64]) -> CameraPose | None:
        """Pose in the scene; None leaves it to the user."""
        with self._lock:
            wanted, preset, self._wanted, self._preset = self._wanted, self._preset, None, None
            drawn = self.drawn
        if wanted is not None:
            # That of a link is already in the scene.
            return wanted if drawn is None else wanted.moved(after)
        if drawn is None or drawn.drive != state.drive:
            return PRESETS.get(state.camera, overview)(view, state.follow).moved(after)
        if preset in PRESETS:
            return PRESETS[preset](view, state.follow).moved(after)
        current = self.pose
        if (drawn.camera, drawn.follow) != (state.camera, state.follow) and current is not None:
            # The picture stays while the scene moves back.
            return current.moved(after @ invert(self.scene_from_review))
        return None

    async def _place(self, pose: CameraPose) -> None:
        self.set(pose)

    def set(self, pose: CameraPose, own: bool = True) -> None:
        """Set it, in the event loop, to a pose in the scene; not `own` is that of another cell, whose user moved it."""
        if self._given is not None:
            self._earlier.append(self._given[0])
        self._given, self._given_at = (pose, own), time.monotonic()
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = pose.up
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.fov = FOV_RAD
            camera.near, camera.far = 0.5, 2000.0

    async def _reported(self, _: object) -> None:
        self._tell()

    def _tell(self) -> None:
        """Tell of the reported pose if other cells lack it, or look again once it is no late one any more.

        A browser reports late: until it reports the pose that it was given last, it tells of earlier ones. Those it was
        given are known however late they come, as from a browser that draws in software. One whose user moves it before
        it has reported that pose never reports it.
        """
        if self._look_again is not None:
            self._look_again.cancel()
            self._look_again = None
        pose = self.pose
        if self.drawn is None or pose is None:
            return
        if self._given is not None:
            given, own = self._given
            if _same(pose, given):
                self._given = None
                self._earlier.clear()
                if not own:
                    return
            elif any(_same(pose, one) for one in self._earlier):
                return
            elif (late_s := self._given_at + LATE_S - time.monotonic()) > 0.0:
                self._look_again = self._loop.call_later(late_s, self._tell)
                return
        self._on_move(pose)


def _same(one: CameraPose, other: CameraPose) -> bool:
    return bool(np.allclose([one.position, one.look_at], [other.position, other.look_at], atol=0.01))
