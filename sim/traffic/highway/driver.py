"""Driver on highway-env's roads: its bicycle model and lane changes (MOBIL), with our own perception and steering.

highway-env's drivers perceive the vehicle ahead on their own lanes only, all of one size, give way at one junction
only, take bends at any speed and change lanes at 40 m/s2. Ours follow any body on their path, whatever its lane, slow
down for bends, give way where paths cross or merge (`sim.traffic.highway.perception`), and steer towards a point ahead
within limits of lateral acceleration.
"""

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from sim.bodies.vehicle_types import VehicleType
from sim.traffic.highway.roads import LaneIndex, LaneNetwork, RoadLane, to_world

_SIDE_MPS2 = 4.0
_TIGHTEST = 0.22
"""Largest curvature that a vehicle can drive, 1/m."""
_AHEAD_S = 0.7
_BETWEEN_M, _CHANGE_M = 0.8, 16.0
_PULL_OUT_M = 9.0
_KEEPS_M = 1.0
"""Distance by which another lane has to be nearer than those of the route: at junctions lanes begin together."""


class EnvironmentVehicle(IDMVehicle):
    """Vehicle class handed to highway-env: some environments change constants of the class they are given."""


class Driver(IDMVehicle):
    """Vehicle with its driver.

    Attributes:
        number: running number of the driver, from 0.
        kind: vehicle type.
        roads: lane network.
        lane_number: number of its target lane.
        goal: number of its exit lane, None on a closed track.
        speed_factor: desired speed as a share of the limit.
        planned_mps2: acceleration to apply next, m/s2.
        commanded: speed commanded from outside, m/s; None without a command.
        off_lanes: whether it was placed off the lanes and has not come back.
        path_ahead: (K, 2) points of the path ahead in the world and (K,) their distances along it, m.
    """

    # Gaps for lane changes; highway-env's own values require 45 m in a town.
    target_lane_index: LaneIndex
    DISTANCE_WANTED = 7.0
    TIME_WANTED = 1.0
    LANE_CHANGE_MAX_BRAKING_IMPOSED = 3.0

    def __init__(
        self,
        road: object,
        roads: LaneNetwork,
        lane_number: int,
        along: float,
        kind: VehicleType,
        number: int,
        speed_factor: float,
    ) -> None:
        """Put a driver on a lane, `along` m after its start, at its desired speed."""
        # First of all: highway-env takes the size of a vehicle from its class.
        self.LENGTH, self.WIDTH = kind.size[0], kind.size[1]
        lane = roads.lanes[lane_number]
        self.kind, self.number, self.roads, self.speed_factor = kind, number, roads, speed_factor
        self.lane_number = lane_number
        self.goal: int | None = None
        self.planned_mps2 = 0.0
        self.commanded: float | None = None
        self.off_lanes = False
        self.path_ahead: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._slip = 0.0
        self._moving = False
        super().__init__(
            road,
            lane.lane.position(along, 0.0),
            heading=lane.lane.heading_at(along),
            speed=self.desired_speed(lane),
            target_lane_index=lane.index,
            enable_lane_change=roads.changes_lanes,
        )
        self._route_ahead = roads.route(lane_number, None) or []

    def desired_speed(self, lane: RoadLane) -> float:
        """Return the desired speed on a straight lane, m/s."""
        return min(self.speed_factor * lane.limit, self.kind.speed_mps)

    @property
    def desired_speed_here(self) -> float:
        """Desired speed on the target lane, m/s."""
        return self.desired_speed(self.roads.lanes[self.lane_number])

    @property
    def along(self) -> float:
        """Distance along the target lane, m."""
        return self.roads.lanes[self.lane_number].along_at(to_world(self.position))

    @property
    def must_leave(self) -> bool:
        """Whether its lane ends, so that it has to merge to the left."""
        lane = self.roads.lanes[self.lane_number]
        return bool(lane.lane.forbidden) and lane.index[2] > 0

    @property
    def lateral_offset(self) -> float:
        """Lateral distance from the centre of the target lane, m."""
        lane = self.roads.lanes[self.lane_number]
        return float(np.sqrt(lane.squares(to_world(self.position)).min()))

    @property
    def merge_room_m(self) -> float:
        """Distance from the front bumper to the waiting point at the end of a merging lane, m."""
        return float(self.roads.lanes[self.lane_number].along[-1]) - self.along - 0.5 * self.LENGTH - _PULL_OUT_M

    @property
    def has_left(self) -> bool:
        """Whether it has reached the end of the last lane."""
        lane = self.roads.lanes[self.lane_number]
        return not lane.after and self.along > lane.along[-1] - 1.0

    def lanes_ahead(self, ahead_m: float) -> list[int]:
        """Return the numbers of the lanes ahead, target lane first, over at least `ahead_m` m."""
        lanes = self.roads.lanes
        found = [self.lane_number, *self._route_ahead]
        length = sum(lanes[number].along[-1] for number in found) - self.along
        while length < ahead_m and (more := self.roads.route(found[-1], None)):
            found += more
            length += lanes[more[0]].along[-1]
        return found

    def send_to(self, goal: int | None) -> bool:
        """Plan the route to a lane; False, without effect, if there is none."""
        route = self.roads.route(self.lane_number, goal)
        if route is None:
            return False
        self.goal, self._route_ahead = goal, route
        return True

    def drive(self, step_s: float) -> None:
        """Apply `planned_mps2`, steer along the path and choose the target lane."""
        slip = self._towards(step_s)
        Vehicle.act(self, {"steering": float(np.arctan(2.0 * np.tan(slip))), "acceleration": self.planned_mps2})
        # Used by highway-env's lane change model (MOBIL).
        self.target_speed = self.desired_speed_here
        self.follow_road()
        if self.enable_lane_change and self.commanded is None:
            self._change_lane()

    def _towards(self, step_s: float) -> float:
        """Return the slip angle, in highway-env's sense, that leads to a point ahead (pure pursuit)."""
        if self.path_ahead is None:
            return 0.0
        points, along = self.path_ahead
        ahead = min(max(_AHEAD_S * self.speed, 4.0), 25.0)
        if self.enable_lane_change and self.lateral_offset > _BETWEEN_M:
            # A longer look-ahead during lane changes avoids overshoot.
            ahead = max(ahead, _CHANGE_M)
        away = np.array([np.interp(ahead, along, points[:, axis]) for axis in (0, 1)]) - to_world(self.position)
        # To the left of the heading in our world is to the right in highway-env's.
        aside = float(away @ [np.sin(self.heading), np.cos(self.heading)])
        most = min(_SIDE_MPS2 / max(self.speed, 0.5) ** 2, _TIGHTEST)
        bend = min(max(2.0 * aside / max(float(away @ away), 1.0), -most), most)
        slip = -float(np.arcsin(min(max(bend * 0.5 * self.LENGTH, -0.9), 0.9)))
        change = _SIDE_MPS2 * step_s / max(self.speed, 1.0)
        self._slip = float(min(max(slip, self._slip - change), self._slip + change))
        return self._slip

    def step(self, dt: float) -> None:
        """Move by one time step, never backwards."""
        self.action["acceleration"] = max(self.action["acceleration"], -self.speed / dt)
        super().step(dt)

    def move(self, step_s: float, parts: int) -> None:
        """Move by `step_s` in equal parts, and look only then for the lane: all lanes are measured for it."""
        self._moving = True
        for _ in range(parts):
            self.step(step_s / parts)
        self._moving = False
        self.on_state_update()

    def on_state_update(self) -> None:
        """Find the lane here, unless on the way."""
        if not self._moving:
            super().on_state_update()

    def follow_road(self) -> None:
        """Switch to the next lane of the route at the end of this one."""
        lane = self.roads.lanes[self.lane_number]
        if lane.after and self.along > lane.along[-1] - 0.5:
            if not self._route_ahead:
                self._route_ahead = self.roads.route(self.lane_number, None) or []
            self._head_for(self._route_ahead.pop(0))

    def put(self, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Stand at a (2,) place in the world, with a heading and a speed, and head for the lane there."""
        self.position, self.heading, self.speed = to_world(xy), -yaw, speed_mps
        self.on_state_update()
        lane = self.lane_below()
        number = None if lane is None else self.roads.number(lane.index)
        self.off_lanes = lane is None
        # Against its direction a lane is no way to go on.
        if lane is not None and number is not None and lane.turn_from(xy, yaw) < 0.5 * np.pi:
            if number in self._route_ahead:
                self._route_ahead = self._route_ahead[self._route_ahead.index(number) + 1 :]
                self._head_for(number)
            elif number != self.lane_number:
                self.change_to(number)
        self.follow_road()

    def lane_below(self) -> RoadLane | None:
        """Return the lane on which it is, of several the one that fits its heading and route; None off the lanes."""
        xy, own = to_world(self.position), (self.lane_number, *self._route_ahead)
        best, least = None, np.inf
        for number, lane in enumerate((*self.roads.lanes, *self.roads.unused)):
            away_m = lane.away_from(xy)
            misfit = away_m + lane.turn_from(xy, -self.heading) - _KEEPS_M * (number in own)
            if away_m <= 0.5 * lane.width and misfit < least:
                best, least = lane, misfit
        return best

    def change_to(self, number: int) -> None:
        """Head for a lane beside its route and plan the route anew."""
        self._head_for(number)
        if not self.send_to(self.goal):
            # The new lane has another exit.
            ends = [n for n in self.roads.exits if self.roads.route(number, n) is not None]
            self.send_to(ends[0] if ends else None)

    def _change_lane(self) -> None:
        before = self.target_lane_index
        lane = self.roads.lanes[self.lane_number]
        # With a route, highway-env's drivers change to its lane as soon as it is safe, not only to gain speed.
        self.route = [(*lane.index[:2], lane.index[2] - 1)] if self.must_leave else None
        self.change_lane_policy()
        number = self.roads.number(self.target_lane_index)
        if number is None or tuple(before) == tuple(self.target_lane_index):
            self.target_lane_index = before
            return
        self.change_to(number)

    def _head_for(self, number: int) -> None:
        self.lane_number = number
        self.target_lane_index = self.roads.lanes[number].index
