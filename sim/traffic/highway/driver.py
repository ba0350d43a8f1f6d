"""A driver on highway-env's roads: its bicycle model and its choice of lanes (MOBIL), with eyes and hands of ours.

highway-env's drivers see the vehicle ahead on the lanes that are theirs, all of one size, give way at one junction
only, take bends at any speed and change lanes at 40 m/s2. Ours follow what stands or drives on their way, whatever lane
it is on, slow down for bends, stop where the way crosses or meets one that goes first (`sim.traffic.highway.perception`), and
steer towards a point ahead on their way no faster than tyres and hands allow.
"""

from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from sim.traffic.highway.roads import LaneIndex, RoadLane, Roads, to_world
from sim.vehicle_types import VehicleType

_SIDE_MPS2 = 4.0
_TIGHTEST = 0.22
"""Sharpest bend that a vehicle can drive, 1/m."""
_AHEAD_S = 0.7
_BETWEEN_M, _CHANGE_M = 0.8, 16.0
_PULL_OUT_M = 9.0


class Extra(IDMVehicle):
    """A vehicle of highway-env's own; some environments change the constants of the class that they are given."""


class Driver(IDMVehicle):
    """One vehicle with its driver.

    Attributes:
        number: counts the drivers from 0.
        kind: its type.
        roads: where it drives.
        lane_number: number of the lane that it is heading for.
        goal: number of the lane where it leaves the roads, None on a closed track.
        eager: its wanted speed as a share of the limit.
        pull: acceleration that it is going to apply, m/s2.
        commanded: speed that somebody else has chosen, m/s; None when it chooses.
        sight: (K, 2) points of its way in the world and (K,) their distances along it, m.
    """

    # How near to others highway-env's drivers change lanes; its own values ask for gaps of 45 m in a town.
    target_lane_index: LaneIndex
    DISTANCE_WANTED = 7.0
    TIME_WANTED = 1.0
    LANE_CHANGE_MAX_BRAKING_IMPOSED = 3.0

    def __init__(
        self, road: Any, roads: Roads, lane_number: int, along: float, kind: VehicleType, number: int, eager: float
    ) -> None:
        """Put a driver on a lane, `along` m after its start, at the speed that it wants there."""
        # Before anything else: highway-env's geometry of a vehicle is of its class.
        self.LENGTH, self.WIDTH = kind.size[0], kind.size[1]
        lane = roads.lanes[lane_number]
        self.kind, self.number, self.roads, self.eager = kind, number, roads, eager
        self.lane_number = lane_number
        self.goal: int | None = None
        self.pull = 0.0
        self.commanded: float | None = None
        self.sight: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._slip = 0.0
        super().__init__(
            road,
            lane.lane.position(along, 0.0),
            heading=lane.lane.heading_at(along),
            speed=self.wanted(lane),
            target_lane_index=lane.index,
            enable_lane_change=roads.changes_lanes,
        )
        self._way = roads.way(lane_number, None) or []

    def wanted(self, lane: RoadLane) -> float:
        """Return the speed that it wants on a straight lane, m/s."""
        return min(self.eager * lane.limit, self.kind.speed_mps)

    @property
    def wanted_here(self) -> float:
        """Speed that it wants on the lane that it is heading for, m/s."""
        return self.wanted(self.roads.lanes[self.lane_number])

    @property
    def along(self) -> float:
        """Where it is along the lane that it is heading for, m."""
        return self.roads.lanes[self.lane_number].along_at(to_world(self.position))

    @property
    def must_leave(self) -> bool:
        """Whether its lane ends and it has to change to the one on its left."""
        lane = self.roads.lanes[self.lane_number]
        return bool(lane.lane.forbidden) and lane.index[2] > 0

    @property
    def aside(self) -> float:
        """How far it is from the middle of the lane that it is heading for, m."""
        lane = self.roads.lanes[self.lane_number]
        return float(np.sqrt(((lane.line - to_world(self.position)) ** 2).sum(axis=1).min()))

    @property
    def room(self) -> float:
        """How far its front bumper is from where it has to wait at the end of such a lane, m."""
        return float(self.roads.lanes[self.lane_number].along[-1]) - self.along - 0.5 * self.LENGTH - _PULL_OUT_M

    @property
    def has_left(self) -> bool:
        """Whether it is at the end of the last lane."""
        lane = self.roads.lanes[self.lane_number]
        return not lane.after and self.along > lane.along[-1] - 1.0

    def way(self, ahead_m: float) -> list[int]:
        """Return the numbers of the lanes ahead, the one that it is heading for first, over at least `ahead_m` m."""
        lanes = self.roads.lanes
        found = [self.lane_number, *self._way]
        length = sum(lanes[number].along[-1] for number in found) - self.along
        while length < ahead_m and (more := self.roads.way(found[-1], None)):
            found += more
            length += lanes[more[0]].along[-1]
        return found

    def send_to(self, goal: int | None) -> bool:
        """Plan the way to a lane; False, and nothing is changed, when none leads there."""
        way = self.roads.way(self.lane_number, goal)
        if way is None:
            return False
        self.goal, self._way = goal, way
        return True

    def drive(self, step_s: float) -> None:
        """Apply `pull`, steer along the way and choose the lane to head for."""
        slip = self._towards(step_s)
        Vehicle.act(self, {"steering": float(np.arctan(2.0 * np.tan(slip))), "acceleration": self.pull})
        # What highway-env's drivers think of one another when they change lanes.
        self.target_speed = self.wanted_here
        self.follow_road()
        if self.enable_lane_change and self.commanded is None:
            self._change_lane()

    def _towards(self, step_s: float) -> float:
        """Return the angle between motion and heading, in highway-env's sense, that leads to a point ahead."""
        if self.sight is None:
            return 0.0
        points, along = self.sight
        ahead = np.clip(_AHEAD_S * self.speed, 4.0, 25.0)
        if self.enable_lane_change and self.aside > _BETWEEN_M:
            # From lane to lane it goes gently, or it would swing beyond the lane that it wants.
            ahead = max(ahead, _CHANGE_M)
        away = np.array([np.interp(ahead, along, points[:, axis]) for axis in (0, 1)]) - to_world(self.position)
        # To the left of the heading in our world is to the right in highway-env's.
        aside = away @ [np.sin(self.heading), np.cos(self.heading)]
        most = min(_SIDE_MPS2 / max(self.speed, 0.5) ** 2, _TIGHTEST)
        bend = np.clip(2.0 * aside / max(float(away @ away), 1.0), -most, most)
        slip = -float(np.arcsin(np.clip(bend * 0.5 * self.LENGTH, -0.9, 0.9)))
        change = _SIDE_MPS2 * step_s / max(self.speed, 1.0)
        self._slip = float(np.clip(slip, self._slip - change, self._slip + change))
        return self._slip

    def step(self, dt: float) -> None:
        """Move; nobody drives backwards."""
        self.action["acceleration"] = max(self.action["acceleration"], -self.speed / dt)
        super().step(dt)

    def follow_road(self) -> None:
        """Head for the next lane of the way where this one ends."""
        lane = self.roads.lanes[self.lane_number]
        if lane.after and self.along > lane.along[-1] - 0.5:
            if not self._way:
                self._way = self.roads.way(self.lane_number, None) or []
            self._head_for(self._way.pop(0))

    def _change_lane(self) -> None:
        before = self.target_lane_index
        lane = self.roads.lanes[self.lane_number]
        # With a route highway-env's drivers change to its lane as soon as that is safe, not only to be faster.
        self.route = [(*lane.index[:2], lane.index[2] - 1)] if self.must_leave else None
        self.change_lane_policy()
        number = self.roads.number(self.target_lane_index)
        if number is None or tuple(before) == tuple(self.target_lane_index):
            self.target_lane_index = before
            return
        self._head_for(number)
        if not self.send_to(self.goal):
            # Its goal is the exit of another lane of the same road.
            ends = [n for n in self.roads.exits if self.roads.way(number, n) is not None]
            self.send_to(ends[0] if ends else None)

    def _head_for(self, number: int) -> None:
        self.lane_number = number
        self.target_lane_index = self.roads.lanes[number].index
