"""SUMO traffic in process: the only module that imports libsumo."""

import contextlib
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sim.bodies.fleet import Fleet
from sim.bodies.vehicle_types import VehicleType
from sim.boxes import Boxes
from sim.errors import TrafficError
from sim.geometry import center_from_sumo
from sim.roads.network import Network
from sim.roads.networks import read_network, resolve_network
from sim.scenario import Scenario
from sim.traffic.base import PARKED, Actors, DrivableTraffic, Limits, TrafficLight, check_command, check_place
from sim.traffic.parking import parked_cars
from sim.traffic.sumo.demand import write_demand
from sim.traffic.sumo.input import check_signals, signals_xml, sumo_options
from sim.traffic.sumo.lane_path import LanePaths
from sim.traffic.sumo.motion import BodyMotion
from sim.traffic.sumo.placed import SUMO_SPEED_MODE, PlacedVehicles
from sim.traffic.sumo.red_light import red_light_speed

FIRST_ID = 1000
"""Object id of the first road user that appears."""

# Bits of SUMO's speed mode: keep the limit of acceleration (2), ignore the right of way also inside a junction (32);
# without the safe speed (1) and the right of way (8), missed road users have consequences. SUMO's limit of braking (4)
# is the comfortable one: `_advance` applies the emergency deceleration instead. SUMO's stop at red lights (16) is left
# out too: without the safe speed it brakes at 14 m/s2.
_OWN_SPEED_MODE = 2 | 32

_LIGHT_STATES: dict[str, Literal["red", "red and yellow", "yellow", "green"]] = {
    "r": "red", "u": "red and yellow", "y": "yellow", "Y": "yellow", "g": "green", "G": "green",
}  # fmt: skip

_running = threading.Lock()


@dataclass(frozen=True, slots=True)
class _RoadUser:
    """Constant properties of a road user."""

    object_id: int
    name: str
    kind: VehicleType
    model: str
    is_person: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Constants:
    """Constant properties of all road users so far, in columns.

    Attributes:
        size: (N, 3) m.
        label: (N,) class.
        is_person: (N,).
    """

    size: NDArray[np.float64]
    label: NDArray[np.int64]
    is_person: NDArray[np.bool_]

    def of(self, users: dict[str, _RoadUser]) -> "_Constants":
        """Return the columns of road users: these, as long as none has come."""
        if len(users) == len(self.label):
            return self
        return _Constants(
            size=np.array([user.kind.size for user in users.values()], dtype=np.float64).reshape(-1, 3),
            label=np.array([user.kind.label_index for user in users.values()], dtype=np.int64),
            is_person=np.array([user.is_person for user in users.values()], dtype=bool),
        )


class SumoTraffic(DrivableTraffic):
    """Running SUMO simulation of a scenario: `with SumoTraffic(scenario, seed) as traffic: traffic.step()`.

    libsumo holds one simulation per process and silently replaces it by a second; here a second one is an error.

    Args:
        scenario: scenario to simulate; the constructor runs its warm-up.
        seed: root seed of trips, drivers and body models; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: network or demand is invalid.
        TrafficError: a simulation already runs in this process, or SUMO refuses the input.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.step_s = scenario.step_s
        self._seed = seed
        self._fleet = Fleet.of(scenario, seed)
        self._placed = PlacedVehicles()
        self._users: dict[str, _RoadUser] = {}  # in the order of their ids
        self._constants = _Constants(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, bool))
        self._motion = BodyMotion(scenario.step_s)
        self._commanded: dict[str, float] = {}
        self._actors: Actors | None = None
        self._open = False
        network = resolve_network(scenario, seed)
        if not _running.acquire(blocking=False):
            raise TrafficError(
                "a SUMO simulation already runs in this process and libsumo holds only one: close it first, or use "
                "another process"
            )
        self._open = True
        try:
            self._start(scenario, network)
            self._warm_up(round(scenario.warmup_s / scenario.step_s))
        except BaseException:
            self.close()
            raise

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        if self._actors is None:
            raise TrafficError("this SUMO simulation is closed")
        return self._actors

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors."""
        self._advance()
        self._actors = self._read()
        return self._actors

    def close(self) -> None:
        """End the simulation; a new one may start in this process afterwards."""
        if not self._open:
            return
        self._open = False
        self._actors = None
        try:
            self._sumo.close()
        finally:
            _running.release()

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive a vehicle, see `DrivableTraffic.command`; it stops at red lights whatever the command."""
        check_command(speed_mps)
        name = self._vehicle(object_id)
        if speed_mps is None:
            self._placed.release(self._sumo, name)
            self._sumo.vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
            self._sumo.vehicle.setSpeed(name, -1.0)
            self._commanded.pop(name, None)
            return
        if name not in self._commanded or name in self._placed:
            self._placed.release(self._sumo, name)
            self._sumo.vehicle.setSpeedMode(name, _OWN_SPEED_MODE)
        self._commanded[name] = float(speed_mps)

    def place(self, object_id: int, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Put a vehicle somewhere, see `DrivableTraffic.place`; SUMO hardly sees it there, `YieldShim` does."""
        check_place(xy, yaw, speed_mps)
        name = self._vehicle(object_id)
        front = np.asarray(xy) + 0.5 * self._users[name].kind.size[0] * np.array([np.cos(yaw), np.sin(yaw)])
        self._placed.put(self._sumo, name, front, yaw, float(speed_mps))
        self._commanded[name] = float(speed_mps)

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the (K, 2) world polyline that a vehicle will follow, from its centre over the next `ahead_m` m."""
        name = self._vehicle(object_id)
        centre = self.actors.boxes.center[self.actors.row(object_id), :2]
        return self._paths.path(name, centre, ahead_m)

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of a vehicle: its speed along its lane, m/s."""
        return float(self._sumo.vehicle.getSpeed(self._vehicle(object_id)))

    def limits(self, object_id: int) -> Limits:
        """Return the limits of a vehicle where it is; its driver's share of the speed limit is included."""
        name = self._vehicle(object_id)
        strongest, _, emergency = self._users[name].kind.accel_mps2
        return Limits(float(self._sumo.vehicle.getAllowedSpeed(name)), strongest, emergency)

    def signals(self, object_id: int) -> tuple[TrafficLight, ...]:
        """Return the traffic lights on the route of a vehicle, nearest first."""
        lights = self._sumo.vehicle.getNextTLS(self._vehicle(object_id))
        return tuple(TrafficLight(_LIGHT_STATES.get(state, "off"), float(gap_m)) for _, _, gap_m, state in lights)

    def _vehicle(self, object_id: int) -> str:
        row = self.actors.row(object_id)
        name = self.actors.name[row]
        if self._users[name].is_person:
            raise TrafficError(f"object {object_id} is a pedestrian, which has no lane and takes no speed")
        if name in self._parked.name:
            raise TrafficError(f"object {object_id} is parked and takes no speed")
        return name

    def _start(self, scenario: Scenario, network: Path) -> None:
        # Beside pyarrow it prints a warning, which is no result of a command.
        with contextlib.redirect_stdout(sys.stderr):
            import libsumo

        self._sumo: Any = libsumo
        self._paths = LanePaths(libsumo)
        with tempfile.TemporaryDirectory(prefix="dsrc-traffic-") as folder:
            net = read_network(network)
            check_signals(scenario, net)
            self._park(scenario, net)
            routes = write_demand(scenario, net, self._seed, Path(folder) / "demand.rou.xml")
            command = [
                "sumo",
                "--net-file",
                str(network),
                "--route-files",
                str(routes),
                *sumo_options(scenario, self._seed),
            ]
            if scenario.network.signals:
                extra = Path(folder) / "signals.add.xml"
                extra.write_text(signals_xml(scenario.network.signals), encoding="utf-8")
                command += ["--additional-files", str(extra)]
            try:
                libsumo.start(command)
            except Exception as error:  # libsumo's own classes differ between versions
                text = " ".join(str(error).split())
                raise TrafficError(f"{scenario.name}: SUMO does not start: {text}") from None

    def _park(self, scenario: Scenario, net: Network) -> None:
        """Give the parked cars the first ids; they are not in SUMO."""
        cars = parked_cars(scenario, net, self._seed)
        users: list[_RoadUser] = []
        for kind in cars.kind:
            name = f"{PARKED}{len(users)}"
            model = self._fleet.model(kind, name)
            users.append(_RoadUser(FIRST_ID + len(users), name, kind, model, is_person=False))
        self._users |= {user.name: user for user in users}
        size = np.array([user.kind.size for user in users], dtype=np.float64).reshape(-1, 3)
        none, zero = np.zeros(len(users)), np.zeros((len(users), 2))
        self._parked = Actors(
            time_s=0.0,
            boxes=Boxes(
                center=cars.base + np.array([0.0, 0.0, 0.5]) * size,
                size=size,
                yaw=cars.yaw,
                label=np.array([user.kind.label_index for user in users], dtype=np.int64),
                object_id=np.array([user.object_id for user in users], dtype=np.int64),
            ),
            pitch=none,
            velocity=zero,
            acceleration=zero,
            model=tuple(user.model for user in users),
            name=tuple(user.name for user in users),
            signals=none.astype(np.int32),
            lane=("",) * len(users),
        )

    def _warm_up(self, steps: int) -> None:
        for remaining in reversed(range(steps)):
            if remaining < 2:
                self._read()  # so that the first velocities and accelerations are differences of positions too
            self._advance()
        self._actors = self._read()

    def _advance(self) -> None:
        if not self._open:
            raise TrafficError("this SUMO simulation is closed")
        for name, speed_mps in self._commanded.items():
            if name in self._placed:
                continue
            _, comfortable, emergency = self._users[name].kind.accel_mps2
            limit_mps = red_light_speed(self._sumo, name, comfortable, self.step_s)
            least_mps = self._sumo.vehicle.getSpeed(name) - emergency * self.step_s
            self._sumo.vehicle.setSpeed(name, max(min(speed_mps, limit_mps), least_mps, 0.0))
        placed = self._placed.move(self._sumo)
        for name in placed:
            self._motion.lift(self._users[name].object_id - FIRST_ID)
        if (placed or self._placed.yielding) and self._actors is not None:
            drivers = self._undriven(self._actors)
            self._placed.slow_others(self._sumo, self._actors, drivers, self.route, self.limits, self.step_s)
        try:
            self._sumo.simulationStep()
        except Exception as error:  # see _start
            raise TrafficError(f"SUMO stopped: {' '.join(str(error).split())}") from None
        for name in self._sumo.simulation.getDepartedIDList():
            self._welcome(name, self._sumo.vehicle.getTypeID(name), is_person=False)
        for name in self._sumo.simulation.getDepartedPersonIDList():
            self._welcome(name, self._sumo.person.getTypeID(name), is_person=True)
        for name in self._sumo.simulation.getArrivedIDList():
            self._commanded.pop(name, None)
            self._placed.remove(name)

    def _undriven(self, actors: Actors) -> list[int]:
        not_free = self._commanded.keys() | set(self._parked.name)
        rows = [row for row, name in enumerate(actors.name) if name not in not_free and not self._users[name].is_person]
        return [int(object_id) for object_id in actors.boxes.object_id[rows]]

    def _welcome(self, name: str, type_id: str, *, is_person: bool) -> None:
        if name in self._users:  # it departs again and keeps its number
            self._motion.forget(self._users[name].object_id - FIRST_ID)
            return
        kind = self._fleet.by_id(type_id)
        model = self._fleet.model(kind, name)
        self._users[name] = _RoadUser(FIRST_ID + len(self._users), name, kind, model, is_person)

    def _read(self) -> Actors:
        """Return the current actors, by plain getters: in process they are faster than subscriptions."""
        vehicle, person = self._sumo.vehicle, self._sumo.person
        users = [self._users[name] for name in (*vehicle.getIDList(), *person.getIDList())]
        users.sort(key=lambda user: user.object_id)
        names = tuple(user.name for user in users)
        numbers = np.array([user.object_id for user in users], dtype=np.int64) - FIRST_ID
        self._constants = constants = self._constants.of(self._users)
        size, is_person = constants.size[numbers], constants.is_person[numbers]
        place, angle, slope = np.zeros((len(users), 3)), np.zeros(len(users)), np.zeros(len(users))
        signals, lanes = np.zeros(len(users), np.int32), np.zeros(len(users), object)
        for domain, rows in ((vehicle, np.flatnonzero(~is_person)), (person, np.flatnonzero(is_person))):
            those = [names[row] for row in rows.tolist()]
            place[rows] = np.array([domain.getPosition3D(name) for name in those]).reshape(-1, 3)
            angle[rows] = [domain.getAngle(name) for name in those]
            slope[rows] = [domain.getSlope(name) for name in those]
            lanes[rows] = [domain.getLaneID(name) for name in those]
            if domain is vehicle:
                signals[rows] = [domain.getSignals(name) for name in those]
        self._motion.make_room(len(self._users))
        trails = np.flatnonzero(~is_person)
        angle[trails] = self._motion.follow(numbers[trails], place[trails, :2], angle[trails], size[trails, 0])
        # SUMO's reference is the front bumper of a vehicle but the middle of a person.
        base, yaw, pitch = center_from_sumo(place, angle, slope, np.where(is_person, 0.0, size[:, 0]))
        velocity, acceleration = self._velocities(users, numbers, base[:, :2], yaw)
        moving = Actors(
            time_s=round(self._sumo.simulation.getTime(), 6),
            boxes=Boxes(
                center=base + np.array([0.0, 0.0, 0.5]) * size,
                size=size,
                yaw=yaw,
                label=constants.label[numbers],
                object_id=numbers + FIRST_ID,
            ),
            pitch=pitch,
            velocity=velocity,
            acceleration=acceleration,
            model=tuple(user.model for user in users),
            name=names,
            signals=signals,
            lane=tuple(lanes.tolist()),
        )
        return self._parked.joined(moving) if len(self._parked) else moving

    def _velocities(
        self, users: list[_RoadUser], numbers: NDArray[np.int64], xy: NDArray[np.float64], yaw: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (N, 2) velocities, m/s, of the first step by speed and heading, and accelerations, m/s2."""
        speed = np.zeros(len(users))
        for row in np.flatnonzero(self._motion.is_new(numbers)):
            domain = self._sumo.person if users[row].is_person else self._sumo.vehicle
            speed[row] = domain.getSpeed(users[row].name)
        first = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        return self._motion.velocities(numbers, xy, first)
