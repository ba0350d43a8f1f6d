"""Attacks: helpers that lie in their messages, in boxes and poses, or in the points that they share.

A liar knows where the ego is and its route, as the ego's own messages tell them. Liars of one attack are of one mind:
their ghost stands at one place. They lie about objects and poses, not about the space that they see; that of a false
pose is as misplaced as its objects, that of a replay as old.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.faults.fault import Fault, Faults
from dsrc.faults.kinds import REPLAY, Bias, Ghost, Remove, Seconds
from dsrc.faults.localisation import believed_from_true, pose_error
from dsrc.messages.message import Message, Objects
from dsrc.messages.seen_space import View
from sensors.frame import AgentFrame
from sensors.sweep import ADDED, SCATTERED, Sweep
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix
from sim.radio import CPM_BYTES_PER_OBJECT
from sim.rows import stacked
from sim.streams import Stream, random_generator
from sim.traffic.base import POSITION_M, from_steps

_CAR_M = (4.5, 1.9, 1.5)
"""Length, width and height of a ghost, m."""
_CABIN = (0.55, 0.85, 0.45)
"""Length and width of a ghost's cabin and height of what is below it, as shares of the ghost's."""
_SKIN_M = 0.15
"""Distance from a box within which points are of its road user, m."""
_MOVED_M = 0.5
"""Distance from every honest object beyond which a told one is false, m."""
_SLACK_S = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Lie:
    """What a helper lies about at one instant.

    Attributes:
        ghosts: boxes that it tells of where nobody is, world frame.
        removed: ids of the road users that it leaves out, whether it sees them or not.
        misplaced: whether it says to be elsewhere.
    """

    ghosts: Boxes
    removed: tuple[int, ...]
    misplaced: bool


class Attacks:
    """Attacks of an episode, each acting on what those before it left.

    Args:
        faults: those that are no attacks do not matter.
        seed: of the episode.
    """

    def __init__(self, faults: Faults, seed: int, ego_id: int) -> None:
        self._faults = tuple(one for one in faults if one.attack)
        self._seed, self._ego_id = seed, ego_id
        self._ghosts: dict[int, Boxes] = {}
        self._keep_s = max([one.value for one in self._faults if one.kind == REPLAY], default=0.0)
        self._past: dict[int, deque[Message]] = {}
        self._seen: dict[int, list[tuple[float, Boxes]]] = {}

    def aim(self, ego: Boxes, route: NDArray[np.float64], time_s: float) -> None:
        """Tell the liars where the ego is and goes; a ghost that it has passed stands ahead of it again.

        Args:
            ego: one box, world frame.
            route: (K, 2) polyline that it will follow from its centre, world frame, m.
            time_s: of the episode.
        """
        # As a log has it, so that its replay has the same ghosts.
        self._route = from_steps(np.rint(route / POSITION_M), POSITION_M)
        for number, fault in enumerate(self._faults):
            if not isinstance(fault.settings, Ghost):
                continue
            if not fault.at(time_s) or (number in self._ghosts and _passed(ego, self._ghosts[number])):
                self._ghosts.pop(number, None)
            if fault.at(time_s) and number not in self._ghosts:
                ghost = _standing(ego, self._route, fault.settings.ahead_m)
                self._ghosts |= {} if ghost is None else {number: ghost}

    def written(self, message: Message, time_s: float) -> Message:
        """Return what a helper sends in place of its message of a time of the episode.

        Args:
            message: honest; the messages of a sender come in their order.
        """
        if not self._faults:
            return message
        past = self._past.setdefault(message.sender, deque())
        if not past or past[-1].time_s < message.time_s:
            past.append(message)
        while len(past) > 1 and past[1].time_s <= message.time_s - self._keep_s + _SLACK_S:
            past.popleft()
        sent = message
        for number, fault in enumerate(self._faults):
            if self._lies(fault, message.sender, time_s):
                sent = self._changed(number, fault, sent, time_s)
        if sent is message:
            return message
        moved = ~_within(sent.objects.boxes, message.objects.boxes, _MOVED_M)
        return replace(sent, attacked=True, false=moved)

    def more_bytes(self, sender: int, seen: Boxes, time_s: float) -> int:
        """Return by how much a helper's message is larger than the honest one, which tells of what it sees.

        Args:
            seen: world frame; the messages of a sender come in their order.
            time_s: of the episode.
        """
        past, told = self._seen.setdefault(sender, []), seen
        past.append((time_s, seen))
        for number, fault in enumerate(self._faults):
            if not self._lies(fault, sender, time_s):
                continue
            if isinstance(fault.settings, Ghost):
                told = stacked(told, *self._ghost(number))
            elif isinstance(fault.settings, Remove):
                told = told[_aside(told, self._route) > fault.settings.aside_m]
            elif isinstance(fault.settings, Seconds):
                old = [boxes for since_s, boxes in past if since_s <= time_s - fault.settings.seconds + _SLACK_S]
                told = old[-1] if old else past[0][1]
        return CPM_BYTES_PER_OBJECT * (len(told) - len(seen))

    def measured(self, agent: AgentFrame, truth: Boxes, time_s: float) -> Sweep:
        """Return the sweep that a helper shares in place of its own: its points lie as its boxes would.

        A ghost is what the helper's own rays would meet, removed road users have no returns, and a false pose is where
        the sweep is said to be measured. Features are what the helper's network makes of these points.

        Args:
            truth: road users, world frame; a liar knows those that it removes.
            time_s: of the episode.

        Raises:
            TypeError: an attack that needs messages before this one.
        """
        sweep = agent.sweep
        for number, fault in enumerate(self._faults):
            if not self._lies(fault, agent.agent_id, time_s):
                continue
            settings = fault.settings
            if isinstance(settings, Ghost):
                lidar_from_world = invert(sweep.world_from_lidar)
                sweep = _haunted(sweep, [one.transform(lidar_from_world) for one in self._ghost(number)])
            elif isinstance(settings, Remove):
                gone = truth[self._removed(settings, truth, agent.agent_id)]
                rows, _ = points_in_boxes(gone, sweep.points, sweep.world_from_lidar, _SKIN_M)
                kept = np.ones(len(sweep), bool)
                kept[rows] = False
                sweep = sweep[kept]
            elif isinstance(settings, Bias):
                error = pose_error((fault,), self._seed, agent.agent_id, self._ego_id, time_s)
                moved = believed_from_true(agent.world_from_body, error)
                sweep = replace(sweep, world_from_lidar=moved @ sweep.world_from_lidar)
            else:
                raise TypeError(fault.kind)
        return sweep

    def lie(self, sender: int, truth: Boxes, time_s: float) -> Lie:
        """Return what a helper lies about at a time of the episode.

        Args:
            truth: road users, world frame.
        """
        acting = [(k, one) for k, one in enumerate(self._faults) if self._lies(one, sender, time_s)]
        gone = np.zeros(len(truth), bool)
        for _, fault in acting:
            if isinstance(fault.settings, Remove):
                gone |= self._removed(fault.settings, truth, sender)
        return Lie(
            stacked(truth[:0], *(ghost for k, _ in acting for ghost in self._ghost(k))),
            tuple(truth.object_id[gone].tolist()),
            any(isinstance(fault.settings, Bias) for _, fault in acting),
        )

    def _removed(self, settings: Remove, truth: Boxes, sender: int) -> NDArray[np.bool_]:
        """Return (N,) which road users a helper leaves out."""
        return (_aside(truth, self._route) <= settings.aside_m) & (truth.object_id != sender)

    def _ghost(self, number: int) -> list[Boxes]:
        return [self._ghosts[number]] if number in self._ghosts else []

    def _lies(self, fault: Fault, sender: int, time_s: float) -> bool:
        if not (fault.at(time_s) and fault.on(sender, self._ego_id)):
            return False
        if not isinstance(fault.settings, Ghost | Remove):
            return True
        rng = random_generator(self._seed, Stream.FAULT, fault.kind, 1 + round(1e3 * time_s), sender)
        return float(rng.random()) < fault.settings.share

    def _changed(self, number: int, fault: Fault, message: Message, time_s: float) -> Message:
        settings = fault.settings
        if isinstance(settings, Ghost):
            if number not in self._ghosts:
                return message
            ghost = Objects(self._ghosts[number], np.ones(1), np.zeros((1, 2)))
            return replace(message, objects=stacked(message.objects, ghost))
        if isinstance(settings, Remove):
            left = _aside(message.objects.boxes, self._route) > settings.aside_m
            return message if left.all() else replace(message, objects=message.objects[left])
        if isinstance(settings, Bias):
            error = pose_error((fault,), self._seed, message.sender, self._ego_id, time_s)
            return _misplaced(message, believed_from_true(message.pose, error)) if error.any() else message
        if isinstance(settings, Seconds):
            return self._old(message, settings.seconds)
        raise TypeError(fault.kind)

    def _old(self, message: Message, age_s: float) -> Message:
        """Return the newest message at least so old, else the oldest one, with the stamp of this one."""
        past = self._past[message.sender]
        old = [one for one in past if one.time_s <= message.time_s - age_s + _SLACK_S]
        again = old[-1] if old else past[0]
        if again.time_s >= message.time_s:
            return message

        def view() -> View:
            return replace(again.view(), time_s=message.time_s)

        return replace(again, time_s=message.time_s, view=view)


def _standing(ego: Boxes, route: NDArray[np.float64], ahead_m: float) -> Boxes | None:
    """Return a car on the ego's route so far ahead; None where the route ends before."""
    steps = np.diff(route, axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    if along[-1] < ahead_m:
        return None
    x, y = (np.interp(ahead_m, along, axis) for axis in route.T)
    step = steps[min(int(np.searchsorted(along, ahead_m, side="right")) - 1, len(steps) - 1)]
    ground = ego.center[0, 2] - 0.5 * ego.size[0, 2]
    return Boxes.from_array([x, y, ground + 0.5 * _CAR_M[2], *_CAR_M, np.arctan2(step[1], step[0])])


def _passed(ego: Boxes, ghost: Boxes) -> bool:
    """Whether a ghost is behind the ego."""
    heading = [np.cos(ego.yaw[0]), np.sin(ego.yaw[0])]
    return bool((ghost.center[0, :2] - ego.center[0, :2]) @ heading < 0.0)


def _haunted(sweep: Sweep, ghosts: Sequence[Boxes]) -> Sweep:
    """Return a sweep in which the rays that meet a ghost before anything else end on it.

    Args:
        ghosts: one box each, sensor frame; a ghost has a body, and on it a cabin.
    """
    ray = sweep.points.astype(np.float64)
    share = np.ones(len(ray))
    for ghost in ghosts:
        (length, width, height), (long, wide, low) = ghost.size[0], _CABIN
        for size, middle in (
            ((length, width, low * height), 0.5 * (low - 1.0) * height),
            ((long * length, wide * width, (1.0 - low) * height), 0.5 * low * height),
        ):
            part = Boxes.from_array([*(ghost.center[0] + [0.0, 0.0, middle]), *size, ghost.yaw[0]])
            share = np.minimum(share, _met(part, ray))
    made = share < 1.0
    return replace(
        sweep,
        points=np.where(made[:, None], share[:, None] * ray, ray).astype(np.float32),
        object_id=np.where(made, ADDED, sweep.object_id),
        fate=np.where(made, SCATTERED, sweep.fate),
    )


def _met(box: Boxes, ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (P,) the share of each ray, from the origin to (P, 3) ends, after which it enters a box; else infinity."""
    local_from_ray = invert(pose_matrix(box.center[0], box.yaw[0]))
    start, step = local_from_ray[:3, 3], ray @ local_from_ray[:3, :3].T
    half = 0.5 * box.size[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(-half - start) / step, (half - start) / step]), axis=0)
    enters, leaves = ends[0].max(axis=1), ends[1].min(axis=1)
    return np.where((enters > 0.0) & (enters <= leaves), enters, np.inf)


def _aside(boxes: Boxes, route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) distances of centres from a (K, 2) polyline, m; infinity without one."""
    if len(route) < 2:
        return np.full(len(boxes), np.inf)
    begin, step = route[:-1], np.diff(route, axis=0)
    offset = boxes.center[:, None, :2] - begin
    share = np.einsum("nkd,kd->nk", offset, step) / np.maximum((step**2).sum(axis=1), 1e-12)
    foot = offset - np.clip(share, 0.0, 1.0)[..., None] * step
    return np.asarray(np.linalg.norm(foot, axis=2).min(axis=1))


def _within(boxes: Boxes, others: Boxes, least_m: float) -> NDArray[np.bool_]:
    """Return (N,) whether another box has its centre within a distance."""
    if not len(others):
        return np.zeros(len(boxes), bool)
    apart = np.linalg.norm(boxes.center[:, None, :2] - others.center[None, :, :2], axis=2)
    return np.asarray((apart <= least_m).any(axis=1))


def _misplaced(message: Message, believed: NDArray[np.float64]) -> Message:
    """Return a message of an agent that says to be elsewhere: all that it tells moves with it."""
    objects, turn = message.objects, believed[:2, :2]

    def view() -> View:
        own = message.view()
        place = believed @ [*own.xy, 0.0, 1.0]
        return replace(own, xy=place[:2], yaw=own.yaw + float(np.arctan2(turn[1, 0], turn[0, 0])))

    moved = replace(objects, boxes=objects.boxes.transform(believed), velocity=objects.velocity @ turn.T)
    return replace(message, pose=believed @ message.pose, objects=moved, view=view)
