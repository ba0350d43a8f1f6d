"""Motion of the road users of a storyboard: along a lane and across it, along a polyline, or straight on."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.roads.opendrive import LanePlace, OpenDrive

STEP_S = 0.05
"""Step of the motion, s."""

SHAPES: dict[str, Callable[[float], float]] = {
    "linear": lambda u: u,
    "cubic": lambda u: u * u * (3.0 - 2.0 * u),
    "sinusoidal": lambda u: 0.5 - 0.5 * math.cos(math.pi * u),
    "step": lambda u: 1.0,
}
"""Shapes of transitions, as shares of the way from start to end."""

_log = logging.getLogger(__name__)


class Pose(NamedTuple):
    """Place, m, and heading, rad, of a reference point in the world frame."""

    x: float
    y: float
    z: float
    heading: float


@dataclass
class Change:
    """Transition of a speed or of a place across the lanes: from where, to where, since when, over which length."""

    start: float
    end: float
    shape: Callable[[float], float]
    length: float
    by_distance: bool
    done: float = 0.0

    def step(self, time_s: float, way_m: float) -> float:
        """Go on and return the new value."""
        self.done += way_m if self.by_distance else time_s
        share = 1.0 if self.length <= 0.0 else min(self.done / self.length, 1.0)
        return self.start + (self.end - self.start) * self.shape(share)

    @property
    def over(self) -> bool:
        """Whether it has gone over its whole length."""
        return self.done >= self.length


@dataclass(frozen=True, slots=True, eq=False)
class Polyline:
    """(K, 5) rows of x, y, z, heading, and time or way; `timed` says which."""

    rows: NDArray[np.float64]
    timed: bool

    def at(self, value: float) -> Pose:
        """Return the pose at a time or after a way; before and after it is that of the ends."""
        key = self.rows[:, 4]
        x, y, z, heading = (float(np.interp(value, key, column)) for column in self.rows[:, :4].T)
        return Pose(x, y, z, heading)


@dataclass
class User:
    """Road user: its box in its own axes, m, and its state while the storyboard is played.

    `rows` are its (time, x, y, z, heading) so far.
    """

    class_name: str
    size: tuple[float, float, float]
    middle: tuple[float, float, float]
    pose: Pose | None = None
    lane: LanePlace | None = None
    speed: float = 0.0
    speeding: Change | None = None
    shifting: Change | None = None
    follow: Polyline | None = None
    followed: float = 0.0
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def move(self, time_s: float, roads: OpenDrive | None) -> None:
        """Move by a step, up to a time."""
        way_m = self.speed * STEP_S
        if self.speeding is not None:
            before = self.speed
            self.speed = self.speeding.step(STEP_S, way_m)
            way_m = 0.5 * (before + self.speed) * STEP_S
            self.speeding = None if self.speeding.over else self.speeding
        if self.follow is not None:
            self.followed += way_m
            before_pose = self.pose
            self.pose = self.follow.at(time_s if self.follow.timed else self.followed)
            if self.follow.timed and before_pose is not None:
                self.speed = math.hypot(self.pose.x - before_pose.x, self.pose.y - before_pose.y) / STEP_S
        elif self.lane is not None:
            assert roads is not None
            self._drive(way_m, roads)
        elif self.pose is not None:
            x, y, z, heading = self.pose
            self.pose = Pose(x + way_m * math.cos(heading), y + way_m * math.sin(heading), z, heading)

    def _drive(self, way_m: float, roads: OpenDrive) -> None:
        """Move along a lane, across it in a lane change, and on to the next road."""
        assert self.lane is not None
        lane, road = self.lane, roads.roads[self.lane.road]
        before = roads.place("lane", lane)
        turn = 0.0
        if self.shifting is not None:
            side = lane.offset
            lane = lane._replace(offset=self.shifting.step(STEP_S, way_m))
            left = (lane.offset - side) * (1.0 if lane.lane < 0 else -1.0)
            turn = math.atan2(left, way_m) if way_m > 1e-6 else 0.0
            self.shifting = None if self.shifting.over else self.shifting
        ahead = 1.0 if lane.lane < 0 else -1.0
        probe = min(max(lane.s + ahead * 0.5, 0.0), road.length)
        there = road.middle(lane.lane, probe)
        scale = 1.0
        if there is not None and abs(probe - lane.s) > 1e-3:
            x, y, _, _ = road.at(probe, there + lane.offset)
            here = roads.place("lane", lane)
            scale = max(math.hypot(x - here[0], y - here[1]) / abs(probe - lane.s), 0.1)
        s = lane.s + ahead * way_m * math.cos(turn) / scale
        if 0.0 <= s <= road.length and road.middle(lane.lane, s) is not None:
            self.lane = lane._replace(s=s)
            x, y, z, heading = roads.place("lane", self.lane)
            self.pose = Pose(x, y, z, heading + turn)
            return
        x, y, z, heading = before
        x, y = x + way_m * math.cos(heading), y + way_m * math.sin(heading)
        self.lane = roads.nearest(x + 0.5 * math.cos(heading), y + 0.5 * math.sin(heading))
        self.pose = Pose(x, y, z, heading)
        self.shifting = None
        if self.lane is None:
            _log.warning("%s: a road user leaves the roads at %.1f, %.1f and goes straight on", roads.path, x, y)
