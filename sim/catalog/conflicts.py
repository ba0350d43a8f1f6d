"""Conflicts of a map, as candidates of encounters: who could cross whose way behind what."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import msgspec
import numpy as np
import shapely

from sim.encounters import own
from sim.encounters.lane_paths import LanePath, inside, lane_path
from sim.errors import ScenarioError, complaint
from sim.geometry import Array
from sim.roads.focus import beside_road
from sim.roads.network import Edge, Lane, Link, Network, Node
from sim.scenario import AgentRule, Drawn, EncounterSpec, PlacedSpec, RoadsideUnit, Scenario
from sim.streams import Stream, random_generator

_CAR = "passenger"
_FASTEST_MPS, _SLOWEST_MPS = 13.9, 4.5
_HIT_S = 6.6
"""Time of the way before the conflict point, with a reserve for the delay that is drawn, s."""
_TURN_MPS2 = 4.0
_OPPOSITE = -0.7
"""Cosine between two directions of approach up to which they are opposite."""
_BODY_M = 1.25
"""Half the width of a parked lorry, m."""
_KERB_M = 0.25
_BEFORE_LINE_M = 1.0
"""Gap between the first of a row of lorries and the stop line, m."""
_LORRY_M, _ROW = 9.5, 8
"""Length of a lorry with the gap behind it, m, and most of them: a shorter row hides nobody from an ego far away."""
_EMERGES_M, _RUNS_MPS = 2.8, 3.3
"""Way of a pedestrian in sight before the ego's, m, and the fastest that runs."""
_STREET_M, _TOWN_MPS = 130.0, 14.5
"""Length and limit of a street on which somebody crosses behind parked vans, least and most."""
_APART_M = 100.0
"""Street for each of them, m."""
_ALIKE = 2
"""Candidates of one kind and occluder at one place."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Conflict of a map.

    Attributes:
        kind: `crossing`, `merging`, `turn across` or `pedestrian`.
        hidden_by: `houses` that stand there, `queue`, `parked` vehicles or `lorry`.
        place: id of the junction, or of the edge.
        xy: conflict point or middle of the junction, m.
        scenario: encounter; None where the roads are too short for it.
    """

    kind: str
    hidden_by: str
    place: str
    xy: tuple[float, float]
    scenario: Scenario | None


@dataclass(frozen=True, slots=True)
class _Way:
    """Connection of two lanes with its path."""

    link: Link
    line: shapely.LineString
    ahead: Array

    @property
    def lane(self) -> Lane:
        return self.link.getFromLane()


def find_conflicts(base: Scenario, net: Network, seed: int) -> list[list[Candidate]]:
    """Return the candidates of each place of a map, the places in an order drawn from a seed.

    Args:
        base: scenario whose network, world, LiDARs and attribution the encounters take.

    Raises:
        ScenarioError: nothing on the map crosses, merges or has room for parked vehicles.
    """
    units = _Units(net)
    places = [*_junctions(base, net, units, seed), *_streets(base, net, units, seed)]
    places = [place for place in places if place]
    if not places:
        expected = "roads that cross or merge, or a street of a town with room to park"
        raise ScenarioError(complaint(base.name, "network", expected, "none"))
    order = random_generator(seed, Stream.ENCOUNTER_LAYOUT, 0, "mined").permutation(len(places))
    return [places[row] for row in order]


def _junctions(base: Scenario, net: Network, units: "_Units", seed: int) -> Iterator[list[Candidate]]:
    for node in sorted(net.getNodes(), key=lambda one: one.getID()):
        ways = list(_ways(net, node))
        if len({way.lane.getEdge().getID() for way in ways}) > 1:
            yield list(_at_junction(base, net, node, ways, units, seed))


def _ways(net: Network, node: Node) -> Iterator[_Way]:
    """Yield the connections of a junction for cars, one for each pair of edges and lane."""
    for edge in node.getIncoming():
        for lane in edge.getLanes() if not edge.getID().startswith(":") else ():
            for link in lane.getOutgoing() if lane.allows(_CAR) else ():
                if not link.getToLane().allows(_CAR) or link.getDirection() == "t" or len(lane.getShape()) < 2:
                    continue
                start = np.array(lane.getShape(), np.float64)[-2:, :2]
                end = np.array(link.getToLane().getShape(), np.float64)[:1, :2]
                line = shapely.LineString(np.concatenate([start[1:], inside(net, link)[:, :2], end]))
                step = start[1] - start[0]
                yield _Way(link, line, step / max(float(np.hypot(*step)), 1e-9))


def _at_junction(
    base: Scenario, net: Network, node: Node, ways: Sequence[_Way], units: "_Units", seed: int
) -> Iterator[Candidate]:
    """Yield the candidates of a junction, a few of each kind and occluder."""
    paths: dict[int, LanePath] = {}
    counts: dict[tuple[str, str], int] = {}
    across = "l" if net.kerb_side < 0 else "r"
    unit = units.at(node.getCoord()[:2])
    seen = set()
    for ego, other in product(ways, ways):
        kind = _kind(ego, other, across)
        pair = (kind, ego.lane.getEdge().getID(), ego.link.getDirection(), other.lane.getEdge().getID())
        if not kind or pair in seen:
            continue
        seen.add(pair)
        for way in (ego, other):
            if id(way) not in paths:
                paths[id(way)] = lane_path(net, way.lane, way.link)
        for hidden_by, spec in _hidden(kind, net, ways, ego, other, paths[id(ego)], paths[id(other)]):
            if counts.get((kind, hidden_by), 0) >= _ALIKE:
                continue
            counts[kind, hidden_by] = counts.get((kind, hidden_by), 0) + 1
            yield _candidate(base, kind, hidden_by, node.getID(), node.getCoord()[:2], spec, unit, seed)


def _kind(ego: _Way, other: _Way, across: str) -> str:
    """Return the kind of a conflict of two connections; "" without one that is mined."""
    straight = ("s", "S")
    if ego.lane.getEdge() is other.lane.getEdge():
        return ""
    if not {ego.link.getDirection(), other.link.getDirection()} & set(straight):
        return ""
    opposite = float(ego.ahead @ other.ahead) < _OPPOSITE
    if ego.link.getToLane() is other.link.getToLane():
        return "" if opposite else "merging"
    if not ego.line.crosses(other.line):
        return ""
    if not opposite:
        return "crossing"
    return "turn across" if ego.link.getDirection().lower() == across and other.link.getDirection() in straight else ""


def _hidden(
    kind: str, net: Network, ways: Sequence[_Way], ego: _Way, other: _Way, ego_path: LanePath, other_path: LanePath
) -> Iterator[tuple[str, EncounterSpec | None]]:
    """Yield names of occluders with the encounter behind each, None where the roads are too short."""
    streets = {"ego": _names(ego), "conflict": _names(other)}
    if kind == "turn across":
        yield from _behind_lorry(ways, ego, other, streets)
        return
    try:
        meet, ego_at = own.conflict_point("map", ego_path, other_path)
    except ScenarioError:
        return
    other_at = other_path.path.nearest(meet)
    ego_mps = min(ego.lane.getSpeed(), _FASTEST_MPS, _bend_mps(ego_path, ego_at), ego_at / _HIT_S)
    other_mps = min(other.lane.getSpeed(), 15.0, _bend_mps(other_path, other_at), other_at / _HIT_S)
    if min(ego_mps, other_mps) < _SLOWEST_MPS:
        yield "houses", None
        return
    parameters = {"ego_mps": _range(ego_mps), "conflict_mps": _range(other_mps)}
    from_left = float(ego.ahead[0] * -other.ahead[1] + ego.ahead[1] * other.ahead[0]) > 0.0
    yield "houses", _own(streets, parameters)
    step = (1 if from_left else -1) * (1 if net.kerb_side < 0 else -1)
    beside = _lane_beside(ego.lane, step)
    queue = next((way for way in ways if way.lane is beside), None)
    if queue is not None:
        path = lane_path(net, queue.lane, queue.link)
        front = path.stop_m - _BEFORE_LINE_M - path.path.nearest(meet)
        row = PlacedSpec(
            kind="truck", street="queue", at_m=round(front, 1), count=_row(path), roles=("occluder", "helper")
        )
        yield "queue", _own(streets | {"queue": _names(queue)}, parameters, row)
    # From the kerb's side a row along the ego's street hides it, from the other side one along its own.
    near = from_left == (net.kerb_side > 0)
    way, path, at = (ego, ego_path, ego_at) if near else (other, other_path, other_at)
    if _lane_beside(way.lane, -1) is None:
        row = PlacedSpec(
            kind="truck",
            street="ego" if near else "conflict",
            at_m=round(path.stop_m - _BEFORE_LINE_M - at, 1),
            left_m=round(net.kerb_side * (0.5 * way.lane.getWidth() + _KERB_M + _BODY_M), 2),
            count=_row(path),
            roles=("occluder", "helper"),
        )
        yield "parked", _own(streets, parameters, row)


def _behind_lorry(
    ways: Sequence[_Way], ego: _Way, other: _Way, streets: Mapping[str, tuple[str, ...]]
) -> Iterator[tuple[str, EncounterSpec | None]]:
    """Yield the left turn (with traffic on the left, the right turn) before a lorry that waits to turn too."""
    same = ego.link.getDirection().lower()
    for way in ways:
        mate = way.lane.getEdge() is other.lane.getEdge() and way.lane is not other.lane
        if mate and way.link.getDirection().lower() == same:
            parameters: dict[str, Drawn] = {
                "ego_mps": (6.5, 8.0),
                "conflict_mps": (12.0, 16.0),
                "offset_m": 0.0,
                "bus": 0.0,
            }
            lanes = {**streets, "truck": _names(way)}
            yield "lorry", EncounterSpec(kind="lta_truck", parameters=parameters, streets=lanes)
            return


def _streets(base: Scenario, net: Network, units: "_Units", seed: int) -> Iterator[list[Candidate]]:
    """Yield pedestrians who cross between parked vans, spread along each street of a town with room for them."""
    for edge in sorted(net.getEdges(withInternal=False), key=lambda one: one.getID()):
        lane = next((one for one in edge.getLanes() if one.allows(_CAR)), None)
        if lane is None or edge.getLength() < _STREET_M or lane.getSpeed() > _TOWN_MPS:
            continue
        if _lane_beside(lane, -1) is not None:
            continue
        way, number = lane_path(net, lane, None), max(1, int(edge.getLength() / _APART_M))
        for at in (edge.getLength() * np.arange(1, number + 1) / (number + 1)).tolist():
            mps = min(lane.getSpeed(), _FASTEST_MPS, (way.stop_m + at) / _HIT_S)
            place, _, _ = way.path.at(way.stop_m + at)
            xy = (round(float(place[0]), 1), round(float(place[1]), 1))
            spec = None
            if mps >= _SLOWEST_MPS:
                left = round(net.kerb_side * (0.5 * lane.getWidth() + _KERB_M + 1.03), 2)
                before = PlacedSpec(kind="van", at_m=-0.6, left_m=left, count=5)
                ahead = PlacedSpec(kind="van", at_m=7.2, left_m=left, roles=("occluder", "helper"))
                # Who walks is in sight too early for a slow ego, which stops within less time.
                walks = min(max(2.0, round(_EMERGES_M / (0.3 + mps / 14.0), 1)), _RUNS_MPS)
                parameters = {
                    "ego_mps": _range(mps),
                    "conflict_mps": (walks, round(walks + 0.3, 1)),
                    "cross_m": round(at, 1),
                    "aside_m": round(abs(left) + 1.8, 1),
                }
                spec = _own({"ego": (lane.getID(),)}, parameters, before, ahead)
            yield [_candidate(base, "pedestrian", "parked", edge.getID(), xy, spec, units.at(xy), seed)]


def _candidate(
    base: Scenario,
    kind: str,
    hidden_by: str,
    place: str,
    xy: Sequence[float],
    spec: EncounterSpec | None,
    unit: RoadsideUnit | None,
    seed: int,
) -> Candidate:
    here = (float(xy[0]), float(xy[1]))
    if spec is None:
        return Candidate(kind, hidden_by, place, here, None)
    number = hashlib.sha256(msgspec.json.encode([place, spec, seed], order="deterministic")).hexdigest()[:8]
    scenario = Scenario(
        name=f"{base.name}_{kind.replace(' ', '_')}_{hidden_by}_{number}",
        description=f"{kind.capitalize()} at {place} of {base.name}, hidden by {hidden_by}.",
        network=msgspec.structs.replace(base.network, area_m=None),
        agents=AgentRule(lidar=base.agents.lidar, roadside=() if unit is None else (unit,)),
        conflict=spec,
        warmup_s=0.0,
        duration_s=12.0,
        step_s=base.step_s,
        seed=seed,
        attribution=base.attribution,
        world=base.world,
    )
    return Candidate(kind, hidden_by, place, here, scenario)


def _own(streets: Mapping[str, tuple[str, ...]], parameters: Mapping[str, Any], *placed: PlacedSpec) -> EncounterSpec:
    given = {"placed": placed} if placed else {}
    return EncounterSpec(kind=own.KIND, streets=dict(streets), parameters=dict(parameters), **given)  # type: ignore[arg-type]


def _row(path: LanePath) -> int:
    """Return how many lorries have room before a stop line."""
    return max(2, min(_ROW, int((path.stop_m - _BEFORE_LINE_M) / _LORRY_M)))


def _names(way: _Way) -> tuple[str, ...]:
    return (way.lane.getID(), way.link.getToLane().getID())


def _range(mps: float) -> tuple[float, float]:
    return (round(0.9 * mps, 1), round(mps, 1))


def _lane_beside(lane: Lane, step: int) -> Lane | None:
    """Return the lane for cars or bicycles next to one, away from the kerb for a step of 1; None without one."""
    lanes, index = list(lane.getEdge().getLanes()), lane.getIndex() + step
    found = lanes[index] if 0 <= index < len(lanes) else None
    return found if found is not None and (found.allows(_CAR) or found.allows("bicycle")) else None


def _bend_mps(way: LanePath, at_m: float) -> float:
    """Return the speed of comfortable turning around a place, m/s."""
    near = np.abs(way.path.along - at_m) < 12.0
    bend = np.abs(np.gradient(way.path.heading[near], way.path.along[near])).max()
    return math.sqrt(_TURN_MPS2 / max(float(bend), 1e-4))


class _Units:
    """Roadside units of a map, found among the roads near each place."""

    def __init__(self, net: Network) -> None:
        self._edges = [edge for edge in net.getEdges(withInternal=True) if len(edge.getShape()) > 1]
        lines = [shapely.LineString(np.array(edge.getShape(), np.float64)[:, :2]) for edge in self._edges]
        self._tree = shapely.STRtree(lines)
        self._near: list[Edge] = []

    def getEdges(self, withInternal: bool = True) -> Sequence[Edge]:
        """Return the edges near the place."""
        return self._near

    def at(self, xy: Sequence[float]) -> RoadsideUnit | None:
        """Return a unit beside the road that faces a place; None without room."""
        rows = self._tree.query(shapely.Point(xy[0], xy[1]), predicate="dwithin", distance=100.0)
        self._near = [self._edges[row] for row in sorted(rows)]
        found = beside_road(self, (float(xy[0]), float(xy[1])))  # type: ignore[arg-type]
        if found is None:
            return None
        x, y, yaw = (float(value) for value in found)
        return RoadsideUnit(xyz_m=(x, y, 5.0), yaw_deg=yaw, lidar="opv2v-64")


def scenario_text(scenario: Scenario) -> str:
    """Return a scenario as the text of a scenario.toml, without what is as by default."""
    return "\n".join(_tables(_given(scenario), ())) + "\n"


def _given(value: Any) -> Any:
    """Return plain values of a struct that differ from its defaults."""
    if isinstance(value, msgspec.Struct):
        found = {}
        for field in msgspec.structs.fields(value):
            one = getattr(value, field.name)
            default = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
            if one is not msgspec.UNSET and (field.required or one != default):
                found[field.name] = _given(one)
        return found
    if isinstance(value, dict):
        return {key: _given(one) for key, one in value.items()}
    return [_given(one) for one in value] if isinstance(value, list | tuple) else value


def _tables(values: Mapping[str, Any], where: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a TOML table and of those below it."""
    below = {key: one for key, one in values.items() if isinstance(one, dict) and one}
    rows = {key: one for key, one in values.items() if isinstance(one, list) and one and isinstance(one[0], dict)}
    for key, one in values.items():
        if key not in below and key not in rows:
            yield f"{_key(key)} = {json.dumps(one)}"
    for key, one in below.items():
        yield from ("", f"[{'.'.join(map(_key, (*where, key)))}]", *_tables(one, (*where, key)))
    for key, one in rows.items():
        for row in one:
            yield from ("", f"[[{'.'.join(map(_key, (*where, key)))}]]", *_tables(row, (*where, key)))


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)
