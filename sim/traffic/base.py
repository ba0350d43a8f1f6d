"""Traffic protocols, and the table of actors that every backend yields."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.geometry import pose_matrix
from sim.rows import Rows, stacked

SIGNALS = {"right indicator": 1, "left indicator": 2, "hazard lights": 4, "brake light": 8}
"""Vehicle lights by name: bits of `Actors.signals`. SUMO sets others, which are not used."""

PARKED = "parked"
"""Name prefix of parked cars, which stand for the whole drive."""

POSITION_M, ANGLE_RAD, VELOCITY_MPS, ACCELERATION_MPS2, TIME_S = 1e-3, 1e-5, 1e-3, 1e-2, 1e-6
"""Resolution of recorded traffic: a log of whole numbers replays it bit for bit."""


def lit(signals: int) -> tuple[str, ...]:
    """Return the names of the lights that are on, in the order of `SIGNALS`."""
    return tuple(name for name, bit in SIGNALS.items() if signals & bit)


@dataclass(frozen=True, slots=True, eq=False)
class Actors(Rows):
    """Road users at one instant, world frame, rows sorted by object id.

    Attributes:
        time_s: simulation time, s.
        boxes: N boxes (geometric centre); label, object id (>= 1000) and size included.
        pitch: (N,) float64 rad, positive lowers the front; boxes ignore it, bodies and sensors do not.
        velocity: (N, 2) float64 m/s in the world, from the motion of the box centre.
        acceleration: (N, 2) float64 m/s2 in the world, the change of `velocity` since the step before; zero in the
            first step of an actor.
        model: (N,) names of body meshes, see `sim.bodies.choice`.
        name: (N,) names in the traffic simulation.
        signals: (N,) int32 bits of `SIGNALS`, as in SUMO.
        lane: (N,) ids of lanes in the road network, "" off the lanes.
        roll: (N,) float64 rad, positive lowers the right side; left out: zero. Boxes ignore it, as they do pitch.
    """

    SHARED: ClassVar = ("time_s",)

    time_s: float
    boxes: Boxes
    pitch: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    model: tuple[str, ...]
    name: tuple[str, ...]
    signals: NDArray[np.int32]
    lane: tuple[str, ...]
    roll: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if len(self.roll) == 0:
            object.__setattr__(self, "roll", np.zeros(len(self.boxes)))

    def world_from_body(self) -> NDArray[np.float64]:
        """Return (N, 4, 4) poses of the footprint centres at road level."""
        base = self.boxes.center.copy()
        base[:, 2] -= 0.5 * self.boxes.size[:, 2]
        return pose_matrix(base, self.boxes.yaw, self.pitch, self.roll)

    def row(self, object_id: int) -> int:
        """Return the row of an object; KeyError for an object that is not on the road."""
        row = int(np.searchsorted(self.boxes.object_id, object_id))
        if row == len(self) or self.boxes.object_id[row] != object_id:
            raise KeyError(object_id)
        return row

    def parked(self) -> NDArray[np.bool_]:
        """Return the (N,) mask of parked cars."""
        return np.array([name.startswith(PARKED) for name in self.name], bool)

    def joined(self, later: "Actors") -> "Actors":
        """Return these actors and later ones, whose ids are all higher, at the time of the later ones."""
        return replace(stacked(self, later), time_s=later.time_s)

    def rounded(self) -> Self:
        """Return the actors rounded to the recorded resolution (`POSITION_M` etc.); idempotent.

        Raises:
            ValueError: a value is not finite.
        """
        boxes = replace(
            self.boxes,
            center=snapped(self.boxes.center, POSITION_M),
            size=snapped(self.boxes.size, POSITION_M),
            yaw=snapped(self.boxes.yaw, ANGLE_RAD),
        )
        return replace(
            self,
            time_s=float(snapped(np.float64(self.time_s), TIME_S)),
            boxes=boxes,
            pitch=snapped(self.pitch, ANGLE_RAD),
            roll=snapped(self.roll, ANGLE_RAD),
            velocity=snapped(self.velocity, VELOCITY_MPS),
            acceleration=snapped(self.acceleration, ACCELERATION_MPS2),
        )


def snapped(values: NDArray[np.float64] | np.float64, step: float) -> NDArray[np.float64]:
    """Return values rounded to multiples of a step; ValueError for values that are not finite."""
    return from_steps(in_steps(values, step), step)


def in_steps(values: NDArray[np.float64] | np.float64, step: float) -> NDArray[np.int64]:
    """Return values as numbers of steps, rounded; ValueError for values that are not finite."""
    if not np.isfinite(values).all():
        raise ValueError("a position, angle, speed or acceleration in the traffic is not finite")
    return np.rint(np.asarray(values, np.float64) * round(1.0 / step)).astype(np.int64)


def from_steps(count: NDArray[np.int64], step: float) -> NDArray[np.float64]:
    """Return the values of numbers of steps: the float nearest to the decimal number."""
    return count / np.float64(round(1.0 / step))


class Traffic(Protocol):
    """Traffic backend: a context manager that moves all actors in steps of `step_s`. Backends inherit from it."""

    step_s: float

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        ...

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors."""
        ...

    def close(self) -> None:
        """End the simulation; further steps are an error."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a vehicle where it is.

    Attributes:
        speed_mps: highest speed allowed there, m/s.
        acceleration_mps2: strongest acceleration, m/s2.
        deceleration_mps2: full brake, m/s2: the emergency deceleration of its type, the same in every backend.
    """

    speed_mps: float
    acceleration_mps2: float
    deceleration_mps2: float

    def bounded(self, wanted_mps2: float) -> float:
        """Return the acceleration nearest to a wanted one that the vehicle is capable of, m/s2."""
        return min(max(wanted_mps2, -self.deceleration_mps2), self.acceleration_mps2)


@dataclass(frozen=True, slots=True)
class TrafficLight:
    """Traffic light ahead of a vehicle.

    Attributes:
        state: signal state.
        distance_m: from the front bumper to the stop line, m.
    """

    state: Literal["red", "red and yellow", "yellow", "green", "off"]
    distance_m: float


class DrivableTraffic(Traffic, Protocol):
    """Traffic whose vehicles can be driven from outside.

    All methods raise KeyError for an object that is not on the road, and TrafficError for one that cannot be driven: a
    pedestrian or a parked car.
    """

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive a vehicle at this speed from the next step on, as far as its `limits` of acceleration allow.

        It keeps its route and its lane; keeping distance and giving way are up to the caller. A placed vehicle goes on
        from where it is, or from the nearest place of its route if it is off the lanes.

        Args:
            object_id: a vehicle on the road.
            speed_mps: m/s >= 0; None gives the vehicle back to its driver or script.

        Raises:
            ValueError: the speed is negative or not finite.
        """
        ...

    def place(self, object_id: int, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Put a vehicle somewhere in the next step, on a lane or off, where it stays until it is placed again.

        Args:
            object_id: a vehicle on the road.
            xy: (2,) centre of its footprint, m.

        Raises:
            ValueError: a value is not finite.
        """
        ...

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of a vehicle: its speed along its lane, m/s."""
        ...

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the (K, 2) world polyline that a vehicle will follow, from its centre over the next `ahead_m` m."""
        ...

    def limits(self, object_id: int) -> Limits:
        """Return the limits of speed and acceleration of a vehicle where it is."""
        ...

    def signals(self, object_id: int) -> tuple[TrafficLight, ...]:
        """Return the traffic lights on the route of a vehicle, nearest first; empty where the backend has none."""
        self.speed(object_id)  # the errors of an object that cannot be driven
        return ()

    def goal_m(self, object_id: int) -> float | None:
        """Return the distance left to the goal of an encounter's ego, m, <= 0 when reached; None for all others."""
        self.speed(object_id)
        return None

    def encounter_gap_s(self, object_id: int) -> float | None:
        """Return how much later than its conflict actor an ego would arrive, when that no longer waited for it, s.

        Infinite as long as the conflict actor waits; None where there is none to meet: other backends, an encounter
        without it, or with one that is followed or stands.
        """
        self.speed(object_id)
        return None

    def claims(self) -> dict[str, Actors]:
        """Return the objects that helpers report now although they do not exist, by the name of the helper."""
        return {}


def check_command(speed_mps: float | None) -> None:
    """Raise ValueError unless a commanded speed is None, or finite and >= 0."""
    if speed_mps is not None and not (np.isfinite(speed_mps) and speed_mps >= 0.0):
        raise ValueError(f"speed_mps must be finite and >= 0, got {speed_mps}")


def check_place(xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
    """Raise ValueError unless a pose and its speed are finite."""
    if not np.isfinite([*xy, yaw, speed_mps]).all():
        raise ValueError(f"a place needs finite numbers, got {xy}, {yaw}, {speed_mps}")
