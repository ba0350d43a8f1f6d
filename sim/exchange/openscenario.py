"""Writer of OpenSCENARIO: the motion of road users as trajectories with times.

A vehicle's reference is the middle of its rear axle on the road, as the standard says; its axles lie at three tenths of
its length before and behind the middle of the box. A pedestrian's is the middle of its footprint.

Source: ASAM OpenSCENARIO XML 1.1.0: FollowTrajectoryAction with a Polyline, whose places and headings are interpolated
between vertices by time.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES
from sim.traffic.base import Actors

AXLE = 0.3
"""Distance of a vehicle's axles from the middle of its box, as a share of its length."""
_CATEGORIES = {
    "car": "car",
    "van": "van",
    "truck": "truck",
    "bus": "bus",
    "motorcycle": "motorbike",
    "bicycle": "bicycle",
}
_STANDS_M = 1e-3
_PERFORMANCE = {"maxSpeed": "70", "maxAcceleration": "10", "maxDeceleration": "10"}


@dataclass
class _Run:
    """Road user without a gap: rows of time, x, y, z, heading, pitch and roll of its reference."""

    class_name: str
    size: NDArray[np.float64]
    model: str
    rows: list[list[float]] = field(default_factory=list)


def xosc_of(name: str, description: str, steps: Sequence[Actors], roads: str) -> bytes:
    """Return the .xosc of a traffic, whose first step is at 0 s.

    One who comes later is added, one who leaves earlier deleted; after a gap a road user is another, `NAME_2`.

    Args:
        steps: road users at every step, in order of time.
        roads: path of the .xodr, beside the file.
    """
    start, end = steps[0].time_s, steps[-1].time_s - steps[0].time_s
    root = ET.Element("OpenSCENARIO")
    said = {"date": "1970-01-01T00:00:00", "description": f"{name}: {description}", "author": "dsrc-testbed"}
    ET.SubElement(root, "FileHeader", {"revMajor": "1", "revMinor": "1", **said})
    ET.SubElement(root, "ParameterDeclarations")
    ET.SubElement(root, "CatalogLocations")
    ET.SubElement(ET.SubElement(root, "RoadNetwork"), "LogicFile", filepath=roads)
    runs = _runs(steps, start)
    entities = ET.SubElement(root, "Entities")
    for key, run in runs.items():
        _add_entity(entities, key, run)
    storyboard = ET.SubElement(root, "Storyboard")
    init = ET.SubElement(ET.SubElement(storyboard, "Init"), "Actions")
    for key, run in runs.items():
        if run.rows[0][0] == 0.0:
            private = ET.SubElement(init, "Private", entityRef=key)
            _add_place(_path(private, "PrivateAction/TeleportAction/Position"), run.rows[0])
    act = ET.Element("Act", name="traffic")
    for key, run in runs.items():
        _add_group(act, key, run, end)
    if len(act):
        act.append(_trigger("StartTrigger", 0.0))
        ET.SubElement(storyboard, "Story", name=name).append(act)
    storyboard.append(_trigger("StopTrigger", end))
    ET.indent(root, " ")
    return ET.tostring(root, "utf-8", xml_declaration=True) + b"\n"


def _runs(steps: Sequence[Actors], start: float) -> dict[str, _Run]:
    runs: dict[str, _Run] = {}
    current: dict[str, str] = {}
    before: set[str] = set()
    for actors in steps:
        for row, name in enumerate(actors.name):
            if name not in before:
                again = sum(key == name or key.startswith(f"{name}_") for key in runs)
                current[name] = name if name not in runs else f"{name}_{again + 1}"
                class_name = CLASSES[actors.boxes.label[row]]
                runs[current[name]] = _Run(class_name, actors.boxes.size[row], actors.model[row])
            runs[current[name]].rows.append(_reference(actors, row, start))
        before = set(actors.name)
    return runs


def _reference(actors: Actors, row: int, start: float) -> list[float]:
    boxes = actors.boxes
    yaw, pitch, (length, _, height) = boxes.yaw[row], actors.pitch[row], boxes.size[row]
    back = 0.0 if CLASSES[boxes.label[row]] == "pedestrian" else AXLE * length
    x, y, z = boxes.center[row] - back * np.array([np.cos(yaw), np.sin(yaw), 0.0]) - [0.0, 0.0, 0.5 * height]
    return [actors.time_s - start, x, y, z, yaw, pitch, actors.roll[row]]


def _text(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".") if abs(value) >= 5e-7 else "0"


def _path(parent: ET.Element, tags: str) -> ET.Element:
    """Add nested elements and return the last."""
    for tag in tags.split("/"):
        parent = ET.SubElement(parent, tag)
    return parent


def _add_entity(entities: ET.Element, key: str, run: _Run) -> None:
    length, width, height = map(float, run.size)
    one = ET.SubElement(entities, "ScenarioObject", name=key)
    if walks := run.class_name == "pedestrian":
        body = ET.SubElement(one, "Pedestrian", name=key, model=run.model, mass="75", pedestrianCategory="pedestrian")
    else:
        body = ET.SubElement(one, "Vehicle", name=key, vehicleCategory=_CATEGORIES[run.class_name])
    box = ET.SubElement(body, "BoundingBox")
    ahead = 0.0 if walks else AXLE * length
    ET.SubElement(box, "Center", x=_text(ahead), y="0", z=_text(0.5 * height))
    ET.SubElement(box, "Dimensions", width=_text(width), length=_text(length), height=_text(height))
    if not walks:
        ET.SubElement(body, "Performance", _PERFORMANCE)
        axles = ET.SubElement(body, "Axles")
        wheel = {"wheelDiameter": "0.65", "trackWidth": _text(0.85 * width), "positionZ": "0.325"}
        ET.SubElement(axles, "FrontAxle", {"maxSteering": "0.6", "positionX": _text(2.0 * AXLE * length), **wheel})
        ET.SubElement(axles, "RearAxle", {"maxSteering": "0", "positionX": "0", **wheel})
    ET.SubElement(body, "Properties")


def _add_place(position: ET.Element, row: Sequence[float]) -> None:
    _, x, y, z, yaw, pitch, roll = map(_text, row)
    ET.SubElement(position, "WorldPosition", x=x, y=y, z=z, h=yaw, p=pitch, r=roll)


def _trigger(tag: str, time_s: float) -> ET.Element:
    trigger = ET.Element(tag)
    condition = ET.SubElement(
        ET.SubElement(trigger, "ConditionGroup"), "Condition", name="time", delay="0", conditionEdge="none"
    )
    by_value = ET.SubElement(condition, "ByValueCondition")
    ET.SubElement(by_value, "SimulationTimeCondition", value=_text(time_s), rule="greaterOrEqual")
    return trigger


def _add_group(act: ET.Element, key: str, run: _Run, end: float) -> None:
    """Add what a road user does: come, follow its trajectory, leave; nothing for one that stands all the time."""
    first, last = run.rows[0], run.rows[-1]
    moves = float(np.abs(np.subtract(run.rows, first))[:, 1:].max()) > _STANDS_M
    comes, leaves = first[0] > 0.0, last[0] < end
    if not (moves or comes or leaves):
        return
    group = ET.SubElement(act, "ManeuverGroup", name=key, maximumExecutionCount="1")
    ET.SubElement(ET.SubElement(group, "Actors", selectTriggeringEntities="false"), "EntityRef", entityRef=key)
    maneuver = ET.SubElement(group, "Maneuver", name=key)
    if comes:
        action = _add_event(maneuver, "come", first[0])
        position = _path(_entity_action(action, key), "AddEntityAction/Position")
        _add_place(position, first)
    if moves and len(run.rows) > 1:
        action = _add_event(maneuver, "drive", first[0])
        follow = _path(action, "PrivateAction/RoutingAction/FollowTrajectoryAction")
        trajectory = ET.SubElement(ET.SubElement(follow, "TrajectoryRef"), "Trajectory", name=key, closed="false")
        line = _path(trajectory, "Shape/Polyline")
        for row in run.rows:
            _add_place(ET.SubElement(ET.SubElement(line, "Vertex", time=_text(row[0])), "Position"), row)
        timing = {"domainAbsoluteRelative": "absolute", "scale": "1", "offset": "0"}
        ET.SubElement(ET.SubElement(follow, "TimeReference"), "Timing", timing)
        ET.SubElement(follow, "TrajectoryFollowingMode", followingMode="position")
    if leaves:
        ET.SubElement(_entity_action(_add_event(maneuver, "leave", last[0]), key), "DeleteEntityAction")


def _add_event(maneuver: ET.Element, what: str, time_s: float) -> ET.Element:
    """Add an event at a time and return its action."""
    name = f"{maneuver.get('name')}: {what}"
    event = ET.SubElement(maneuver, "Event", name=name, priority="parallel")
    action = ET.SubElement(event, "Action", name=name)
    event.append(_trigger("StartTrigger", time_s))
    return action


def _entity_action(action: ET.Element, key: str) -> ET.Element:
    return ET.SubElement(ET.SubElement(action, "GlobalAction"), "EntityAction", entityRef=key)
