"""Data of the closed loop: what passes from sensing to tracking, planning, acting and judging at every step."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from dsrc.messages.message import Told
from dsrc.messages.seen_space import SeenSpace
from sim.boxes import Boxes
from sim.contact import Contact
from sim.radio import Link
from sim.rows import Rows
from sim.scenario import Scenario
from sim.traffic.base import Actors, Limits, TrafficLight


@dataclass(frozen=True, slots=True, eq=False)
class Percept:
    """Objects that a perception reports, world frame.

    Attributes:
        time_s: instant of the measurement, s; older than the present by the latency.
        boxes: N boxes with class; object ids of -1 unless it is the truth.
        score: (N,) confidence, 0 to 1.
        velocity: (N, 2) measured velocity, m/s; NaN where it is not measured.
        links: receptions of the helpers' messages.
        seen: seen space; None of a perception without sweeps, in logs, and once the driver has seen it.
        told: what became of the helpers' messages, in episodes with an attack or a defence.
    """

    time_s: float
    boxes: Boxes
    score: NDArray[np.float64]
    velocity: NDArray[np.float64]
    links: tuple[Link, ...] = ()
    seen: SeenSpace | None = None
    told: tuple[Told, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Tracks(Rows):
    """Confirmed tracks at the present, world frame, rows sorted by track number.

    Attributes:
        time_s: the present, s.
        boxes: N boxes; `object_id` is the number of the track.
        velocity: (N, 2) m/s.
        yaw_rate: (N,) rad/s.
        position_sd: (N,) standard deviation of the position, the larger axis, m.
        score: (N,) confidence of the track, 0 to 1.
        unseen_s: (N,) time since the last detection, s.
    """

    SHARED: ClassVar = ("time_s",)

    time_s: float
    boxes: Boxes
    velocity: NDArray[np.float64]
    yaw_rate: NDArray[np.float64]
    position_sd: NDArray[np.float64]
    score: NDArray[np.float64]
    unseen_s: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EgoState:
    """Ego as it knows itself without any perception of others: odometry, route, limits and traffic lights.

    Attributes:
        time_s: the present, s.
        box: one box, world frame.
        speed_mps: along its route, m/s.
        acceleration_mps2: change of the speed over the last step, m/s2.
        route: (K, 2) polyline that it will follow from its centre, world frame, m.
        limits: speed limit and limits of acceleration where it is.
        lights: traffic lights on its route, nearest first.
        progress_m: distance driven since the start, m.
    """

    time_s: float
    box: Boxes
    speed_mps: float
    acceleration_mps2: float
    route: NDArray[np.float64]
    limits: Limits
    lights: tuple[TrafficLight, ...]
    progress_m: float


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision of a driver for the next step.

    Attributes:
        acceleration_mps2: wanted change of speed, m/s2; the vehicle's limits bound it.
        reason: what decided: `free`, `follow`, `yield`, `signal`, `emergency`, `evade`, `creep` or `outside` for a
            policy's.
        track: number of the decisive track, -1 without one.
        steering_rad: angle of the front wheels, positive to the left, of an ego that steers a bicycle model; None of
            one that keeps its route, or returns to it at once.
    """

    acceleration_mps2: float
    reason: str = "outside"
    track: int = -1
    steering_rad: float | None = None


class Outcome(StrEnum):
    """End of an episode.

    Attributes:
        ARRIVED: reached its goal, or the end of its route.
        CRASHED: touched a road user or the world.
        STUCK: stood too long without a red light before it.
        TIMEOUT: the time was over before anything else happened.
        LEFT: left the road.
        PERCEPTION_FAILED: the perception raised an error, returned invalid boxes, or took too long.
        DRIVER_FAILED: the driver raised an error, decided nothing that can be done, or took too long.
        DESYNCHRONISED: never met its encounter; neither a success nor a failure.
    """

    ARRIVED = "arrived"
    CRASHED = "crashed"
    STUCK = "stuck"
    TIMEOUT = "timeout"
    LEFT = "left"
    PERCEPTION_FAILED = "perception failed"
    DRIVER_FAILED = "driver failed"
    DESYNCHRONISED = "desynchronised"


FAILED = (Outcome.PERCEPTION_FAILED, Outcome.DRIVER_FAILED)
"""Outcomes of episodes that say nothing of how the ego drives."""


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """Everything of one step of an episode.

    Attributes:
        actors: ground truth; no part of the driver sees it.
        ego: the ego as it knows itself; as it is, where its localisation has a fault.
        percept: newest percept that has arrived; None before the first and where no new one arrived in this step.
        tracks: tracks at the present.
        decision: decision for the step that follows.
        claims: false objects that helpers report, by the name of the helper.
        contact: first contact of the ego in the step before; None without one.
    """

    actors: Actors
    ego: EgoState
    percept: Percept | None
    tracks: Tracks
    decision: Decision
    claims: dict[str, Actors] = field(default_factory=dict)
    contact: Contact | None = None


class Perception(Protocol):
    """Perception of the ego.

    Attributes:
        cooperative: whether it uses messages of helpers.
    """

    cooperative: bool

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        ...

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the objects at `now`.

        Args:
            before: actors one traffic step ago.
            claims: false objects that helpers report now, by the name of the helper.
        """
        ...


class LaneMap(Protocol):
    """Map of lanes, all that a driver knows of the roads beside its own route."""

    def ahead(self, pose: NDArray[np.float64], length_m: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], ...]]:
        """Return the lanes ahead of road users, several where a lane forks, none off the lanes.

        Args:
            pose: (N, 3) x, y, m, and direction of motion, rad.
            length_m: (N,) least length, m; shorter where a lane ends.

        Returns:
            For each of them (K, 3) polylines x, y, heading, 1 m apart, K >= 2, from its nearest point on.
        """
        ...

    def conflicts(self, path: NDArray[np.float64]) -> tuple["ConflictLane", ...]:
        """Return the lanes that cross a path or merge into it.

        Args:
            path: (K, 3) x, y, m, heading, rad, of a road user's centre, from where it is, at steps of 1 m or less.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ConflictLane:
    """Lane that crosses a path or merges into it, with the lanes that lead to it; several where those fork.

    Attributes:
        line: (K, 3) centre line x, y, m, heading, rad, in the direction of travel, points about 1 m apart, from 150
            m before the lane meets the path, or from its beginning.
        speed_mps: (K,) limits along it, m/s.
        meets: row of the line where it first comes onto the path.
        gives_way: its drivers must give way at the junction where it does, by signs.
        signal: that junction has traffic lights.
    """

    line: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    meets: int
    gives_way: bool
    signal: bool


class Driver(Protocol):
    """Driver: from the ego's own state and its tracks to an acceleration, and to steering where it leaves its route."""

    def reset(self, lanes: LaneMap | None) -> None:
        """Begin an episode.

        Args:
            lanes: of its roads; None where there is no map of them.
        """
        ...

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return the decision for the next step."""
        ...


class SeeingDriver(Driver, Protocol):
    """Driver that also looks at the seen space."""

    def see(self, seen: SeenSpace) -> None:
        """Take the seen space of a percept that has arrived; `decide` follows."""
        ...
