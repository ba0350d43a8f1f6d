"""Paths along the lanes of a real network, for encounters on a map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from sim.encounters.paths import ReferencePath
from sim.errors import ScenarioError, complaint, did_you_mean
from sim.geometry import Array
from sim.roads.network import Lane as RoadLane
from sim.roads.network import Link, Network

BEFORE_M, AFTER_M = 160.0, 200.0
"""Length of paths before and after the junction, m, network permitting."""


@dataclass(frozen=True, slots=True, eq=False)
class LanePath:
    """Path through a junction.

    Attributes:
        path: path along the lanes.
        stop_m: distance along it of the end of the approach lane, m; of a single lane, which approaches nothing, of its
            start.
        kerb_side: -1 where traffic keeps right, 1 where it keeps left.
    """

    path: ReferencePath
    stop_m: float
    kerb_side: float = -1.0


def lane_paths_of(name: str, net: Network, given: Mapping[str, Sequence[str]]) -> dict[str, LanePath]:
    """Return the paths of roles through a junction, from (approach, exit) of each, or along one road.

    Args:
        name: of the scenario, for messages.
        given: role -> ids of two lanes or edges, the second reached from the first, or of one. Of the connections of
            two edges the first one counts, of a single edge the lane at the kerb, for cars where there are any.

    Raises:
        ScenarioError: a lane does not exist or does not lead to the other.
    """
    lanes: dict[str, list[RoadLane]] = {}
    for edge in net.getEdges():
        lanes[edge.getID()] = sorted(edge.getLanes(), key=lambda lane: not lane.allows("passenger"))
        lanes |= {lane.getID(): [lane] for lane in edge.getLanes()}
    found = {}
    for role, pair in given.items():
        field = f"conflict.streets.{role}"
        if len(pair) not in (1, 2):
            raise ScenarioError(complaint(name, field, "two lanes, before and after a junction", list(pair)))
        for lane_id in pair:
            if lane_id not in lanes:
                raise ScenarioError(
                    complaint(name, field, "lanes of the network", f"'{lane_id}'", did_you_mean(lane_id, lanes))
                )
        start, link = lanes[pair[0]][0], None
        if len(pair) == 2:
            links = [link for lane in lanes[pair[0]] for link in lane.getOutgoing()]
            link = next((link for link in links if link.getToLane() in lanes[pair[1]]), None)
            if link is None:
                reached = [link.getToLane().getID() for link in links]
                hint = did_you_mean(pair[1], reached)
                raise ScenarioError(complaint(name, field, f"a lane that {pair[0]} leads to", pair[1], hint))
            start = link.getFromLane()
        found[role] = lane_path(net, start, link)
    return found


def lane_path(net: Network, start: RoadLane, link: Link | None) -> LanePath:
    """Return the path along a lane and over a connection, continued in both directions."""
    before, nothing, first, last = _shape(start), np.zeros((0, 3)), start, start
    within, after, mark = nothing, nothing, before[0]
    if link is not None:
        mark = before[-1]
        last = link.getToLane()
        within, after = inside(net, link), _shape(last)
    while _length(before) < BEFORE_M and (back := _straightest(first.getIncoming(), before[0], first)) is not None:
        first = back
        via = next(link for link in back.getOutgoing() if link.getToLane() is not None and _leads(link, before[0]))
        before = np.concatenate([_shape(back), inside(net, via), before])
    while _length(after) < AFTER_M and (links := [one for one in last.getOutgoing() if one.getDirection() != "t"]):
        onward = min(links, key=lambda link: _bend(last, link.getToLane()))
        last = onward.getToLane()
        after = np.concatenate([after, inside(net, onward), _shape(last)])
    path = ReferencePath.through(np.concatenate([before, within, after]), 6.0)
    return LanePath(path, path.nearest(mark[:2]), net.kerb_side)


def meeting(one: ReferencePath, other: ReferencePath) -> Array:
    """Return the (2,) first crossing of two paths, along the first one; without a crossing, the middle of the gap."""
    lines = [shapely.LineString(path.points[:, :2]) for path in (one, other)]
    crossing = shapely.get_coordinates(lines[0] & lines[1])
    if len(crossing):
        return min(crossing, key=one.nearest)
    return shapely.get_coordinates(shapely.shortest_line(*lines)).mean(axis=0)


def _shape(lane: RoadLane) -> Array:
    return np.array(lane.getShape3D(), np.float64)


def inside(net: Network, link: Link) -> Array:
    """Return the (K, 3) line of a connection inside its junction, m; empty without one."""
    parts = [np.zeros((0, 3))]
    via = link.getViaLaneID()
    while via:
        lane = net.getLane(via)
        parts.append(_shape(lane))
        onward = [other.getViaLaneID() for other in lane.getOutgoing()]
        via = onward[0] if onward else ""
    return np.concatenate(parts)


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())


def _direction(line: Array) -> Array:
    step = line[1, :2] - line[0, :2]
    return step / max(float(np.hypot(*step)), 1e-9)


def _bend(lane: RoadLane, onward: RoadLane) -> float:
    """Return the turn from one lane into another, 1 - cos of the angle: 0 for straight on."""
    return 1.0 - float(_direction(_shape(lane)[-2:]) @ _direction(_shape(onward)[:2]))


def _leads(link: Link, place: Array) -> bool:
    return bool(np.hypot(*(_shape(link.getToLane())[0, :2] - place[:2])) < 0.1)


def _straightest(lanes: Sequence[RoadLane], place: Array, lane: RoadLane) -> RoadLane | None:
    """Return the straightest predecessor of a lane; None without any."""
    real = [back for back in lanes if not back.getID().startswith(":")]
    real = [
        back for back in real if any(_leads(link, place) and link.getDirection() != "t" for link in back.getOutgoing())
    ]
    return min(real, key=lambda back: _bend(back, lane), default=None)
