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
        stop_m: distance along it of the end of the approach lane, m.
        kerb_side: -1 where traffic keeps right, 1 where it keeps left.
    """

    path: ReferencePath
    stop_m: float
    kerb_side: float = -1.0


def lane_paths_of(name: str, net: Network, given: Mapping[str, Sequence[str]]) -> dict[str, LanePath]:
    """Return the paths of roles through a junction, from (approach lane, exit lane) of each.

    Args:
        name: of the scenario, for messages.
        given: role -> ids of two lanes, the second reached from the first.

    Raises:
        ScenarioError: a lane does not exist or does not lead to the other.
    """
    lanes = {lane.getID(): lane for edge in net.getEdges() for lane in edge.getLanes()}
    found = {}
    for role, pair in given.items():
        field = f"conflict.streets.{role}"
        if len(pair) != 2:
            raise ScenarioError(complaint(name, field, "two lanes, before and after a junction", list(pair)))
        for lane_id in pair:
            if lane_id not in lanes:
                raise ScenarioError(
                    complaint(name, field, "lanes of the network", f"'{lane_id}'", did_you_mean(lane_id, lanes))
                )
        start, end = (lanes[lane_id] for lane_id in pair)
        link = next((link for link in start.getOutgoing() if link.getToLane() is end), None)
        if link is None:
            reached = [link.getToLane().getID() for link in start.getOutgoing()]
            hint = did_you_mean(end.getID(), reached)
            raise ScenarioError(complaint(name, field, f"a lane that {start.getID()} leads to", end.getID(), hint))
        before, after = _shape(start), _shape(end)
        first, last = start, end
        while _length(before) < BEFORE_M and (back := _straightest(first.getIncoming(), before[0], first)) is not None:
            first = back
            via = next(link for link in back.getOutgoing() if link.getToLane() is not None and _leads(link, before[0]))
            before = np.concatenate([_shape(back), _inside(net, via), before])
        while _length(after) < AFTER_M and (links := last.getOutgoing()):
            link_on = min(links, key=lambda link: _bend(last, link.getToLane()))
            last = link_on.getToLane()
            after = np.concatenate([after, _inside(net, link_on), _shape(last)])
        path = ReferencePath.through(np.concatenate([before, _inside(net, link), after]), 6.0)
        found[role] = LanePath(path, path.nearest(before[-1, :2]), net.kerb_side)
    return found


def meeting(one: ReferencePath, other: ReferencePath) -> Array:
    """Return the (2,) first crossing of two paths, along the first one; without a crossing, the middle of the gap."""
    lines = [shapely.LineString(path.points[:, :2]) for path in (one, other)]
    crossing = shapely.get_coordinates(lines[0] & lines[1])
    if len(crossing):
        return min(crossing, key=one.nearest)
    return shapely.get_coordinates(shapely.shortest_line(*lines)).mean(axis=0)


def _shape(lane: RoadLane) -> Array:
    return np.array(lane.getShape3D(), np.float64)


def _inside(net: Network, link: Link) -> Array:
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
    real = [back for back in real if any(_leads(link, place) for link in back.getOutgoing())]
    return min(real, key=lambda back: _bend(back, lane), default=None)
