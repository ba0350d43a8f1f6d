"""Tracks of an OpenSCENARIO: the storyboard played by time, on the lanes of its OpenDRIVE file.

Played are teleports, speeds, lane changes, trajectories of vertices, and road users that come and leave; they begin at
times. What needs anything else (other conditions, routes) is refused by its name. Vehicles, pedestrians, maneuvers and
trajectories may lie in catalogs. On a lane road users keep
to it with their speed; off the lanes they go straight on. They do not react to each other.

Source: ASAM OpenSCENARIO XML 1.0 to 1.3: a reference point is the origin of an entity's axes, in which its bounding box
has a centre; a polyline is interpolated between its vertices; the shapes of transitions.
"""

import logging
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sim.errors import DataError, complaint
from sim.reading import parsing
from sim.roads.opendrive import LanePlace, OpenDrive
from sim.traffic.tracks.base import Recording, Track, make_track
from sim.traffic.tracks.openscenario_catalogs import expand_catalogs
from sim.traffic.tracks.openscenario_motion import SHAPES, STEP_S, Change, Polyline, Pose, User
from sim.traffic.tracks.xml_file import number_of, read_xml_bytes

LONGEST_S = 600.0
_AFTER_S = 5.0
"""Time played after the last action of a storyboard without a stop at a time."""
_CLASSES = {
    **{name: name for name in ("car", "van", "truck", "bus", "bicycle", "pedestrian")},
    **{"motorbike": "motorcycle", "semitrailer": "truck", "trailer": "truck", "wheelchair": "pedestrian"},
}
_IGNORED = (
    "ControllerAction",
    "ActivateControllerAction",
    "VisibilityAction",
    "AppearanceAction",
    "EnvironmentAction",
)
"""Actions that change no motion."""

_log = logging.getLogger(__name__)


class _Action(NamedTuple):
    """Action of one entity at a time; an empty entity is the world."""

    time_s: float
    entity: str
    element: ET.Element


def read_openscenario(path: Path) -> tuple[Recording, ...]:
    """Read an .xosc, with the .xodr and the catalogs that it names.

    Raises:
        DataError: no OpenSCENARIO of version 1, a value is missing or wrong, or it uses what is not played; names it.
    """
    with parsing(path, "OpenSCENARIO file"):
        root = ET.fromstring(read_xml_bytes(path, "OpenSCENARIO file"))
        if root.tag != "OpenSCENARIO" or root.find("Storyboard") is None:
            raise DataError(complaint(path, "root", "<OpenSCENARIO> with a storyboard", f"<{root.tag}>"))
        expand_catalogs(path, root)
        return (_Player(path, root).play(),)


class _Player:
    """A storyboard, played once."""

    def __init__(self, path: Path, root: ET.Element) -> None:
        self.path, self._root = path, root
        self._parameters = {
            one.get("name", ""): one.get("value", "")
            for one in root.findall("ParameterDeclarations/ParameterDeclaration")
        }
        logic = root.find("RoadNetwork/LogicFile")
        roads = "" if logic is None else self._text(logic, "filepath", "")
        self._roads = OpenDrive(path.parent / roads) if roads else None
        self._entities = dict(self._read_entities())
        self.users = {name: user for name, user in self._entities.items() if user is not None}

    def play(self) -> Recording:
        """Return the tracks of all road users."""
        board = self._root.find("Storyboard")
        assert board is not None
        for private in board.findall("Init/Actions/Private"):
            for action in private.findall("PrivateAction"):
                self._act(0.0, self._text(private, "entityRef"), action)
        actions = sorted(self._storyboard(board), key=lambda one: one.time_s)
        end = self._end(board, actions)
        if not 0.0 < end <= LONGEST_S:
            raise DataError(complaint(self.path, "StopTrigger", f"a time in (0, {LONGEST_S:g}] s", f"{end:g}"))
        row = 0
        for step in range(math.floor(end / STEP_S + 1e-6) + 1):
            time_s = step * STEP_S
            for user in self.users.values():
                if step and user.pose is not None:
                    user.move(time_s, self._roads)
            while row < len(actions) and actions[row].time_s <= time_s + 1e-9:
                self._act(actions[row].time_s, actions[row].entity, actions[row].element)
                row += 1
            for user in self.users.values():
                if user.pose is not None:
                    user.rows.append((time_s, *user.pose))
        outlines = () if self._roads is None else tuple(self._roads.outlines())
        return Recording(tuple(self._track(name, user) for name, user in self.users.items() if user.rows), outlines)

    def _track(self, name: str, user: User) -> Track:
        time_s, x, y, z, heading = np.array(user.rows, np.float64).T
        cos, sin, (ahead, left, up) = np.cos(heading), np.sin(heading), user.middle
        center = np.column_stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left, z + up])
        return make_track(self.path, name, user.class_name, user.size, time_s, center, heading)

    def _read_entities(self) -> Iterator[tuple[str, User | None]]:
        for one in self._root.findall("Entities/ScenarioObject"):
            name = self._text(one, "name")
            body = next((part for tag in ("Vehicle", "Pedestrian") if (part := one.find(tag)) is not None), None)
            if body is None:
                if one.find("MiscObject") is None:
                    found = ", ".join(part.tag for part in one) or "nothing"
                    raise DataError(complaint(self.path, f"entity '{name}'", "a Vehicle or a Pedestrian", found))
                _log.warning("%s: entity '%s': a MiscObject is no road user: it is left out", self.path, name)
                yield name, None
                continue
            kind = self._text(body, "vehicleCategory" if body.tag == "Vehicle" else "pedestrianCategory")
            if kind not in _CLASSES:
                _log.warning("%s: entity '%s': %s is no road user: it is left out", self.path, name, kind)
                yield name, None
                continue
            center, size = (body.find(f"BoundingBox/{tag}") for tag in ("Center", "Dimensions"))
            if center is None or size is None:
                raise DataError(complaint(self.path, f"entity '{name}'", "a BoundingBox", "none"))
            length, width, height = (self._number(size, key) for key in ("length", "width", "height"))
            x, y, z = (self._number(center, key) for key in "xyz")
            yield name, User(_CLASSES[kind], (length, width, height), (x, y, z))

    def _storyboard(self, board: ET.Element) -> Iterator[_Action]:
        for act in board.findall("Story/Act"):
            opens = self._time(act.find("StartTrigger"), "act")
            for group in act.findall("ManeuverGroup"):
                names = [self._text(one, "entityRef") for one in group.findall("Actors/EntityRef")]
                for event in group.findall("Maneuver/Event"):
                    begins = max(opens, self._time(event.find("StartTrigger"), f"event '{event.get('name')}'"))
                    for action in event.findall("Action/PrivateAction"):
                        yield from (_Action(begins, name, action) for name in names)
                    for action in event.findall("Action/GlobalAction"):
                        yield _Action(begins, "", action)

    def _time(self, trigger: ET.Element | None, what: str) -> float:
        """Return when a trigger by time fires: with the first of its groups, each with the last of its conditions.

        One that is missing or empty fires at once.
        """
        groups = [] if trigger is None else trigger.findall("ConditionGroup")
        times = [max((self._passed(one, what) for one in group.findall("Condition")), default=0.0) for group in groups]
        return min(times, default=0.0)

    def _passed(self, one: ET.Element, what: str) -> float:
        """Return when a condition is met."""
        condition = one.find("ByValueCondition/SimulationTimeCondition")
        rule = "" if condition is None else self._text(condition, "rule")
        if condition is None or rule not in ("greaterThan", "greaterOrEqual", "equalTo"):
            found = next((part.tag for part in one.iter() if part.tag.endswith("Condition") and not len(part)), rule)
            expected = "a SimulationTimeCondition that is passed"
            raise DataError(complaint(self.path, f"StartTrigger of {what}", expected, found or "another"))
        return self._number(condition, "value") + self._number(one, "delay", 0.0)

    def _end(self, board: ET.Element, actions: list[_Action]) -> float:
        stops = [
            self._number(one, "value")
            for one in board.findall("StopTrigger/ConditionGroup/Condition/ByValueCondition/SimulationTimeCondition")
        ]
        if stops:
            return min(stops)
        ends = [_AFTER_S]
        for action in actions:
            length = [self._number(one, "value", 0.0) for one in action.element.iter() if one.tag.endswith("Dynamics")]
            times = [self._number(one, "time", 0.0) for one in action.element.iter("Vertex")]
            ends.append(action.time_s + max([*length, *times, 0.0]) + _AFTER_S)
        return min(max(ends), LONGEST_S)

    def _act(self, time_s: float, name: str, action: ET.Element) -> None:
        """Begin an action."""
        kind = action.find(".//*[@entityRef]") if action.tag == "GlobalAction" else None
        if kind is not None and kind.tag == "EntityAction":
            self._come_or_leave(self._text(kind, "entityRef"), kind)
            return
        if any(action.find(f".//{tag}") is not None or action.tag == tag for tag in _IGNORED):
            _log.warning("%s: an action without motion is left out", self.path)
            return
        if name not in self.users:
            if name in self._entities:
                return  # left out
            raise DataError(complaint(self.path, "entityRef", "a road user", name or action.tag))
        user = self.users[name]
        begin = {
            "TeleportAction": self._teleport,
            "SpeedAction": self._speed,
            "LaneChangeAction": self._change_lane,
            "FollowTrajectoryAction": self._follow,
        }
        for tag, method in begin.items():
            if (found := action.find(f".//{tag}")) is not None:
                method(user, time_s, found)
                return
        found = next((one for one in action.iter() if one.tag.endswith("Action") and one is not action), action)
        inner = next((one for one in found if one.tag.endswith("Action")), found)
        raise DataError(complaint(self.path, f"entity '{name}'", f"one of {', '.join(begin)}", inner.tag))

    def _come_or_leave(self, name: str, action: ET.Element) -> None:
        user = self.users.get(name)
        if user is None:
            return
        if action.find("DeleteEntityAction") is not None:
            user.pose = user.lane = None
        else:
            self._put(user, action.find("AddEntityAction/Position"))

    def _teleport(self, user: User, time_s: float, action: ET.Element) -> None:
        self._put(user, action.find("Position"))

    def _put(self, user: User, position: ET.Element | None) -> None:
        user.pose, user.lane = self._place(position)
        user.follow = user.shifting = None

    def _speed(self, user: User, time_s: float, action: ET.Element) -> None:
        absolute, relative = (action.find(f"SpeedActionTarget/{tag}") for tag in _TARGETS)
        if absolute is not None:
            wanted = self._number(absolute, "value")
        elif relative is not None:
            of, value = self._user(relative).speed, self._number(relative, "value")
            wanted = of * value if self._text(relative, "speedTargetValueType", "delta") == "factor" else of + value
        else:
            raise DataError(complaint(self.path, "SpeedActionTarget", " or ".join(_TARGETS), "none"))
        dynamics = action.find("SpeedActionDynamics")
        user.speeding = self._transition(dynamics, user.speed, wanted)
        if user.speeding.over:
            user.speed, user.speeding = wanted, None

    def _change_lane(self, user: User, time_s: float, action: ET.Element) -> None:
        lane = self._lane_of(user)
        if lane is None or self._roads is None:
            raise DataError(
                complaint(self.path, "LaneChangeAction", "a vehicle on a lane of an OpenDRIVE file", "none")
            )
        absolute, relative = (action.find(f"LaneChangeTarget/{tag}TargetLane") for tag in ("Absolute", "Relative"))
        if absolute is not None:
            target = round(self._number(absolute, "value"))
        elif relative is not None:
            of = self._lane_of(self._user(relative))
            if of is None:
                raise DataError(complaint(self.path, "RelativeTargetLane", "a vehicle on a lane", "one off the lanes"))
            target = _beside(of.lane, round(self._number(relative, "value")))
        else:
            raise DataError(complaint(self.path, "LaneChangeTarget", "an absolute or relative lane", "none"))
        road = self._roads.roads[lane.road]
        now, then = road.middle(lane.lane, lane.s), road.middle(target, lane.s)
        if now is None or then is None:
            raise DataError(complaint(self.path, "LaneChangeTarget", f"a lane of road {lane.road}", target))
        offset = self._number(action, "targetLaneOffset", 0.0)
        user.lane = lane._replace(lane=target, offset=now + lane.offset - then)
        dynamics = action.find("LaneChangeActionDynamics")
        user.shifting = self._transition(dynamics, user.lane.offset, offset)

    def _follow(self, user: User, time_s: float, action: ET.Element) -> None:
        trajectory = next(action.iter("Trajectory"), None)
        vertices = [] if trajectory is None else trajectory.findall("Shape/Polyline/Vertex")
        if len(vertices) < 2:
            shape = None if trajectory is None else trajectory.find("Shape/*")
            found = "none" if shape is None else shape.tag
            raise DataError(complaint(self.path, "FollowTrajectoryAction", "a Polyline of two vertices or more", found))
        places = np.array([self._place(one.find("Position"))[0] for one in vertices], np.float64)
        given = all(one.find("Position/WorldPosition[@h]") is not None for one in vertices)
        ways = np.diff(places[:, :2], axis=0)
        if not given:
            headings = np.arctan2(ways[:, 1], ways[:, 0])
            places[:, 3] = np.append(headings, headings[-1])
        places[:, 3] = np.unwrap(places[:, 3])
        timing = action.find("TimeReference/Timing")
        if timing is not None:
            key = np.array([self._number(one, "time") for one in vertices])
            key = key * self._number(timing, "scale", 1.0) + self._number(timing, "offset", 0.0)
            if self._text(timing, "domainAbsoluteRelative") == "relative":
                key = key + time_s
        else:
            key = np.concatenate([[0.0], np.cumsum(np.hypot(*ways.T))])
        if (np.diff(key) < 0.0).any():
            raise DataError(complaint(self.path, "Vertex", "times that ascend", "one before another"))
        user.follow, user.followed = Polyline(np.column_stack([places, key]), timing is not None), 0.0
        user.lane = user.shifting = None

    def _transition(self, dynamics: ET.Element | None, start: float, end: float) -> Change:
        if dynamics is None:
            raise DataError(complaint(self.path, "action", "its dynamics", "none"))
        name, value = self._text(dynamics, "dynamicsShape"), self._number(dynamics, "value", 0.0)
        if name not in SHAPES:
            raise DataError(complaint(self.path, "dynamicsShape", " or ".join(SHAPES), name))
        dimension = self._text(dynamics, "dynamicsDimension", "time")
        if name == "step":
            value = 0.0
        elif dimension == "rate":
            value = abs(end - start) / value if value > 0.0 else 0.0
        return Change(start, end, SHAPES[name], value, dimension == "distance")

    def _lane_of(self, user: User) -> LanePlace | None:
        if user.lane is None and user.pose is not None and self._roads is not None:
            user.lane = self._roads.nearest(user.pose.x, user.pose.y)
        return user.lane

    def _user(self, element: ET.Element) -> User:
        name = self._text(element, "entityRef")
        if name not in self.users:
            raise DataError(complaint(self.path, "entityRef", "a road user", name))
        return self.users[name]

    def _place(self, position: ET.Element | None) -> tuple[Pose, LanePlace | None]:
        """Return the pose of a position, and its lane where it names one."""
        one = None if position is None else next(iter(position), None)
        if one is None:
            raise DataError(complaint(self.path, "Position", "a place", "none"))
        if one.tag == "WorldPosition":
            x, y, z, heading = (self._number(one, key, 0.0 if key in "zh" else None) for key in "xyzh")
            return Pose(x, y, z, heading), None
        if one.tag == "LanePosition":
            lane = LanePlace(
                self._text(one, "roadId"),
                round(self._number(one, "laneId")),
                self._number(one, "s"),
                self._number(one, "offset", 0.0),
            )
        elif one.tag == "RelativeLanePosition":
            of = self._lane_of(self._user(one))
            if of is None:
                raise DataError(complaint(self.path, one.tag, "a road user on a lane", "one off the lanes"))
            ahead = self._number(one, "ds", 0.0) * (1.0 if of.lane < 0 else -1.0)
            beside = _beside(of.lane, round(self._number(one, "dLane")))
            lane = LanePlace(of.road, beside, of.s + ahead, self._number(one, "offset", 0.0))
        else:
            expected = "a WorldPosition, LanePosition or RelativeLanePosition"
            raise DataError(complaint(self.path, "Position", expected, one.tag))
        if self._roads is None:
            raise DataError(complaint(self.path, one.tag, "a LogicFile of OpenDRIVE", "none"))
        x, y, z, heading = self._roads.place(one.tag, lane)
        turned = one.find("Orientation")
        if turned is not None and turned.get("h") is not None:
            h = self._number(turned, "h")
            heading = heading + h if self._text(turned, "type", "absolute") == "relative" else h
        return Pose(x, y, z, heading), lane

    def _text(self, element: ET.Element, name: str, usual: str | None = None) -> str:
        text = element.get(name, usual)
        if text is not None and text.startswith("$"):
            text = self._parameters.get(text[1:])
        if text is None:
            raise DataError(complaint(self.path, f"{element.tag}: {name}", "a value", element.get(name) or "nothing"))
        return text

    def _number(self, element: ET.Element, name: str, usual: float | None = None) -> float:
        text = self._text(element, name, None if usual is None else repr(usual))
        return number_of(self.path, f"{element.tag}: {name}", text)


_TARGETS = ("AbsoluteTargetSpeed", "RelativeTargetSpeed")


def _beside(lane: int, left: int) -> int:
    """Return the lane so many to the left of another, as its traffic sees it; there is no lane 0."""
    target = lane + (left if lane < 0 else -left)
    if target * lane <= 0 and left:
        target += 1 if lane < 0 else -1
    return target
