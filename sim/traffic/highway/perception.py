"""Perception of drivers on highway-env's roads: bodies on the path, right of way, and the resulting acceleration.

Distances are measured along the path of a driver: points one metre apart from its position along the lanes of its
route.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.geometry import Array
from sim.traffic.highway.driver import Driver
from sim.traffic.highway.roads import LaneNetwork, to_world

AHEAD_M = 80.0
"""Look-ahead of drivers, m."""

_SPEED_UP_MPS2, _SLOW_MPS2, _HARD_MPS2 = 1.8, 2.0, 7.0
_EASY_MPS2 = 1.5
_COMMITTED_MPS2 = 5.0
"""Deceleration above which a driver no longer gives way, m/s2."""
_POINT_M = 1.0
_PASS_M = 3.9
_YIELD_MPS2 = 1.5
_PULLING_M = 0.9
_STANDING_GAP_M, _HEADWAY_S = 2.0, 1.3
_BESIDE_M = 0.5
_LINE_M = 1.5
"""Stopping distance before the common part of two paths, m."""
_CROSSING_S = 1.0
_FAR_S = 4.0
_MERGING_S = 2.0
_SHARP_RAD = np.radians(50.0)
_LOOK_M = 50.0
_ROUNDING_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class PathAhead:
    """Path ahead of a driver.

    Attributes:
        points: (K, 2) in the world, m, from the position of the vehicle.
        along: (K,) distance from there along the path, m.
        heading: (K,) rad.
        limit: (K,) highest speed, m/s.
        priority: (K,) priority of the lanes.
    """

    points: Array
    along: Array
    heading: Array
    limit: Array
    priority: NDArray[np.int64]


def path_ahead(driver: Driver, numbers: Sequence[int], start_m: float) -> PathAhead:
    """Return the path along lanes, from `start_m` m along the first of them."""
    here = to_world(driver.position)
    lanes = [driver.roads.lanes[number] for number in numbers]
    rows = [slice(int(np.searchsorted(lanes[0].along, start_m, side="right")), None)] + [slice(None)] * (len(lanes) - 1)
    cut = list(zip(lanes, rows, strict=True))
    line = np.concatenate([here[None], *(lane.line[part] for lane, part in cut)])
    heading = np.concatenate([[-driver.heading], *(lane.heading[part] for lane, part in cut)])
    own = [np.full(1, driver.desired_speed(lanes[0]))]
    speed = np.concatenate(
        [*own, *(np.minimum(lane.curve_mps[part], driver.desired_speed(lane)) for lane, part in cut)]
    )
    priority = np.concatenate([np.full(len(lane.line[part]), lane.priority) for lane, part in cut])
    step = np.hypot(*np.diff(line, axis=0).T)
    heading = np.unwrap(heading)
    bend = np.abs(np.diff(heading))
    # Where two lanes meet at an angle the path bends within their gap; the first steps may be a lane change.
    sharp = np.flatnonzero((bend > 0.2) & (np.arange(len(step)) > 3))
    speed[sharp + 1] = np.minimum(speed[sharp + 1], np.sqrt(2.5 * np.maximum(step[sharp], 4.0) / bend[sharp]))
    # Evenly spaced, because lanes may begin metres beside the end of their predecessors.
    known = np.concatenate([[0.0], np.cumsum(step)])
    along = np.arange(0.0, max(min(float(known[-1]), AHEAD_M), 1.0) + 1e-9, _POINT_M)
    owner = np.clip(np.searchsorted(known, along, side="right") - 1, 0, len(known) - 1)
    return PathAhead(
        points=np.column_stack([np.interp(along, known, line[:, axis]) for axis in (0, 1)]),
        along=along,
        heading=np.interp(along, known, heading),
        limit=np.interp(along, known, speed),
        priority=np.concatenate([[lanes[0].priority], priority])[owner],
    )


class Junction:
    """Right of way at junctions: drivers on disjoint junction lanes enter together."""

    def __init__(self, roads: LaneNetwork) -> None:
        """Find the conflicting junction lanes."""
        self._roads = roads
        self._granted: dict[int, int] = {}
        self._meets: set[tuple[int, int]] = set()
        inside = [number for number, lane in enumerate(roads.lanes) if lane.through_junction]
        for a in inside:
            for b in inside:
                if roads.lanes[a].index[0] != roads.lanes[b].index[0]:
                    one, two = roads.lanes[a].line, roads.lanes[b].line
                    away = np.hypot(one[:, None, 0] - two[None, :, 0], one[:, None, 1] - two[None, :, 1])
                    if away.min() < _PASS_M:
                        self._meets.add((a, b))

    def stops(self, drivers: Sequence[Driver]) -> Array:
        """Return (N,) distances from front bumpers to the stop lines of waiting drivers, inf for the others."""
        here = [driver for driver in drivers if not driver.off_lanes]
        self._forget(here)
        asking = sorted((entry for d in here if (entry := self._asks(d)) is not None), key=lambda entry: entry[:3])
        first_of_lane: set[int] = set()
        claimed: list[int] = []
        stops = np.full(len(drivers), np.inf)
        rows = {driver.number: row for row, driver in enumerate(drivers)}
        for _, away_m, number, driver, lane in asking:
            taken = [*self._granted.values(), *claimed]
            is_first = driver.lane_number not in first_of_lane
            first_of_lane.add(driver.lane_number)
            if is_first and not any((lane, other) in self._meets for other in taken) and self._has_room(lane, here):
                self._granted[number] = lane
                continue
            stops[rows[number]] = max(away_m - 1.0, 0.05)
            if is_first and away_m < 2.5 * max(driver.speed, 2.0):
                claimed.append(lane)
        return stops

    def _asks(self, driver: Driver) -> tuple[int, float, int, Driver, int] | None:
        """Return (rank, distance, number, driver, lane) of a driver that waits for a grant, else None."""
        lane = self._roads.lanes[driver.lane_number]
        ahead = driver.lanes_ahead(_LOOK_M)
        if lane.through_junction or driver.number in self._granted or len(ahead) < 2:
            return None
        inside = self._roads.lanes[ahead[1]]
        away_m = float(lane.along[-1]) - driver.along - 0.5 * driver.LENGTH
        if not inside.through_junction or away_m > _LOOK_M:
            return None
        return -inside.priority, away_m, driver.number, driver, ahead[1]

    def _has_room(self, lane: int, drivers: Sequence[Driver]) -> bool:
        (after,) = self._roads.lanes[lane].after[:1] or (None,)
        return not any(d.lane_number == after and d.speed < 2.0 and d.along < 12.0 for d in drivers)

    def _forget(self, drivers: Sequence[Driver]) -> None:
        granted, self._granted = self._granted, {}
        for driver in drivers:
            if driver.number in granted:
                now = driver.lane_number
                # Who was placed on another lane through the junction takes that one.
                lane = now if self._roads.lanes[now].through_junction else granted[driver.number]
                if not _is_past(driver, lane):
                    self._granted[driver.number] = lane


def _is_past(driver: Driver, lane: int) -> bool:
    """Return whether the whole vehicle of a driver has left a junction lane, or no longer comes to it."""
    now, inside = driver.roads.lanes[driver.lane_number], driver.roads.lanes[lane]
    if now.index[0] == inside.index[1]:
        return driver.along > 0.5 * driver.LENGTH + 0.5
    return lane not in driver.lanes_ahead(_LOOK_M)


def decide(drivers: Sequence[Driver], step_s: float, junction: Junction) -> None:
    """Set the acceleration `planned_mps2` of every driver for the next step."""
    paths = [path_ahead(driver, driver.lanes_ahead(AHEAD_M), driver.along) for driver in drivers]
    outlines, owner = _outlines(drivers)
    velocity = np.array([d.speed * np.array([np.cos(d.heading), -np.sin(d.heading)]) for d in drivers]).reshape(-1, 2)
    stops = np.minimum(_stops(drivers, paths), junction.stops(drivers))
    for row, (driver, path) in enumerate(zip(drivers, paths, strict=True)):
        driver.path_ahead = path.points, path.along
        if driver.commanded is not None:
            wish = (driver.commanded - driver.speed) / step_s
            strongest, _, emergency = driver.kind.accel_mps2
            driver.planned_mps2 = min(max(wish, -emergency), strongest)
            continue
        planned_mps2 = min(_free(driver, path, stops[row]), _follow(row, driver, path, outlines, owner, velocity))
        current = driver.roads.number(driver.lane_index)
        if current is not None and current != driver.lane_number:
            # Between two lanes it follows the vehicle ahead on either.
            own = path_ahead(driver, [current], driver.roads.lanes[current].along_at(to_world(driver.position)))
            planned_mps2 = min(planned_mps2, _follow(row, driver, own, outlines, owner, velocity))
        if _has_neighbour(driver, drivers):
            planned_mps2 = min(planned_mps2, -_YIELD_MPS2)
        driver.planned_mps2 = min(max(float(planned_mps2), -_HARD_MPS2), _SPEED_UP_MPS2)


def _outlines(drivers: Sequence[Driver]) -> tuple[Array, NDArray[np.int64]]:
    """Return (M, 2) points around the bodies and the (M,) rows of their drivers."""
    points, owner = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for row, driver in enumerate(drivers):
        local = _outline(driver.LENGTH, driver.WIDTH)
        c, s = np.cos(-driver.heading), np.sin(-driver.heading)
        points.append(local @ np.array([[c, s], [-s, c]]) + to_world(driver.position))
        owner.append(np.full(len(local), row))
    return np.concatenate(points), np.concatenate(owner)


@lru_cache(maxsize=256)
def _outline(length_m: float, width_m: float) -> Array:
    """Return (K, 2) points around a body and along its middle, m."""
    along = np.linspace(-0.5, 0.5, max(3, int(np.ceil(length_m / 1.5)) + 1)) * length_m
    return np.concatenate([np.column_stack([along, np.full(len(along), y * width_m)]) for y in (-0.5, 0.0, 0.5)])


def free_speed(path: PathAhead) -> float:
    """Return the speed from which a driver can still slow down for every bend of the path, m/s."""
    return float(np.sqrt(path.limit**2 + 2.0 * _EASY_MPS2 * path.along).min())


def _free(driver: Driver, path: PathAhead, stop_m: float) -> float:
    """Return the free-road acceleration, with bends and a stop `stop_m` m ahead (inf: none)."""
    wanted = free_speed(path)
    stop_m = max(stop_m, 0.05)
    if np.isfinite(stop_m):
        wanted = min(wanted, float(np.sqrt(2.0 * _SLOW_MPS2 * stop_m)))
    planned_mps2 = _SPEED_UP_MPS2 * (1.0 - (driver.speed / max(wanted, 0.1)) ** 4)
    planned_mps2 = max(planned_mps2, -3.0)
    needed = driver.speed**2 / (2.0 * stop_m)
    return min(planned_mps2, -needed) if needed > _SLOW_MPS2 else planned_mps2


def _follow(
    row: int, driver: Driver, path: PathAhead, outlines: Array, owner: NDArray[np.int64], velocity: Array
) -> float:
    """Return the acceleration of the Intelligent Driver Model behind the first body on the path."""
    reach = 0.5 * driver.WIDTH + _BESIDE_M
    near = owner != row
    for axis in (0, 1):
        line, at = path.points[:, axis], outlines[:, axis]
        near &= (at > line.min() - reach - _ROUNDING_M) & (at < line.max() + reach + _ROUNDING_M)
        near &= np.abs(at - line[0]) < AHEAD_M
    points, whose = outlines[near], owner[near]
    if len(points) == 0:
        return np.inf
    away = np.hypot(path.points[:, None, 0] - points[None, :, 0], path.points[:, None, 1] - points[None, :, 1])
    place = away.argmin(axis=0)
    on_path = away[place, np.arange(len(points))] < reach
    on_path &= path.along[place] > 0.5 * driver.LENGTH - 0.5  # not beside it
    if not on_path.any():
        return np.inf
    first = np.flatnonzero(on_path)[path.along[place[on_path]].argmin()]
    at, other = place[first], whose[first]
    gap = max(float(path.along[at]) - 0.5 * driver.LENGTH, 0.1)
    its_speed = float(velocity[other] @ [np.cos(path.heading[at]), np.sin(path.heading[at])])
    closing = driver.speed - max(its_speed, 0.0)
    wish = _STANDING_GAP_M + max(
        0.0, driver.speed * _HEADWAY_S + driver.speed * closing / (2.0 * np.sqrt(_SPEED_UP_MPS2 * _SLOW_MPS2))
    )
    return _SPEED_UP_MPS2 * (1.0 - (wish / gap) ** 2)


def _stops(drivers: Sequence[Driver], paths: Sequence[PathAhead]) -> Array:
    """Return (N,) distances from front bumpers to the points where drivers give way, inf for the others."""
    stops = np.full(len(drivers), np.inf)
    if any(lane.through_junction for driver in drivers[:1] for lane in driver.roads.lanes):
        return stops  # see `Junction`
    near = _may_meet(drivers, paths)
    for i in range(len(drivers)):
        for j in (np.flatnonzero(near[i, i + 1 :]) + i + 1).tolist():
            far = np.abs(paths[i].points[0] - paths[j].points[0]).max() > 2.0 * _LOOK_M
            if far or drivers[i].off_lanes or drivers[j].off_lanes:
                continue
            who, stop_m = _gives_way(drivers[i], paths[i], drivers[j], paths[j])
            if who:
                row = i if who < 0 else j
                if drivers[row].must_leave:
                    # It needs room to pull out, and does not stop between two lanes.
                    stop_m = (
                        np.inf
                        if drivers[row].lateral_offset > _PULLING_M
                        else min(stop_m, max(drivers[row].merge_room_m, 0.05))
                    )
                stops[row] = min(stops[row], stop_m)
    return stops


def _may_meet(drivers: Sequence[Driver], paths: Sequence[PathAhead]) -> NDArray[np.bool_]:
    """Return (N, N) whether the boxes around two paths are as near as their vehicles are wide: most are not."""
    looked = [path.points[path.along < _LOOK_M] for path in paths]
    low = np.array([points.min(axis=0) for points in looked]).reshape(-1, 2)
    high = np.array([points.max(axis=0) for points in looked]).reshape(-1, 2)
    width = np.array([driver.WIDTH for driver in drivers])
    apart = (low[:, None] - high[None]).max(axis=2)
    return np.maximum(apart, apart.T) < _clearance(width[:, None], width[None]) + _ROUNDING_M


def _clearance(a: Any, b: Any) -> Any:
    """Return the distance of two paths below which vehicles of two widths meet, m."""
    return 0.5 * (a + b) + 0.3


def _gives_way(a: Driver, path_a: PathAhead, b: Driver, path_b: PathAhead) -> tuple[int, float]:
    """Return which of two drivers gives way (-1 first, 1 second, 0 neither) and the distance to the stop, m."""
    ka, kb = int(np.searchsorted(path_a.along, _LOOK_M)), int(np.searchsorted(path_b.along, _LOOK_M))
    away = np.hypot(
        path_a.points[:ka, None, 0] - path_b.points[None, :kb, 0],
        path_a.points[:ka, None, 1] - path_b.points[None, :kb, 1],
    )
    close = away < _clearance(a.WIDTH, b.WIDTH)
    if not close.any():
        return 0, np.inf
    rows, columns = np.flatnonzero(close.any(axis=1)), np.flatnonzero(close.any(axis=0))
    first = int(rows[0]), int(columns[0])
    distance = (
        float(path_a.along[first[0]]) - 0.5 * a.LENGTH - _LINE_M,
        float(path_b.along[first[1]]) - 0.5 * b.LENGTH - _LINE_M,
    )
    if 0 in first:
        return 0, np.inf  # one is there already, on the path of the other
    if min(distance) < -_LINE_M - 0.2:
        # One has begun to enter: the other waits if it still can.
        return (1, distance[1]) if distance[0] < distance[1] else (-1, distance[0])
    turn = abs((path_a.heading[first[0]] - path_b.heading[first[1]] + np.pi) % (2.0 * np.pi) - np.pi)
    order = (-path_a.priority[max(first[0] - 2, 0)], a.number), (-path_b.priority[max(first[1] - 2, 0)], b.number)
    enter = _time(a, distance[0]), _time(b, distance[1])
    leave = (
        _time(a, float(path_a.along[_last(rows)]) + 0.5 * a.LENGTH),
        _time(b, float(path_b.along[_last(columns)]) + 0.5 * b.LENGTH),
    )
    drivers = a, b
    early = 0 if enter[0] < enter[1] else 1
    late = 1 - early
    loser = late if order[0][0] == order[1][0] else int(order[1] > order[0])
    if loser == early:
        if turn < _SHARP_RAD:
            # The first needs the more room the faster the other approaches from behind.
            reached = min(
                np.sqrt(drivers[early].speed ** 2 + 3.0 * max(distance[early], 0.0)), drivers[early].desired_speed_here
            )
            free = enter[late] - enter[early] > _MERGING_S + max(0.0, drivers[late].speed - reached) / 4.0
        else:
            free = leave[early] + _CROSSING_S < enter[late]
    else:
        free = enter[late] > leave[early] + _FAR_S if turn >= _SHARP_RAD else enter[late] > enter[early] + _FAR_S
    if free:
        return 0, np.inf
    committed = [
        d.speed**2 / (2.0 * max(away_m, 0.05)) > _COMMITTED_MPS2 for d, away_m in zip(drivers, distance, strict=True)
    ]
    if committed[loser] and not committed[1 - loser]:
        loser = 1 - loser
    return (1, distance[1]) if loser else (-1, distance[0])


def _has_neighbour(driver: Driver, drivers: Sequence[Driver]) -> bool:
    if not driver.must_leave or driver.speed < 6.0:
        return False
    beside = driver.roads.number((*driver.target_lane_index[:2], driver.target_lane_index[2] - 1))
    at = driver.along
    return any(d.lane_number == beside and not d.off_lanes and -14.0 < d.along - at < 9.0 for d in drivers)


def _last(rows: NDArray[np.int64]) -> int:
    """Return the last of the consecutive rows from the first."""
    gaps = np.flatnonzero(np.diff(rows) > 1)
    return int(rows[gaps[0]] if len(gaps) else rows[-1])


def _time(driver: Driver, distance: float) -> float:
    """Return the time to cover a distance while accelerating to the desired speed, s."""
    top = max(driver.desired_speed_here, driver.speed, 1.0)
    until_top = (top - driver.speed) / 1.5
    gained = driver.speed * until_top + 0.75 * until_top**2
    if gained >= distance:
        return float((np.sqrt(driver.speed**2 + 3.0 * max(distance, 0.0)) - driver.speed) / 1.5)
    return until_top + (distance - gained) / top
