"""Lanes ahead of road users: of a SUMO network, or of the ego's own route where there is no map."""

import math
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from dsrc.closed_loop.driving.path import STEP_M, Path
from dsrc.closed_loop.types import ConflictLane, LaneMap
from sim.encounters import network_file
from sim.geometry import Array
from sim.roads.network import Lane as RoadLane
from sim.roads.network import Network
from sim.roads.networks import names_network, read_network
from sim.scenario import Scenario

LANE_STEP_M = 1.0
"""Distance between points of a lane ahead, m, see `LaneMap`."""

_BESIDE_M = 2.6
_ALIKE_M = 0.9
_DIRECTION = math.cos(math.radians(40.0))
_NEAREST = 16
_AHEAD_M = 200.0
_LENGTH_M = 10.0
_FORKS = 4
_MEETS_M = 1.6
"""Distance of a lane's centre from a path, from which on it meets it: half of a narrow lane, m."""
_BEHIND_M = 3.0
"""Part of a path on which the lane is found that it begins on, m."""
_UPSTREAM_M, _BEYOND_M = 150.0, 30.0
_MINOR = "mswy"
"""States of SUMO's connections without lights whose drivers give way: minor, stop, all-way stop, yield."""


class RouteLanes:
    """One lane: the ego's route, in both directions, kept at their distance from it by those beside it.

    Args:
        width_m: distance from the route within which road users follow its bends, m.
    """

    def __init__(self, path: Path, width_m: float = 9.0) -> None:
        every = round(LANE_STEP_M / STEP_M)
        self._line = np.column_stack([path.xy, path.heading])[::every]
        back = self._line[::-1].copy()
        back[:, 2] += np.pi
        self._back = back
        self._width_m = width_m

    def ahead(self, pose: Array, length_m: Array) -> list[tuple[Array, ...]]:
        """Return the route ahead of road users on it or beside it, see `LaneMap.ahead`."""
        offset = self._line[None, :, :2] - pose[:, None, :2]
        square = (offset**2).sum(-1)
        nearest = square.argmin(1)
        turned = np.cos(pose[:, 2] - self._line[nearest, 2])
        found: list[tuple[Array, ...]] = []
        for row, at in enumerate(nearest):
            beside = square[row, at] < self._width_m**2 and 0 < at < len(self._line) - 1
            need = math.ceil(length_m[row] / LANE_STEP_M) + 2
            if beside and turned[row] > 0.9:
                found.append((self._line[at : at + need],))
            elif beside and turned[row] < -0.9:
                back = len(self._line) - 1 - at
                found.append((self._back[back : back + need],))
            else:
                found.append(())
        return [tuple(line for line in lines if len(line) > 1) for lines in found]

    def conflicts(self, path: Array) -> tuple[ConflictLane, ...]:
        """Return no lane: a route alone tells none."""
        return ()


class NetworkLanes:
    """Lanes of a SUMO network, junctions included, without pavements."""

    def __init__(self, net: Network) -> None:
        lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
        lanes = [lane for lane in lanes if _driven(lane) and len(lane.getShape()) > 1]
        self._net = net
        self._lanes = {lane.getID(): lane for lane in lanes}
        self.lines = [_resampled(np.array(lane.getShape(), np.float64)[:, :2]) for lane in lanes]
        self._names = [lane.getID() for lane in lanes]
        self._number = {name: number for number, name in enumerate(self._names)}
        self._of = [row for row, line in enumerate(self.lines) for _ in line]
        self._at = [round(along / LANE_STEP_M) for line in self.lines for along in _along(line)]
        points = np.concatenate(self.lines)
        self._heading = points[:, 2]
        self._tree = cKDTree(points[:, :2])
        self._chains: dict[int, tuple[Array, ...]] = {}
        # Caches of the map's own go with it: a campaign drives hundreds of maps.
        self._ways_to = lru_cache(maxsize=10_000)(self._find_ways_to)
        self._cut = lru_cache(maxsize=100_000)(self._cut_ways)
        self._next = cache(self._find_next)

    def ahead(self, pose: Array, length_m: Array) -> list[tuple[Array, ...]]:
        """Return the lanes ahead, see `LaneMap.ahead`."""
        if not len(pose):
            return []
        k = min(_NEAREST, len(self._of))
        gaps, rows = self._tree.query(pose[:, :2], k=k, distance_upper_bound=_BESIDE_M)
        gaps, rows = np.asarray(gaps).reshape(-1, k), np.asarray(rows).reshape(-1, k)
        near = np.isfinite(gaps)
        rows = np.where(near, rows, 0)
        near &= np.cos(self._heading[rows] - pose[:, 2:]) > _DIRECTION
        gaps = np.where(near, gaps, np.inf)
        # Lanes of a junction lie on each other: all that are nearly as near count.
        near &= gaps < gaps.min(axis=1, keepdims=True) + _ALIKE_M
        best: list[dict[int, int]] = [{} for _ in pose]
        row, column = np.nonzero(near)  # nearest first
        for of, place in zip(row.tolist(), rows[row, column].tolist(), strict=True):
            best[of].setdefault(self._of[place], self._at[place])
        lengths = (_LENGTH_M * np.ceil((length_m + 2.0) / _LENGTH_M)).tolist()
        return [self._cut(tuple(places.items()), length) for places, length in zip(best, lengths, strict=True)]

    def conflicts(self, path: Array) -> tuple[ConflictLane, ...]:
        """Return the lanes that meet a path, see `LaneMap.conflicts`; those that leave it, and its own, are none."""
        rows = np.unique(np.concatenate(self._tree.query_ball_point(path[:, :2], _MEETS_M))).astype(np.int64)
        if not len(rows):
            return ()
        points = self._tree.data[rows]
        nearest = np.hypot(*(points[:, None] - path[:, :2]).transpose(2, 0, 1)).argmin(axis=1)
        along = np.cos(self._heading[rows] - path[nearest, 2]) > _DIRECTION
        ahead_m = _along(path)[nearest]
        met: dict[int, int] = {}
        for row, same_way, there_m in zip(rows.tolist(), along.tolist(), ahead_m.tolist(), strict=True):
            lane, at = self._of[row], self._at[row]
            if lane in met:
                continue
            own = same_way and (at == 0 or there_m < _BEHIND_M)
            met[lane] = -1 if own else at
        return tuple(way for lane, at in met.items() if at >= 0 for way in self._ways_to(lane, at))

    def _find_ways_to(self, number: int, at: int) -> tuple[ConflictLane, ...]:
        """Return the ways on which a station of a lane is reached."""
        name, line = self._names[number], self.lines[number]
        onward = self._onward(name, _BEYOND_M - (len(line) - at))[0]
        found = []
        for way in self._upstream(name, _UPSTREAM_M - at):
            names = [*way, name, *onward]
            points = np.concatenate([self.lines[self._number[one]][1 if k else 0 :] for k, one in enumerate(names)])
            speeds = [self._lanes[one].getSpeed() for one in names]
            counts = [len(self.lines[self._number[one]]) - (1 if k else 0) for k, one in enumerate(names)]
            meets = sum(counts[: len(way)]) + at - (1 if way else 0)
            first = max(meets - round(_UPSTREAM_M / LANE_STEP_M), 0)
            gives_way, signal = self._rule(way[-1], name) if way else (False, False)
            found.append(
                ConflictLane(
                    line=np.column_stack([points[first:, :2], np.unwrap(points[first:, 2])]),
                    speed_mps=np.repeat(np.array(speeds, np.float64), counts)[first:],
                    meets=meets - first,
                    gives_way=gives_way,
                    signal=signal,
                )
            )
        return tuple(found)

    def _upstream(self, name: str, left_m: float) -> list[list[str]]:
        """Return the sequences of lanes that lead to a lane, farthest first."""
        if left_m <= 0.0:
            return [[]]
        ways: list[list[str]] = []
        for before in self._before.get(name, ()):
            length = LANE_STEP_M * len(self.lines[self._number[before]])
            ways += [[*rest, before] for rest in self._upstream(before, left_m - length)]
            if len(ways) >= _FORKS:
                break
        return ways or [[]]

    @cached_property
    def _before(self) -> dict[str, tuple[str, ...]]:
        """Names of the lanes that lead to each lane."""
        found: dict[str, list[str]] = {}
        for name in self._names:
            for onward in self._next(name):
                found.setdefault(onward, []).append(name)
        return {name: tuple(before) for name, before in found.items()}

    def _rule(self, before: str, name: str) -> tuple[bool, bool]:
        """Return whether who drives from one lane to the next gives way by signs, and whether there are lights."""
        links = self._lanes[before].getOutgoing()
        states = [link.getState() for link in links if name in (link.getViaLaneID(), link.getToLane().getID())]
        signal = self._lanes[before].getEdge().getToNode().getType().startswith("traffic_light")
        return not signal and any(state in _MINOR for state in states), signal

    def _cut_ways(self, places: tuple[tuple[int, int], ...], length_m: float) -> tuple[Array, ...]:
        """Return the different ways on from stations of lanes."""
        need = round(length_m / LANE_STEP_M)
        cut = [chain[at : at + need] for lane, at in places for chain in self._ahead_of(lane)]
        return _different([line for line in cut if len(line) > 1])

    def _ahead_of(self, number: int) -> tuple[Array, ...]:
        """Return the ways on from the start of a lane: the lane and at least `_AHEAD_M` beyond it."""
        if number not in self._chains:
            ways = self._onward(self._names[number], _AHEAD_M)
            first = self.lines[number]
            joined = [np.concatenate([first, *(self.lines[self._number[name]][1:] for name in way)]) for way in ways]
            self._chains[number] = tuple(_resampled(line[:, :2]) for line in joined)
        return self._chains[number]

    def _onward(self, name: str, left_m: float) -> list[list[str]]:
        """Return the sequences of lanes that follow a lane."""
        if left_m <= 0.0:
            return [[]]
        ways: list[list[str]] = []
        for onward in self._next(name):
            length = LANE_STEP_M * len(self.lines[self._number[onward]])
            ways += [[onward, *rest] for rest in self._onward(onward, left_m - length)]
            if len(ways) >= _FORKS:
                break
        return ways or [[]]

    def _find_next(self, name: str) -> tuple[str, ...]:
        found = []
        for link in self._lanes[name].getOutgoing():
            onward = link.getViaLaneID() or link.getToLane().getID()
            if onward in self._number:
                found.append(onward)
        return tuple(dict.fromkeys(found))


@lru_cache(maxsize=4)
def _network_lanes(net: Network) -> NetworkLanes:
    return NetworkLanes(net)


def lanes_of(scenario: Scenario, seed: int) -> LaneMap | None:
    """Return the lanes of a scenario's network; None where it has none, as on roads of highway-env.

    Raises:
        ScenarioError: its network is invalid.
    """
    if scenario.network.highway_env or not (scenario.conflict or names_network(scenario)):
        return None
    return _network_lanes(read_network(network_file(scenario, seed)))


def _driven(lane: RoadLane) -> bool:
    """Return whether anything drives on a lane; internal lanes have permissions too."""
    if lane.getEdge().getFunction() in ("crossing", "walkingarea"):
        return False
    return any(lane.allows(kind) for kind in ("passenger", "delivery", "bus", "bicycle", "truck"))


def _resampled(line: Array) -> Array:
    """Return a polyline as (K, 3) points `LANE_STEP_M` apart, with headings; its end closes it, K >= 2."""
    step = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    at = np.append(np.arange(0.0, along[-1] - 0.1 * LANE_STEP_M, LANE_STEP_M), along[-1])
    at = at if len(at) > 1 else along[[0, -1]]
    xy = np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)
    slope = np.gradient(xy, axis=0)
    return np.column_stack([xy, np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))])


def _along(line: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])


def _different(lines: list[Array]) -> tuple[Array, ...]:
    """Return lines without those that go where another one does."""
    kept: list[Array] = []
    for line in lines:
        ends = [min(len(line), len(other)) - 1 for other in kept]
        if all(np.abs(line[e, :2] - other[e, :2]).max() > 1.5 for e, other in zip(ends, kept, strict=True)):
            kept.append(line)
    return tuple(kept[:_FORKS])
