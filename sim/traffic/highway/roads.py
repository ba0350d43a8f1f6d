"""Lane networks of highway-env's environments: sampled lanes, successors, right of way.

highway-env's plane has x forward and y to the right (down on its screen), and headings turn clockwise: our world is
(x, -y) and our yaw is minus its heading. Lines here are in our world.
"""

import os
import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.errors import ScenarioError, did_you_mean
from sim.geometry import wrap_angle

LaneIndex = tuple[str, str, int]

SAMPLE_M = 1.0
"""Largest distance between points of a lane, m."""

_JOIN_M = 7.0
"""Largest gap between a lane and its successor, m: the exits of a roundabout begin at its border."""
_JOIN_RAD = np.radians(60.0)
_SIDE_MPS2 = 2.5

_LINES = ("none", "dashed", "solid", "solid")
"""Line styles by number of highway-env's `LineType`."""


@dataclass(frozen=True, slots=True)
class Environment:
    """Properties of an environment beside its lanes.

    Attributes:
        description: in a few words.
        changes_lanes: whether drivers change lanes.
        motorway: guard rails instead of kerbs and houses.
        unused: lanes without traffic, where roads overlap.
        longest_m: length at which lanes are cut off, m.
        first: lanes with right of way: `priority` as in highway-env, `circle` the round ones, `through` those that are
            not forbidden to change to.
    """

    description: str
    changes_lanes: bool = False
    motorway: bool = False
    unused: tuple[LaneIndex, ...] = ()
    longest_m: float = 800.0
    first: str = "priority"


ENVIRONMENTS: dict[str, Environment] = {
    "highway-v0": Environment("a motorway of four lanes", changes_lanes=True, motorway=True),
    "merge-v0": Environment("an on-ramp", changes_lanes=True, motorway=True, first="through"),
    "roundabout-v0": Environment("a roundabout of two lanes with four arms", first="circle"),
    "intersection-v0": Environment("a junction of four arms, one road with right of way"),
    "racetrack-v0": Environment("a closed track of two lanes"),
    # Overtaking goes along the lane of the oncoming traffic.
    "two-way-v0": Environment("a road with a lane in each direction", unused=(("a", "b", 0),)),
}
"""Supported environments of highway-env by id."""


@dataclass(frozen=True, slots=True, eq=False)
class RoadLane:
    """Lane of highway-env, sampled.

    Attributes:
        index: highway-env's (from, to, number from the left).
        count: lanes of its road, itself included.
        lane: the lane object of highway-env.
        line: (K, 2) centre line in the world, m, points `SAMPLE_M` apart at most.
        along: (K,) lengths along it in highway-env's coordinates, m.
        heading: (K,) in the world, rad.
        curve_mps: (K,) speed at which a bend is comfortable, m/s.
        width: m.
        limit: m/s.
        borders: line style of its left and right border: "none", "dashed" or "solid".
        priority: the higher one has right of way.
        after: numbers of its successors.
        middle: its centre line as a shape, with the ways from its end to its successors.
        through_junction: whether it crosses other lanes.
    """

    index: LaneIndex
    count: int
    lane: Any
    line: NDArray[np.float64]
    along: NDArray[np.float64]
    heading: NDArray[np.float64]
    curve_mps: NDArray[np.float64]
    width: float
    limit: float
    borders: tuple[str, str]
    priority: int
    after: tuple[int, ...]
    middle: shapely.Geometry
    through_junction: bool

    @property
    def name(self) -> str:
        """Name of the lane: its edge and its number from the right, as SUMO counts."""
        return f"{self.edge}_{self.count - 1 - self.index[2]}"

    def along_at(self, xy: NDArray[np.float64]) -> float:
        """Return the distance along the lane of a (2,) world position, m; highway-env's own wraps in long arcs."""
        row = int(self.squares(xy).argmin())
        forward = np.array([np.cos(self.heading[row]), np.sin(self.heading[row])])
        return float(self.along[row] + (xy - self.line[row]) @ forward)

    def squares(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (K,) squares of the distances of a (2,) world position from the points of the centre line, m2."""
        x, y = (self.line - xy).T
        return x * x + y * y

    def away_from(self, xy: NDArray[np.float64]) -> float:
        """Return the distance of a (2,) world position from the centre line, m."""
        return float(self.middle.distance(shapely.Point(xy)))

    def turn_from(self, xy: NDArray[np.float64], yaw: float) -> float:
        """Return the angle between the lane at a (2,) world position and a heading in the world, rad, in [0, pi]."""
        row = int(self.squares(xy).argmin())
        return abs(float(wrap_angle(self.heading[row] - yaw)))

    @property
    def edge(self) -> str:
        """Name of the road from one node to the next."""
        return f"{self.index[0]}-{self.index[1]}"


@dataclass(frozen=True, slots=True, eq=False)
class LaneNetwork:
    """Lane network of one environment.

    Attributes:
        network: the road network object of highway-env.
        objects: obstacles on the road, such as the end of a lane.
        lanes: lanes with traffic.
        unused: lanes without traffic, whose borders are painted all the same.
        changes_lanes: whether drivers change lanes.
        motorway: see `Environment`.
    """

    network: Any
    objects: tuple[Any, ...]
    lanes: tuple[RoadLane, ...]
    unused: tuple[RoadLane, ...]
    changes_lanes: bool
    motorway: bool

    @property
    def entries(self) -> tuple[int, ...]:
        """Numbers of the lanes without a predecessor."""
        reached = {number for lane in self.lanes for number in lane.after}
        return tuple(number for number in range(len(self.lanes)) if number not in reached)

    @property
    def exits(self) -> tuple[int, ...]:
        """Numbers of the lanes without a successor."""
        return tuple(number for number, lane in enumerate(self.lanes) if not lane.after)

    def number(self, index: LaneIndex) -> int | None:
        """Return the number of a lane; None for an unused one."""
        return next((number for number, lane in enumerate(self.lanes) if lane.index == tuple(index)), None)

    def route(self, start: int, goal: int | None) -> list[int] | None:
        """Return the route from a lane to another, without the first lane; None if there is no route.

        Without a goal it is the first successor alone.
        """
        if goal is None:
            return list(self.lanes[start].after[:1])
        before: dict[int, int] = {start: start}
        waiting = deque([start])
        while waiting and goal not in before:
            here = waiting.popleft()
            for number in self.lanes[here].after:
                if before.setdefault(number, here) == here and number != start:
                    waiting.append(number)
        if goal not in before:
            return None
        route: list[int] = []
        while goal != start:
            route.append(goal)
            goal = before[goal]
        return route[::-1]


def to_world(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert (..., 2) positions between highway-env's plane and the world, in either direction."""
    return np.asarray(xy, np.float64) * [1.0, -1.0]


@lru_cache(maxsize=8)
def read_roads(environment: str) -> LaneNetwork:
    """Read the lane network of an environment of highway-env.

    Raises:
        ScenarioError: there is no such environment, or highway-env is not installed.
    """
    if environment not in ENVIRONMENTS:
        hint = did_you_mean(environment, ENVIRONMENTS)
        raise ScenarioError(f"network.highway_env: expected an environment of highway-env, found '{environment}'{hint}")
    known = ENVIRONMENTS[environment]
    road = _road(environment)
    # Used lanes come first, so that their numbers are their rows.
    every = sorted(road.network.lanes_dict().items(), key=lambda entry: tuple(entry[0]) in known.unused)
    used = sum(tuple(index) not in known.unused for index, _ in every)
    found = every[:used]
    samples = [_samples(lane, min(float(lane.length), known.longest_m)) for _, lane in every]
    ends = [(line[0], line[-1], heading[0], heading[-1]) for line, _, heading in samples]
    after = [_after(number, found, ends) if number < used else () for number in range(len(every))]
    lanes = tuple(
        RoadLane(
            index=tuple(index),
            count=len(road.network.graph[index[0]][index[1]]),
            lane=lane,
            line=line,
            along=along,
            heading=heading,
            curve_mps=_comfortable(line, heading),
            width=float(lane.width_at(0.0)),
            limit=float(lane.speed_limit or 20.0),
            borders=(_LINES[int(lane.line_types[0])], _LINES[int(lane.line_types[1])]),
            priority=_priority(known.first, lane),
            after=after[number],
            middle=shapely.MultiLineString([line, *((line[-1], ends[other][0]) for other in after[number])]),
            through_junction=number < used and _crosses(number, samples[:used]),
        )
        for number, ((index, lane), (line, along, heading)) in enumerate(zip(every, samples, strict=True))
    )
    objects = tuple(road.objects)
    return LaneNetwork(road.network, objects, lanes[:used], lanes[used:], known.changes_lanes, known.motorway)


def _road(environment: str) -> Any:
    """Return highway-env's road of an environment; its vehicles are ignored."""
    # pygame, which highway-env imports, prints a greeting.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import gymnasium
        import highway_env  # noqa: F401  it registers its environments
    except ImportError as error:
        raise ScenarioError(f"network.highway_env: highway-env is not installed ({error})") from None
    # A separate class, because some environments change constants of their vehicle class for good.
    config = {"other_vehicles_type": "sim.traffic.highway.driver.EnvironmentVehicle"}
    with warnings.catch_warnings():
        # Newer versions of most environments differ in the search for neighbours only.
        warnings.simplefilter("ignore")
        env = gymnasium.make(environment, config=config, disable_env_checker=True)
        env.reset(seed=0)
    road = env.unwrapped.road  # type: ignore[attr-defined]
    env.close()
    return road


_Samples = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _samples(lane: Any, length: float) -> _Samples:
    """Return (K, 2) points, (K,) lengths along and (K,) headings of a lane in the world."""
    along = np.linspace(0.0, length, max(2, int(np.ceil(length / SAMPLE_M)) + 1))
    line = to_world(np.array([lane.position(s, 0.0) for s in along]))
    return line, along, -np.array([lane.heading_at(s) for s in along], np.float64)


def _comfortable(line: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    step = np.maximum(np.hypot(*np.diff(line, axis=0).T), 1e-6)
    bend = np.abs(np.diff(np.unwrap(heading))) / step
    bend = np.maximum(np.append(bend, bend[-1]), np.insert(bend, 0, bend[0]))
    return np.sqrt(_SIDE_MPS2 / np.maximum(bend, 1e-4))


def _priority(first: str, lane: Any) -> int:
    if first == "circle":
        return int(hasattr(lane, "radius"))
    return int(not lane.forbidden) if first == "through" else int(lane.priority)


def _after(number: int, found: Sequence[tuple[LaneIndex, object]], ends: Sequence[tuple]) -> tuple[int, ...]:
    """Return the successors of a lane: the nearest of each road that begins at its end."""
    (_, node, _), (_, end, _, heading) = found[number][0], ends[number]
    nearest: dict[str, tuple[float, int]] = {}
    for other, ((start_node, to, _), _) in enumerate(found):
        start, _, other_heading, _ = ends[other]
        away = float(np.hypot(*(start - end)))
        turn = abs((other_heading - heading + np.pi) % (2.0 * np.pi) - np.pi)
        if start_node == node and away < _JOIN_M and turn < _JOIN_RAD:
            nearest[to] = min(nearest.get(to, (np.inf, -1)), (away, other))
    return tuple(other for _, other in sorted(nearest.values()))


def _crosses(number: int, samples: Sequence[_Samples]) -> bool:
    """Return whether a lane crosses another at an angle between its ends, as only junction lanes do."""
    line, _, heading = samples[number]
    for other, (others, _, other_heading) in enumerate(samples):
        if other == number:
            continue
        away = np.hypot(line[:, None, 0] - others[None, :, 0], line[:, None, 1] - others[None, :, 1])
        turn = np.abs((heading[:, None] - other_heading[None, :] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        if ((away < 1.0) & (turn > np.radians(25.0))).any():
            return True
    return False
