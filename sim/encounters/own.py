"""Encounters of one's own on a map: a scenario names the roads, who is hidden by what, and what sets whom off.

The conflict point is where the ways of the ego and the conflict actor meet: behind the stop lines of two streets, or,
without a street of the conflict actor, `cross_m` along the ego's, where it comes from the side. Both reach it at the
same time, up to `jitter_s`; an actor with a trigger stands so far before it that it does so after setting off.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import shapely

from sim.bodies.vehicle_types import TYPES, types_of
from sim.encounters.draw import JITTER, band, pick
from sim.encounters.lane_paths import LanePath, meeting
from sim.encounters.paths import PathBuilder, ReferencePath, SpeedProfile
from sim.encounters.turning import slowing
from sim.encounters.types import (
    HIT_S,
    EncounterType,
    Layout,
    Parameter,
    ScriptedActor,
    Start,
    Structure,
    actor,
    standing,
)
from sim.errors import ScenarioError, complaint
from sim.geometry import Array
from sim.roads.network import Network
from sim.scenario import STRUCTURES, Drawn, EncounterSpec, PlacedSpec, Trigger

KIND = "own"

REACH_M = 110.0
_BESIDE_M = (3.0, 80.0)
"""Part of a way before and after its stop line in which the conflict point lies, m."""
_MEET_M = 2.0
_TURN_M = 14.0
_FRONT_M = 2.2
"""From the middle of the ego to its front, which meets a road user who comes from the side, m."""
_ACROSS_M, _SPARE_M = 30.0, 1.0
_ROOM_M = 0.1
_ONWARD_M = 30.0
"""Way of the ego behind the conflict point that is kept free, m."""

_TYPES = {
    "car": ("car_small", "car_compact", "car_saloon", "car_estate", "car_suv"),
    "van": ("van_people", "van_box"),
    "truck": ("truck_light", "truck_box"),
    "pedestrian": ("person_tall", "person_middle"),
}
"""Types to draw from; of other classes all."""

_PLACED = {
    "at_m": (-300.0, 300.0, "of its front from the conflict point"),
    "left_m": (-30.0, 30.0, "to the left of the path"),
    "speed_mps": (0.0, 40.0, "speed"),
    "gap_m": (0.3, 20.0, "between several"),
}
_STARTS = {
    "ego_before_m": (0.0, 200.0, "of the ego from the conflict point, where it sets off"),
    "at_s": (0.1, HIT_S, "when it sets off"),
}


def drawn_of(spec: EncounterSpec) -> Iterator[tuple[Parameter, Drawn]]:
    """Yield the parameters of the tables of an own encounter, below `conflict`, with what is given for them."""
    tables: list[tuple[str, object, Mapping[str, tuple[float, float, str]]]] = [("starts", spec.starts, _STARTS)]
    for row, one in enumerate(spec.placed or ()):
        tables += [(f"placed[{row}]", one, _PLACED), (f"placed[{row}].starts", one.starts, _STARTS)]
    for where, table, names in tables:
        for name, (low, high, what) in names.items():
            given = getattr(table, name, None)
            if given is not None:
                yield Parameter(f"{where}.{name}", low, high, (low, high), what), given


def wrong_values(spec: EncounterSpec) -> Iterator[tuple[str, str, object]]:
    """Yield (field, expected, found) of what is inconsistent in the tables of an own encounter."""
    if "ego" not in spec.streets:
        yield "conflict.streets", "the lanes of ego", ", ".join(spec.streets) or "none"
    triggers = [("conflict.starts", spec.starts or None)]
    for row, one in enumerate(spec.placed or ()):
        field = f"conflict.placed[{row}]"
        triggers.append((f"{field}.starts", one.starts))
        if one.street not in spec.streets:
            yield f"{field}.street", f"one of conflict.streets: {', '.join(spec.streets)}", f"'{one.street}'"
        if one.kind in STRUCTURES:
            if "helper" in one.roles or one.starts is not None or one.speed_mps != 0.0 or one.count != 1:
                yield field, f"one {one.kind} that stands and helps nobody", "helper, starts, speed_mps or count"
        elif one.size_m != PlacedSpec(kind="wall", at_m=0.0).size_m:
            yield f"{field}.size_m", f"none, since a {one.kind} has the size of its type", list(one.size_m)
        if one.starts is not None and one.speed_mps == 0.0:
            yield f"{field}.speed_mps", "a speed above 0 of what sets off", 0.0
    for field, trigger in triggers:
        if trigger is not None and (trigger.ego_before_m is None) == (trigger.at_s is None):
            yield field, "one of ego_before_m, at_s", "both" if trigger.at_s is not None else "none"


def lay_out(
    p: Mapping[str, float],
    rng: np.random.Generator,
    streets: Mapping[str, LanePath],
    spec: EncounterSpec,
    net: Network,
    name: str,
) -> Layout:
    """Return the layout of an own encounter.

    Args:
        p: drawn values, those of `drawn_of` by their names.
        rng: of types of vehicles.
        name: of the scenario, for messages.

    Raises:
        ScenarioError: the ways do not meet or are too short, or something stands in the way.
    """
    ego_way, other_way = streets["ego"], streets.get("conflict")
    if other_way is not None:
        meet, ego_at = conflict_point(name, ego_way, other_way)
    else:
        ego_at = float(np.clip(ego_way.stop_m + p["cross_m"], 0.0, ego_way.path.length))
        meet = ego_way.path.at(ego_at)[0][:2]
    pace = slowing(max(p["approach_mps"], p["ego_mps"]), p["ego_mps"], _TURN_M, HIT_S)
    front_m = _FRONT_M if other_way is None else 0.0
    ego = actor("ego", "ego", pick(_types("car"), rng), ego_way.path, pace, at_m=ego_at - front_m, at_s=HIT_S)
    _check_length(name, "ego", ego, ego_at)
    conflict = _conflict(p, rng, spec, ego, ego_way, meet, ego_at, other_way)
    _check_length(name, "conflict", conflict, conflict.path.nearest(meet))
    actors, structures = [ego, conflict], []
    for row, placed in enumerate(spec.placed or ()):
        values = {key: p.get(f"placed[{row}].{key}", 0.0) for key in _PLACED}
        street = streets[placed.street].path
        front = street.nearest(meet) + values["at_m"]
        if placed.kind in STRUCTURES:
            structures.append(_structure(placed, street, front, values["left_m"]))
            _check_off_lanes(name, row, structures[-1], net)
            continue
        start = _start(p, f"placed[{row}].starts", placed.starts, ego, ego_at)
        for number, one in enumerate(_vehicles(placed, street, front, values, start, rng)):
            actors.append(replace(one, name=f"{placed.kind}_{row}" if number == 0 else f"{placed.kind}_{row}_{number}"))
            _check_off_ways(name, row, actors[-1], ego, conflict, meet)
    focus = (round(float(meet[0]), 1), round(float(meet[1]), 1))
    return Layout(None, tuple(actors), tuple(structures), focus=focus, reach_m=REACH_M)


def conflict_point(name: str, ego: LanePath, other: LanePath) -> tuple[Array, float]:
    """Return the (2,) conflict point of two ways and its distance along the ego's path, m.

    Raises:
        ScenarioError: they do not meet behind their stop lines.
    """
    before, after = _BESIDE_M
    parts = []
    for way in (ego, other):
        along = way.path.along
        near = (along >= way.stop_m - before) & (along <= way.stop_m + after)
        parts.append(way.path.points[near])
    lines = [shapely.LineString(part[:, :2]) for part in parts]
    gap = shapely.distance(*lines)
    if gap > _MEET_M:
        found = f"{gap:.1f} m between them behind their stop lines"
        raise ScenarioError(complaint(name, "conflict.streets.conflict", "a way that meets the ego's", found))
    if lines[0].crosses(lines[1]):
        # Where one merges into the other they wobble across each other from their meeting on.
        meet = meeting(*(ReferencePath.through(part, 0.0) for part in parts))
    else:
        near = shapely.distance(shapely.points(parts[0][:, :2]), lines[1]) <= max(gap + 0.3, 0.5)
        meet = parts[0][int(np.argmax(near)), :2]
    return meet, ego.path.nearest(meet)


def _conflict(
    p: Mapping[str, float],
    rng: np.random.Generator,
    spec: EncounterSpec,
    ego: ScriptedActor,
    ego_way: LanePath,
    meet: Array,
    ego_at: float,
    way: LanePath | None,
) -> ScriptedActor:
    """Return the conflict actor, on its street or from the side."""
    label = spec.road_user or ("car" if way is not None else "pedestrian")
    kind, speed, at_s = pick(_types(label), rng), p["conflict_mps"], HIT_S + p["jitter_s"]
    start = _start(p, "starts", spec.starts or None, ego, ego_at)
    if way is not None:
        path, at_m = way.path, way.path.nearest(meet)
    else:
        _, heading, _ = ego_way.path.at(ego_at)
        side = -ego_way.kerb_side if p["far_side"] else ego_way.kerb_side
        turned = float(heading) - side * 0.5 * math.pi
        ahead = np.array([math.cos(turned), math.sin(turned)])
        at_m = p["aside_m"] + _SPARE_M
        x, y = (float(v) for v in meet - at_m * ahead)
        path = PathBuilder(x, y, turned).straight(at_m + _ACROSS_M).path(0.0)
        if start is None:  # it waits at the side of the road
            rate = TYPES[kind].accel_mps2[0]
            begins = max(at_s - p["aside_m"] / speed - 0.5 * speed / rate, 0.1)
            pace = SpeedProfile.change(0.0, speed, begins, rate)
            return actor("conflict", "conflict", kind, path, pace, at_m=at_m, at_s=at_s)
    if start is None:
        return actor("conflict", "conflict", kind, path, speed, at_m=at_m, at_s=at_s)
    pace = SpeedProfile.change(0.0, speed, start.script_s, TYPES[kind].accel_mps2[0])
    return replace(actor("conflict", "conflict", kind, path, pace, at_m=at_m, at_s=at_s), start=start)


def _start(
    p: Mapping[str, float], where: str, trigger: Trigger | None, ego: ScriptedActor, ego_at: float
) -> Start | None:
    if trigger is None:
        return None
    if trigger.at_s is not None:
        return Start(p[f"{where}.at_s"])
    place = ego_at - p[f"{where}.ego_before_m"]
    times = np.arange(0.0, HIT_S + 3.0, 0.01)
    return Start(round(float(np.interp(place, ego.place(times), times)), 3), place)


def _vehicles(
    placed: PlacedSpec,
    street: ReferencePath,
    front: float,
    values: Mapping[str, float],
    start: Start | None,
    rng: np.random.Generator,
) -> Iterator[ScriptedActor]:
    """Yield the road users of a table, from the first back."""
    for number in range(placed.count):
        kind = pick(_types(placed.kind), rng)
        length = TYPES[kind].size[0]
        roles = " ".join(role for role in placed.roles if number == 0 or role != "helper") or "other"
        at = front - 0.5 * length
        front -= length + values["gap_m"]
        if values["speed_mps"] == 0.0:
            place, heading, _ = street.at(at)
            x, y = place[:2] + values["left_m"] * np.array([-math.sin(heading), math.cos(heading)])
            yield standing("", roles, kind, float(x), float(y), float(heading), parked=values["left_m"] != 0.0)
            continue
        path = street
        if values["left_m"] != 0.0:
            path = ReferencePath.through(street.beside(values["left_m"]), 6.0)
            at = path.nearest(street.at(at)[0][:2])
        if start is None:
            yield actor("", roles, kind, path, values["speed_mps"], at_m=at, at_s=HIT_S)
        else:
            pace = SpeedProfile.change(0.0, values["speed_mps"], start.script_s, TYPES[kind].accel_mps2[0])
            yield replace(actor("", roles, kind, path, pace, at_m=at, at_s=0.0), start=start)


def _structure(placed: PlacedSpec, street: ReferencePath, front: float, left_m: float) -> Structure:
    length, width, height = placed.size_m
    line = street.at(np.linspace(front - length, front, max(2, math.ceil(length))))[0][:, :2]
    outline = band(line, left_m - 0.5 * width, left_m + 0.5 * width)
    return Structure(placed.kind, outline, height, "occluder" in placed.roles)  # type: ignore[arg-type]


def _types(label: str) -> tuple[str, ...]:
    return _TYPES.get(label) or tuple(kind.name for kind in types_of(label))


def _check_length(name: str, role: str, one: ScriptedActor, at_m: float) -> None:
    """Raise ScenarioError where an actor would have to appear on its way."""
    if one.start_m < 0.0:
        expected = f"{at_m - one.start_m:.0f} m of road before the conflict point"
        raise ScenarioError(complaint(name, f"conflict.streets.{role}", expected, f"{at_m:.0f} m"))


def _check_off_lanes(name: str, row: int, structure: Structure, net: Network) -> None:
    for edge in net.getEdges():
        for lane in edge.getLanes():
            line = np.array(lane.getShape(), np.float64)[:, :2]
            if edge.getFunction() in ("crossing", "walkingarea") or len(line) < 2:
                continue
            if structure.outline.distance(shapely.LineString(line)) < 0.5 * lane.getWidth() and _driven(lane):
                expected = "a place beside the lanes"
                raise ScenarioError(complaint(name, f"conflict.placed[{row}]", expected, f"on {lane.getID()}"))


def _driven(lane: object) -> bool:
    return any(lane.allows(vclass) for vclass in ("passenger", "bicycle", "bus"))  # type: ignore[attr-defined]


def _check_off_ways(
    name: str, row: int, one: ScriptedActor, ego: ScriptedActor, conflict: ScriptedActor, meet: Array
) -> None:
    """Raise ScenarioError where a standing road user is in the way of the ego or the conflict actor."""
    if one.pace.speed_mps.any():
        return
    place, heading, _ = one.path.at(one.start_m)
    length, width, _ = one.kind.size
    ahead, left = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    corners = [
        place[:2] + 0.5 * (a * length * ahead + b * width * left) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    body = shapely.Polygon(corners)
    for who, beyond_m in ((ego, _ONWARD_M), (conflict, 0.0)):
        here = (who.path.along >= who.start_m) & (who.path.along <= who.path.nearest(meet) + beyond_m)
        way = shapely.LineString(who.path.points[here, :2])
        if body.distance(way) < 0.5 * who.kind.size[1] + _ROOM_M:
            expected = f"a place off the way of the {'ego' if who is ego else 'conflict actor'}"
            found = f"in its way, {one.path.at(one.start_m)[0][:2].round(1).tolist()}"
            raise ScenarioError(complaint(name, f"conflict.placed[{row}]", expected, found))


OWN = EncounterType(
    "An encounter of one's own on a map.",
    (
        Parameter("ego_mps", 1.0, 40.0, (8.0, 12.0), "speed of the ego at the conflict point"),
        Parameter("approach_mps", 0.0, 40.0, (0.0, 0.0), "of the ego before it slows down to that"),
        Parameter("conflict_mps", 0.5, 40.0, (6.0, 12.0), "speed of the conflict actor"),
        Parameter("cross_m", -300.0, 300.0, (0.0, 0.0), "of a crossing from the side, from the ego's stop line"),
        Parameter("aside_m", 1.0, 40.0, (4.0, 6.0), "from there to where it waits, at the side of the road"),
        Parameter("far_side", 0.0, 1.0, (0.0, 0.0), "it comes from the far side, not from the kerb", True),
        JITTER,
    ),
    None,
    roles=("ego",),
)
