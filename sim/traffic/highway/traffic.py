"""Traffic on highway-env's roads, without SUMO: its lanes, vehicle model and lane changes."""

import numpy as np
from numpy.typing import NDArray

from sim.bodies.choice import generic_models_for
from sim.bodies.fleet import Fleet
from sim.bodies.vehicle_types import VehicleType
from sim.boxes import Boxes
from sim.errors import ScenarioError, TrafficError, complaint
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import SIGNALS, Actors, DrivableTraffic, Limits, check_command, check_place
from sim.traffic.highway.driver import Driver
from sim.traffic.highway.perception import AHEAD_M, Junction, decide, free_speed, path_ahead
from sim.traffic.highway.roads import LaneNetwork, read_roads, to_world

FIRST_ID = 1000
"""Object id of the first vehicle."""

_KINEMATICS_S = 0.05
_GAP_M = 6.0
_BRAKES_MPS2 = -0.6
_TURNS_RAD = np.radians(30.0)
_TURN_AHEAD_M = 30.0


class HighwayTraffic(DrivableTraffic):
    """Traffic on the roads of an environment of highway-env.

    The environment gives the lanes. Its vehicles are replaced by those of the scenario's demand, each with a random
    exit; vehicles leave at exits and enter where roads begin. A closed track always holds `demand.max_vehicles`.

    Args:
        scenario: scenario to simulate; the constructor runs its warm-up.
        seed: root seed; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: the environment is unknown, highway-env is missing, or the demand has pedestrians or bicycles.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        from highway_env.road.road import Road

        self.step_s = scenario.step_s
        self._scenario, self._demand = scenario, scenario.demand
        if self._demand.bicycles_per_hour or self._demand.persons_per_hour:
            found = f"{self._demand.bicycles_per_hour:g} and {self._demand.persons_per_hour:g}"
            message = complaint(
                scenario.name, "demand.bicycles_per_hour, persons_per_hour", "0 with highway_env", found
            )
            raise ScenarioError(message)
        self._roads: LaneNetwork = read_roads(scenario.network.highway_env)
        self._rng = random_generator(seed, Stream.HIGHWAY_TRAFFIC)
        self._fleet = Fleet.of(scenario, seed)
        self._road = Road(
            network=self._roads.network,
            road_objects=list(self._roads.objects),
            np_random=self._rng,
            neighbour_vehicles_connected_lanes=True,
        )
        self._junction = Junction(self._roads)
        self._time_s = 0.0
        self._made = 0
        self._models: list[str] = []
        self._placed: dict[int, NDArray[np.float64]] = {}
        self._last: dict[int, tuple[NDArray[np.float64], NDArray[np.float64] | None]] = {}
        entries = self._roads.entries
        self._next_s = {number: self._headway() for number in entries}
        self._open = True
        self._fill()
        steps = round(scenario.warmup_s / scenario.step_s)
        for left in reversed(range(steps)):
            if left < 2:
                self._read()  # so that the first velocities and accelerations are differences of positions too
            self._advance()
        self._actors = self._read()

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        return self._actors

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors."""
        self._advance()
        self._actors = self._read()
        return self._actors

    def close(self) -> None:
        """End the simulation."""
        self._open = False

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive a vehicle, see `DrivableTraffic.command`."""
        check_command(speed_mps)
        self._driver(object_id).commanded = None if speed_mps is None else float(speed_mps)
        self._placed.pop(object_id - FIRST_ID, None)

    def place(self, object_id: int, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Put a vehicle somewhere, see `DrivableTraffic.place`."""
        check_place(xy, yaw, speed_mps)
        self._placed[self._driver(object_id).number] = np.array([*xy, yaw, speed_mps], np.float64)

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the (K, 2) world polyline that a vehicle will follow, from its centre over the next `ahead_m` m."""
        driver = self._driver(object_id)
        path = path_ahead(driver, driver.lanes_ahead(ahead_m), driver.along)
        length = min(ahead_m, float(path.along[-1]))
        inside = path.along < length - 1e-6
        end = [np.interp(length, path.along, path.points[:, axis]) for axis in (0, 1)]
        return np.concatenate([path.points[inside], [end]])

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of a vehicle: its speed along its lane, m/s."""
        return float(self._driver(object_id).speed)

    def limits(self, object_id: int) -> Limits:
        """Return the limits of a vehicle where it is; the allowed speed is lower in a bend."""
        driver = self._driver(object_id)
        lane = self._roads.lanes[driver.lane_number]
        allowed_mps = float(min(lane.limit, np.interp(driver.along, lane.along, lane.curve_mps)))
        strongest, _, emergency = driver.kind.accel_mps2
        return Limits(allowed_mps, strongest, emergency)

    def _driver(self, object_id: int) -> Driver:
        for driver in self._road.vehicles:
            if driver.number + FIRST_ID == object_id:
                return driver
        raise KeyError(object_id)

    def _advance(self) -> None:
        if not self._open:
            raise TrafficError("this highway-env simulation is closed")
        drivers = self._road.vehicles
        decide(drivers, self.step_s, self._junction)
        free = [driver for driver in drivers if driver.number not in self._placed]
        for driver in free:
            driver.drive(self.step_s)
        parts = max(1, round(self.step_s / _KINEMATICS_S))
        for driver in free:
            driver.move(self.step_s, parts)
        for driver in drivers:
            if driver.number in self._placed:
                pose = self._placed[driver.number]
                driver.put(pose[:2], float(pose[2]), float(pose[3]))
                pose[3] = 0.0  # it stands until it is placed again
            elif driver.off_lanes:
                driver.off_lanes = driver.lane_below() is None
        self._time_s = round(self._time_s + self.step_s, 6)
        self._road.vehicles = [driver for driver in drivers if not driver.has_left]
        self._arrivals()

    def _headway(self) -> float:
        """Draw the time until the next arrival at an entry, s."""
        entries = len(self._roads.entries)
        if not entries or self._demand.vehicles_per_hour == 0.0:
            return float("inf")
        return float(self._rng.exponential(3600.0 * entries / self._demand.vehicles_per_hour))

    def _arrivals(self) -> None:
        """Insert vehicles at the entries as soon as there is room."""
        for number in self._roads.entries:
            if self._time_s < self._next_s[number] or len(self._road.vehicles) >= self._demand.max_vehicles:
                continue
            kind, speed_factor = self._draw()
            if self._is_free(number, 0.5 * kind.size[0], kind, moving=True):
                self._put(number, 0.5 * kind.size[0], kind, speed_factor)
                self._next_s[number] = self._time_s + self._headway()

    def _fill(self) -> None:
        """Put vehicles on all lanes at the density of the demand."""
        lanes = self._roads.lanes
        length = sum(float(lane.along[-1]) for lane in lanes)
        for number, lane in enumerate(lanes):
            if lane.through_junction or (self._roads.exits and not self._goals(number)):
                continue  # the inner lane of a roundabout has no exit
            rate = self._demand.vehicles_per_hour / 3600.0 / max(len(self._roads.entries), 1)
            mean = lane.limit / max(rate, 1e-6) if self._roads.entries else length / self._demand.max_vehicles
            at = float(self._rng.uniform(2.0, max(mean, 12.0)))
            # No vehicle starts too near to a junction to stop.
            ends = any(lanes[after].through_junction for after in lane.after)
            while (
                at < lane.along[-1] - (40.0 if ends else 3.0) and len(self._road.vehicles) < self._demand.max_vehicles
            ):
                kind, speed_factor = self._draw()
                if self._is_free(number, at, kind, moving=False):
                    self._put(number, at, kind, speed_factor)
                at += kind.size[0] + _GAP_M + float(self._rng.exponential(max(mean - 12.0, 1.0)))

    def _draw(self) -> tuple[VehicleType, float]:
        """Draw a vehicle type and the desired speed of its driver as a share of the limit."""
        labels = sorted(self._demand.type_mix)
        weights = np.array([self._demand.type_mix[label] for label in labels])
        kinds = self._fleet.types_of(labels[int(self._rng.choice(len(labels), p=weights / weights.sum()))])
        weights = np.array([kind.weight for kind in kinds])
        kind = kinds[int(self._rng.choice(len(kinds), p=weights / weights.sum()))]
        kind = self._fleet.own(kind, f"v{self._made}")
        return kind, float(np.clip(self._rng.normal(0.95, 0.08), 0.75, 1.1))

    def _is_free(self, number: int, along: float, kind: VehicleType, *, moving: bool) -> bool:
        """Return whether a vehicle fits at a place of a lane; a moving one needs more room ahead."""
        lane = self._roads.lanes[number]
        place = np.array(lane.lane.position(along, 0.0))
        speed = lane.limit if moving else 0.0
        for driver in self._road.vehicles:
            reach = 0.5 * (driver.LENGTH + kind.size[0]) + _GAP_M
            reach += max(0.0, 1.0 * speed + (speed - driver.speed) * 1.5) if driver.lane_number == number else 0.0
            if np.hypot(*(driver.position - place)) < reach:
                return False
        return True

    def _put(self, number: int, along: float, kind: VehicleType, speed_factor: float) -> None:
        driver = Driver(self._road, self._roads, number, along, kind, self._made, speed_factor)
        self._models.append(self._model(kind))
        self._made += 1
        goals = self._goals(number)
        driver.send_to(goals[int(self._rng.integers(len(goals)))] if goals else None)
        driver.speed = free_speed(path_ahead(driver, driver.lanes_ahead(AHEAD_M), along))
        self._road.vehicles.append(driver)

    def _model(self, kind: VehicleType) -> str:
        """Return the body model of the next vehicle, which needs no files of SUMO."""
        if self._fleet.varied:
            return self._fleet.model(kind, f"v{self._made}")
        models = generic_models_for(kind.label)
        return models[int(self._rng.integers(len(models)))]

    def _goals(self, number: int) -> list[int]:
        """Return the exits reachable from a lane, except at its own start."""
        start = self._roads.lanes[number].line[0]
        ends = [(goal, self._roads.lanes[goal].line[-1]) for goal in self._roads.exits]
        return [g for g, end in ends if np.hypot(*(end - start)) > 12.0 and self._roads.route(number, g) is not None]

    def _read(self) -> Actors:
        drivers = sorted(self._road.vehicles, key=lambda driver: driver.number)
        size = np.array([driver.kind.size for driver in drivers]).reshape(-1, 3)
        xy = to_world(np.array([driver.position for driver in drivers]).reshape(-1, 2))
        yaw = np.asarray(wrap_angle(-np.array([driver.heading for driver in drivers], np.float64)), np.float64)
        velocity, acceleration = self._changes(drivers, xy)
        return Actors(
            time_s=self._time_s,
            boxes=Boxes(
                center=np.column_stack([xy, 0.5 * size[:, 2]]),
                size=size,
                yaw=yaw,
                label=np.array([driver.kind.label_index for driver in drivers], np.int64),
                object_id=FIRST_ID + np.array([driver.number for driver in drivers], np.int64),
            ),
            pitch=np.zeros(len(drivers)),
            velocity=velocity,
            acceleration=acceleration,
            model=tuple(self._models[driver.number] for driver in drivers),
            name=tuple(f"v{driver.number}" for driver in drivers),
            signals=np.array([_signals(driver) for driver in drivers], np.int32),
            lane=tuple(self._lane(driver) for driver in drivers),
        )

    def _changes(
        self, drivers: list[Driver], xy: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (N, 2) velocities and accelerations from the last step, or from speed and heading in the first."""
        velocity, acceleration = np.zeros((2, len(drivers), 2))
        before, self._last = self._last, {}
        for row, driver in enumerate(drivers):
            velocity[row] = driver.speed * np.array([np.cos(driver.heading), -np.sin(driver.heading)])
            if driver.number in before:
                last_xy, last_velocity = before[driver.number]
                velocity[row] = (xy[row] - last_xy) / self.step_s
                if last_velocity is not None:
                    acceleration[row] = (velocity[row] - last_velocity) / self.step_s
            self._last[driver.number] = xy[row].copy(), velocity[row].copy()
        return velocity, acceleration

    def _lane(self, driver: Driver) -> str:
        """Return the name of the lane below a vehicle: its target lane, or the one it is still leaving.

        A placed one may be on any other lane, or off the lanes: "".
        """
        if driver.off_lanes or driver.number in self._placed:
            below = driver.lane_below()
            return "" if below is None else below.name
        nearest = self._roads.number(driver.lane_index)
        heading_for = self._roads.lanes[driver.lane_number]
        if nearest is not None and self._roads.lanes[nearest].edge == heading_for.edge:
            return self._roads.lanes[nearest].name
        return heading_for.name


def _signals(driver: Driver) -> int:
    """Return the lights of a vehicle: brake lights, and indicators of lane changes and turns."""
    lights = SIGNALS["brake light"] if driver.planned_mps2 < _BRAKES_MPS2 else 0
    lane = driver.roads.lanes[driver.lane_number]
    turn = 0.0
    if driver.lane_index[:2] == driver.target_lane_index[:2] and driver.lane_index != driver.target_lane_index:
        turn = float(driver.lane_index[2] - driver.target_lane_index[2])
    else:
        ahead = lane.along[-1] - driver.along
        numbers = [driver.lane_number] if lane.through_junction else driver.lanes_ahead(AHEAD_M)[1:2]
        for number in numbers if lane.through_junction or ahead < _TURN_AHEAD_M else ():
            heading = np.unwrap(driver.roads.lanes[number].heading)
            turn = float(heading[-1] - heading[0])
            if not driver.roads.lanes[number].through_junction or abs(turn) < _TURNS_RAD:
                turn = 0.0
    if turn == 0.0:
        return lights
    return lights | SIGNALS["left indicator" if turn > 0.0 else "right indicator"]
