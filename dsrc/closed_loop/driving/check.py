"""Contract check of drivers, of one's own in particular, and a drive of each on made-up roads."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.driving.open import open_driver
from dsrc.closed_loop.driving.own.checked import CheckedDriver
from dsrc.closed_loop.driving.own.process import ProcessDriver
from dsrc.closed_loop.types import ConflictLane, Decision, EgoState, LaneMap, Percept, Tracks
from dsrc.messages.seen_space import SeenSpace, View
from sim.boxes import Boxes
from sim.errors import SettingsError, UserError, one_line
from sim.traffic.base import Limits, TrafficLight

_STEP_S, _CALL_S = 0.1, 60.0
_LIMITS = Limits(speed_mps=13.9, acceleration_mps2=2.6, deceleration_mps2=7.5)
_SIZE = np.array([4.5, 1.9, 1.6])
_FAST_MPS = 1.1 * _LIMITS.speed_mps


@dataclass(frozen=True, slots=True)
class _Road:
    """Straight road towards positive x, with at most one other on it or across it.

    Attributes:
        name: in messages.
        lasts_s: longest drive, s.
        speed_mps: of the ego at the start.
        place: x, y, m, and heading, rad, of the other at the start; None without one.
        moves_mps: its speed at the start.
        brakes: whether it brakes with 6 m/s2 from 2 s on.
        red_s: time until which a light at `line_m` is red; 0 without a light.
        least_m: least way that a driver makes here.
    """

    name: str
    lasts_s: float
    speed_mps: float
    place: tuple[float, float, float] | None = None
    moves_mps: float = 0.0
    brakes: bool = False
    red_s: float = 0.0
    least_m: float = 0.0

    line_m = 100.0

    def other(self, time_s: float) -> Tracks:
        """Return the track of the other, or none."""
        if self.place is None:
            return _tracks(time_s, np.zeros((0, 7)), np.zeros((0, 2)))
        x, y, yaw = self.place
        slow_s = min(max(time_s - 2.0, 0.0), self.moves_mps / 6.0) if self.brakes else 0.0
        way = self.moves_mps * time_s - 3.0 * slow_s**2
        if self.brakes and slow_s == self.moves_mps / 6.0:
            way = self.moves_mps * (2.0 + slow_s) - 3.0 * slow_s**2
        speed, ahead = self.moves_mps - 6.0 * slow_s, np.array([np.cos(yaw), np.sin(yaw)])
        box = [*(np.array([x, y]) + way * ahead), 0.8, *_SIZE, yaw]
        return _tracks(time_s, np.array([box]), speed * ahead[None])

    def ego(self, time_s: float, at_m: float, speed_mps: float, gained_mps2: float) -> EgoState:
        """Return the state of an ego at a place of the road."""
        left_m = self.line_m - at_m - 0.5 * _SIZE[0]
        light = TrafficLight("red" if time_s < self.red_s else "green", left_m)
        ahead = np.arange(0.0, 121.0, 5.0)
        return EgoState(
            time_s=time_s,
            box=Boxes.from_array([[at_m, 0.0, 0.8, *_SIZE, 0.0]], object_id=[1000]),
            speed_mps=speed_mps,
            acceleration_mps2=gained_mps2,
            route=np.stack([at_m + ahead, np.zeros(len(ahead))], axis=1),
            limits=_LIMITS,
            lights=(light,) if self.red_s and left_m > 0.0 else (),
            progress_m=at_m,
        )


_ROADS = (
    _Road("empty road", 15.0, 0.0, least_m=100.0),
    _Road("standing car", 15.0, _LIMITS.speed_mps, (120.0, 0.0, 0.0), least_m=60.0),
    _Road("slow car", 15.0, _LIMITS.speed_mps, (40.0, 0.0, 0.0), 5.0, least_m=60.0),
    _Road("braking car", 10.0, _LIMITS.speed_mps, (35.0, 0.0, 0.0), _LIMITS.speed_mps, brakes=True),
    _Road("crossing car", 15.0, _LIMITS.speed_mps, (80.0, -57.5, 0.5 * np.pi), 10.0, least_m=100.0),
    _Road("red light", 18.0, _LIMITS.speed_mps, red_s=10.0, least_m=110.0),
)


class _Map:
    """Lanes of a made-up road: whoever drives goes straight on; across the ego's way at x = 80 m comes one lane."""

    def ahead(self, pose: NDArray[np.float64], length_m: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], ...]]:
        """Return one lane ahead of each, see `LaneMap.ahead`."""
        return [(_line(x, y, yaw, float(m)),) for (x, y, yaw), m in zip(pose, length_m, strict=True)]

    def conflicts(self, path: NDArray[np.float64]) -> tuple[ConflictLane, ...]:
        """Return the lane across, see `LaneMap.conflicts`."""
        if not path[0, 0] < 80.0 < path[-1, 0]:
            return ()
        line = _line(80.0, -100.0, 0.5 * np.pi, 150.0)
        return (ConflictLane(line, np.full(len(line), _LIMITS.speed_mps), 98, gives_way=True, signal=False),)


def check_driver(driver: Any) -> tuple[str, ...]:
    """Check a driver against the contract of `dsrc.closed_loop.types.Driver`, and drive it on made-up roads.

    Checked are that it returns decisions with a finite acceleration, with a map of lanes and without, with a seen space
    if it has `see`, and the same ones after a `reset`. Then it drives straight roads for 10 to 18 s at a limit of
    13.9 m/s: empty, with a standing, a slow and a braking car, across a car that comes from the right at the same time,
    and to a light that is red for 10 s.

    Args:
        driver: an instance, a class made without arguments, or a text as `dsrc.closed_loop.driving.open.open_driver`
            takes it.

    Returns:
        What it does wrong on the roads, a line each; none for a driver that does nothing wrong there.

    Raises:
        SettingsError: one line per broken rule of the contract; or the driver does not open.
    """
    name = driver if isinstance(driver, str) else getattr(driver, "__name__", type(driver).__name__)
    made: Any = None
    try:
        made = open_driver(driver) if isinstance(driver, str) else driver() if isinstance(driver, type) else driver
        lacking = [method for method in ("reset", "decide") if not hasattr(made, method)]
        drives = [] if lacking else [_driven(made, road, _Map()) for road in _ROADS]
        failures = [f"{method}: expected a method, found none" for method in lacking] or list(_failures(made, drives))
        findings = tuple(line for drive in drives for line in _wrongs(drive))
    except UserError as error:
        failures = [str(error)]
    except Exception as error:  # code of one's own can fail in any way
        failures = [f"class: does not work: {type(error).__name__}: {one_line(error, 300)}"]
    finally:
        if isinstance(driver, str) and isinstance(made, ProcessDriver):
            made.close()
    if failures:
        raise SettingsError("\n".join(f"{name}: {line}" for line in failures))
    return findings


@dataclass(frozen=True, slots=True)
class _Drive:
    """Drive on a road: states of the ego by step, decisions, and why the driver failed."""

    road: _Road
    egos: list[EgoState]
    decisions: list[Decision]
    failure: str


def _driven(driver: Any, road: _Road, lanes: LaneMap | None, steps: int = 1000) -> _Drive:
    """Drive a road to its end, or until the ego touches the other, or for so many steps."""
    wheel = CheckedDriver(driver, _CALL_S)
    wheel.reset(lanes)
    at_m, speed, gained = 0.0, road.speed_mps, 0.0
    egos, decisions = list[EgoState](), list[Decision]()
    for step in range(min(steps, round(road.lasts_s / _STEP_S))):
        time_s = step * _STEP_S
        ego, tracks = road.ego(time_s, at_m, speed, gained), road.other(time_s)
        egos.append(ego)
        if wheel.failure or _touch(ego.box, tracks.boxes):
            break
        wheel.shown(_percept(ego, tracks))
        decisions.append(wheel.decide(ego, tracks))
        after = max(speed + _LIMITS.bounded(decisions[-1].acceleration_mps2) * _STEP_S, 0.0)
        at_m, gained, speed = at_m + 0.5 * (speed + after) * _STEP_S, (after - speed) / _STEP_S, after
    return _Drive(road, egos, decisions, wheel.failure)


def _failures(driver: Any, drives: list[_Drive]) -> Iterator[str]:
    """Yield a line for each broken rule of the contract.

    Args:
        drives: of all roads, with lanes.
    """
    standing = drives[1]
    bare = _driven(driver, standing.road, None, 10)
    found = {drive.failure: f"{drive.road.name}: {drive.failure}" for drive in reversed(drives) if drive.failure}
    if bare.failure and bare.failure not in found:
        found[bare.failure] = f"without lanes: {bare.failure}"
    yield from found.values()
    if found:
        return
    again = _driven(driver, standing.road, _Map(), 60)
    if again.decisions != standing.decisions[: len(again.decisions)]:
        yield "reset: expected the same decisions in the same drive after a reset, found others"


def _wrongs(drive: _Drive) -> Iterator[str]:
    """Yield what a driver did wrong on a road."""
    road = drive.road
    last = drive.egos[-1]
    if _touch(last.box, road.other(last.time_s).boxes):
        yield f"{road.name}: touches it at {last.speed_mps:.1f} m/s"
    elif last.progress_m < road.least_m:
        due = f"expected {road.least_m:.0f} m or more"
        yield f"{road.name}: drives {last.progress_m:.0f} m in {road.lasts_s:g} s, {due}"
    if (fastest := max(ego.speed_mps for ego in drive.egos)) > _FAST_MPS:
        yield f"{road.name}: drives {fastest:.1f} m/s at a limit of {_LIMITS.speed_mps:g} m/s"
    if any(ego.time_s < road.red_s and not ego.lights for ego in drive.egos):
        yield f"{road.name}: passes it"


def _tracks(time_s: float, boxes: NDArray[np.float64], velocity: NDArray[np.float64]) -> Tracks:
    n = len(boxes)
    numbered = Boxes.from_array(boxes, object_id=np.arange(1, n + 1))
    return Tracks(time_s, numbered, velocity, np.zeros(n), np.full(n, 0.2), np.ones(n), np.zeros(n))


def _percept(ego: EgoState, tracks: Tracks) -> Percept:
    """Return the percept of a step; nothing is hidden from the ego."""
    xy = ego.box.center[0, :2]
    seen = SeenSpace([lambda: View.everything(1000, ego.time_s, xy, 150.0)])
    return Percept(ego.time_s, tracks.boxes, tracks.score, tracks.velocity, seen=seen)


def _touch(ego: Boxes, others: Boxes) -> bool:
    """Whether boxes along the axes overlap."""
    along = np.abs(np.stack([np.cos(others.yaw), np.sin(others.yaw)], axis=1))
    extent = along * others.size[:, :1] + along[:, ::-1] * others.size[:, 1:2]
    apart = np.abs(others.center[:, :2] - ego.center[0, :2]) - 0.5 * (extent + ego.size[0, :2])
    return bool((apart < 0.0).all(axis=1).any())


def _line(x: float, y: float, yaw: float, length_m: float) -> NDArray[np.float64]:
    along = np.arange(0.0, max(length_m, 2.0) + 1.0)
    return np.stack([x + along * np.cos(yaw), y + along * np.sin(yaw), np.full(len(along), yaw)], axis=1)
