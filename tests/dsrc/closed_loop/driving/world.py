"""A street without a simulator: the ego on its route and others who move as told, for the tests of drivers."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dsrc.closed_loop.types import Decision, Driver, EgoState, Tracks
from sim.boxes import CLASSES, Boxes
from sim.collisions import collide
from sim.traffic.base import Limits, TrafficLight

STEP_S = 0.1
CAR = (4.6, 1.85, 1.5)
STRAIGHT = np.array([[0.0, 0.0], [2000.0, 0.0]])


@dataclass
class Other:
    """Road user: where it is at first, its velocity and acceleration along it, when it appears and leaves."""

    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0
    brakes: float = 0.0
    label: str = "car"
    size: tuple[float, float, float] = CAR
    until_s: float = np.inf
    from_s: float = -np.inf

    def at(self, time_s: float) -> tuple[float, float, float, float]:
        speed = float(np.hypot(self.vx, self.vy))
        if speed == 0.0:
            return self.x, self.y, 0.0, 0.0
        stop_s = speed / self.brakes if self.brakes else np.inf
        t = min(time_s, stop_s)
        share = (t - 0.5 * self.brakes * t**2 / speed, 1.0 - self.brakes * t / speed)
        return self.x + self.vx * share[0], self.y + self.vy * share[0], self.vx * share[1], self.vy * share[1]


@dataclass
class Run:
    """Course of the ego: speeds, places, decisions, whether it touched anybody."""

    x: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    hit: bool = False

    @property
    def hardest(self) -> float:
        return -min(decision.acceleration_mps2 for decision in self.decisions)


def tracks_of(others: Sequence[Other], time_s: float) -> Tracks:
    """Return the road users at a time as tracks without error."""
    there = [(k, one) for k, one in enumerate(others) if one.from_s <= time_s < one.until_s]
    rows, velocity = np.zeros((len(there), 7)), np.zeros((len(there), 2))
    for row, (_, one) in enumerate(there):
        x, y, vx, vy = one.at(time_s)
        heading = np.arctan2(one.vy, one.vx) if one.vx or one.vy else 0.0
        rows[row], velocity[row] = (x, y, 0.5 * one.size[2], *one.size, heading), (vx, vy)
    label = [CLASSES.index(one.label) for _, one in there]
    n = np.zeros(len(there))
    boxes = Boxes.from_array(rows, np.array(label, np.int64), np.array([k for k, _ in there], np.int64))
    return Tracks(time_s, boxes, velocity, n, n, n + 1.0, n)


def ego_at(
    x: float,
    speed: float,
    time_s: float = 0.0,
    limit: float = 14.0,
    light: TrafficLight | None = None,
) -> EgoState:
    """Return the ego on its way east."""
    box = Boxes.from_array([[x, 0.0, 0.5 * CAR[2], *CAR, 0.0]])
    route = np.array([[x, 0.0], [x + 120.0, 0.0]])
    lights = () if light is None else (light,)
    return EgoState(time_s, box, speed, 0.0, route, Limits(limit, 2.6, 7.5), lights, x)


def run(
    driver: Driver,
    others: Sequence[Other] = (),
    speed: float = 14.0,
    seconds: float = 10.0,
    limit: float = 14.0,
    line_x: float | None = None,
    state: str = "red",
    green_s: float = np.inf,
) -> Run:
    """Drive east from x = 0 among others; with a light at `line_x` until it turns green."""
    out, x = Run(), 0.0
    driver.reset(None)
    for step in range(round(seconds / STEP_S)):
        time_s = step * STEP_S
        light = None
        if line_x is not None and x + 0.5 * CAR[0] <= line_x:
            now = "green" if time_s >= green_s else state
            light = TrafficLight(now, line_x - x - 0.5 * CAR[0])  # type: ignore[arg-type]
        ego, tracks = ego_at(x, speed, time_s, limit, light), tracks_of(others, time_s)
        out.hit |= bool(len(tracks) and collide(ego.box, tracks.boxes).any())
        out.x.append(x)
        out.speed.append(speed)
        decision = driver.decide(ego, tracks)
        out.decisions.append(decision)
        new = max(0.0, speed + min(max(decision.acceleration_mps2, -7.5), 2.6) * STEP_S)
        x, speed = x + 0.5 * (speed + new) * STEP_S, new
    return out
