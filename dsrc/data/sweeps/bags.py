"""Bags: MCAP files and rosbag2 folders with clouds, as ROS 2 or Foxglove messages; each topic of clouds is a sensor.

| read           | ROS 2                             | Foxglove in JSON           |
|----------------|-----------------------------------|----------------------------|
| clouds         | `sensor_msgs/PointCloud2`         | `foxglove.PointCloud`      |
| poses          | `/tf`, `/tf_static`               | `foxglove.FrameTransforms` |
| boxes, if any  | `visualization_msgs/MarkerArray`  | `foxglove.SceneUpdate`     |

Boxes are cubes whose class, `ns` of a marker or `class` among an entity's metadata, is one of ours.

The frames are those of the first topic by name; another sensor's is its nearest message. A topic `/agents/ID/...` is
that agent's, else sensors are numbered from 0. The world is the frame at the root of the transforms: without any, each
sensor's own. Points that are not finite are beams without a return. The scale of intensities is that of their type, for
floats 1, 255 or 65535 by the first message of each topic; one that does not fit later is an error.

Needs `rosbags` for ROS 2 and `mcap` for Foxglove. Sources: the message definitions of ROS 2 Humble;
https://docs.foxglove.dev/docs/sdk/schemas.
"""

import base64
import re
from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.sweeps.layout import BoxRows, Labels, Layout, poses_of, unit_intensity
from sensors.frame import agent_order
from sensors.sweep import Sweep, make_sweep
from sim.boxes import CLASSES
from sim.errors import DataError, SettingsError, complaint
from sim.reading import parsing

_CLOUDS = ("sensor_msgs/msg/PointCloud2", "foxglove.PointCloud")
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "foxglove.FrameTransforms")
_BOXES = ("visualization_msgs/msg/MarkerArray", "foxglove.SceneUpdate")
_ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FOXGLOVE_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
_INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "i")
_RING = ("ring", "laser_id", "channel", "line")
_AGENT = re.compile(r"/agents/(-?\d{1,9})/.*")
_CUBE = 1
_DEEPEST = 64
_SAME_NS = 1_000


class Message(NamedTuple):
    """Message of a bag, not decoded: its topic, type, time of writing and content."""

    topic: str
    kind: str
    time_ns: int
    content: Any


class Step(NamedTuple):
    """Transform of a frame in its parent over time: (T,) ns, (T, 4) w, x, y, z and (T, 3) m."""

    parent: str
    time_ns: list[int]
    turn: list[list[float]]
    place: list[list[float]]


Cube = tuple[int, str, list[float], list[float], list[float], str]


class Index(NamedTuple):
    """What a bag holds beside its clouds.

    Attributes:
        clouds: per topic the (times of writing, times of measurement) of its messages, ns.
        steps: transforms by the name of the frame.
        boxes: per time, ns, the id, class, place, turn w, x, y, z, size and frame of each object.
    """

    clouds: dict[str, list[tuple[int, int]]]
    steps: dict[str, Step]
    boxes: dict[int, list[Cube]]


class Bag(Layout):
    """Frames of a bag."""

    format = "bag"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with parsing(path, "bag"):
            self._index = _index(path)
            self._topics = sorted(self._index.clouds)
            named = [_AGENT.fullmatch(topic) for topic in self._topics]
            ids = [int(name[1]) if name else row for row, name in enumerate(named)]
            if len(set(ids)) < len(ids):
                ids = list(range(len(ids)))
            self.agents = tuple(agent_order(ids))
            self._topics = [self._topics[ids.index(agent)] for agent in self.agents]
            self.kinds = tuple("roadside" if agent < 0 else "vehicle" for agent in self.agents)
            self._stamps = self._index.clouds[self._topics[0]] if self._topics else []
            self.frames = tuple(range(len(self._stamps)))
            self.tracked = bool(self._index.steps)
            clouds = [self._cloud(topic, self._index.clouds[topic][0][0]) for topic in self._topics]
            self._frame_ids = [frame_id for frame_id, _ in clouds]
            self._scales = [_full_scale(table) for _, table in clouds]
            self.height_m = tuple(self._height(name) for name in self._frame_ids)

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the path itself: an MCAP file, a `.db3`, or a folder of rosbag2."""
        if folder.is_file():
            return [folder] if folder.suffix in (".mcap", ".db3") else []
        return [folder] if (folder / "metadata.yaml").is_file() else []

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a bag."""
        return cls(path) if cls.below(path) else None

    def time_s(self, i: int) -> float:
        """Return the time of measurement, s; since the first frame where it is a date."""
        first = self._stamps[0][1]
        return (self._stamps[i][1] - (first if first > _DATE_NS else 0)) / 1e9

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of each sensor by the transforms."""
        near = [self._near(topic, i)[1] for topic in self._topics]
        return [self._pose(name, stamp) for name, stamp in zip(self._frame_ids, near, strict=True)]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of each sensor."""
        found = []
        poses = self.poses(i)
        for row, topic in enumerate(self._topics):
            with parsing(self.path, f"cloud of {topic}"):
                _, table = self._cloud(topic, self._near(topic, i)[0])
                names = table.dtype.names or ()
                points = np.column_stack([table[name].astype(np.float32) for name in "xyz"])
                kept = np.isfinite(points).all(axis=1)
                columns: dict[str, Any] = {}
                intensity, ring = (next((n for n in known if n in names), None) for known in (_INTENSITY, _RING))
                if intensity is not None:
                    columns["intensity"] = unit_intensity(self.path, table[intensity][kept], self._scales[row])
                if ring is not None:
                    columns["ring"] = np.clip(table[ring][kept], 0, np.iinfo(np.int16).max)
                found.append(make_sweep(points[kept], poses[row], self.time_s(i), **columns))
        return found

    def labelled(self, i: int) -> bool:
        """Return whether the bag has boxes of the frame's time."""
        return self._stamps[i][1] in self._index.boxes

    def labels(self, i: int) -> Labels | None:
        """Return the boxes of a frame."""
        if not self.labelled(i):
            return None
        stamp, rows = self._stamps[i][1], BoxRows(dict(zip(CLASSES, CLASSES, strict=True)))
        for object_id, name, place, turn, size, frame_id in self._index.boxes[stamp]:
            if name not in CLASSES:
                continue
            # Four zeros are a turn that nobody set.
            turns = np.array([turn if any(turn) else [1.0, 0.0, 0.0, 0.0]])
            (cube,) = poses_of(self.path, turns, np.array([place]), "boxes")
            rows.add_body(name, self._pose(frame_id, stamp) @ cube, size, object_id)
        boxes, _ = rows.boxes(self.path, "boxes")
        if len(np.unique(boxes.object_id)) < len(boxes):
            raise DataError(complaint(self.path, "boxes", "each id once at a time", "one twice"))
        return Labels(boxes, tilt=rows.tilt())

    def files(self, i: int) -> list[Path]:
        """Return the file, or the files of the folder."""
        return _files(self.path)

    def _near(self, topic: str, i: int) -> tuple[int, int]:
        """Return the times of the message of a topic that is nearest to a frame."""
        listed, wanted = self._index.clouds[topic], self._stamps[i][1]
        return min(listed, key=lambda times: abs(times[1] - wanted))

    def _cloud(self, topic: str, time_ns: int) -> tuple[str, NDArray[np.void]]:
        """Return the frame and the (P,) records of a message of clouds."""
        for message in _messages(self.path, (topic,), time_ns):
            return _decoded_cloud(self.path, message)
        raise DataError(complaint(self.path, topic, "a message as listed", "none"))

    def _pose(self, name: str, time_ns: int) -> NDArray[np.float64]:
        """Return the (4, 4) pose of a frame in the root of its transforms."""
        pose = np.eye(4)
        for _ in range(_DEEPEST):
            step = self._index.steps.get(name)
            if step is None:
                return pose
            pose, name = _step_at(self.path, step, time_ns) @ pose, step.parent
        raise DataError(complaint(self.path, "transforms", "a tree", f"a circle through {name}"))

    def _height(self, name: str) -> float:
        """Return the height of a sensor over its parent frame, where that is a body's."""
        step = self._index.steps.get(name)
        body = step is not None and (step.parent in ("base_link", "base_footprint") or step.parent.startswith("agent_"))
        return float(step.place[0][2]) if step is not None and body and step.place[0][2] > 0.0 else 0.0


_DATE_NS = 10**17
"""Beyond three years a time is that of a clock, and no longer one of a simulation, ns."""


def _step_at(path: Path, step: Step, time_ns: int) -> NDArray[np.float64]:
    """Return a transform at a time, between its neighbours where it is none of its times."""
    after = min(bisect_left(step.time_ns, time_ns - _SAME_NS), len(step.time_ns) - 1)
    before = max(after - 1, 0)
    turn, place = np.array(step.turn[after]), np.array(step.place[after])
    gap = step.time_ns[after] - step.time_ns[before]
    if time_ns < step.time_ns[after] - _SAME_NS and gap > 0 and time_ns > step.time_ns[before]:
        share = (time_ns - step.time_ns[before]) / gap
        start = np.array(step.turn[before])
        turn = (1.0 - share) * start * np.sign(start @ turn or 1.0) + share * turn
        turn /= np.linalg.norm(turn)
        place = (1.0 - share) * np.array(step.place[before]) + share * place
    pose: NDArray[np.float64] = poses_of(path, turn[None], place[None], "transform")[0]
    return pose


def _full_scale(table: NDArray[np.void]) -> float:
    """Return the intensity that means 1, by its type or by the cloud's largest."""
    name = next((known for known in _INTENSITY if known in (table.dtype.names or ())), None)
    if name is None:
        return 1.0
    if table.dtype[name].kind in "ui":
        return float(np.iinfo(table.dtype[name]).max) if table.dtype[name].itemsize <= 2 else 65535.0
    values = table[name][np.isfinite(table[name])]
    highest = float(values.max()) if len(values) else 0.0
    return 1.0 if highest <= 1.01 else 255.0 if highest <= 257.0 else 65535.0


def _index(path: Path) -> Index:
    """Read a bag once: times of the clouds, transforms, boxes."""
    return _indexed(path, tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in _files(path)))


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())


@lru_cache(maxsize=4)
def _indexed(path: Path, state: tuple[tuple[str, int, int], ...]) -> Index:
    index = Index({}, {}, {})
    for message in _messages(path):
        if message.kind in _CLOUDS:
            stamp = _stamp(message)
            index.clouds.setdefault(message.topic, []).append((message.time_ns, stamp))
        elif message.kind in _TRANSFORMS:
            for name, parent, stamp, turn, place in _transforms(message):
                static = message.topic.endswith("tf_static")
                step = index.steps.get(name)
                if step is None or static:
                    step = index.steps[name] = Step(parent, [], [], [])
                step.time_ns.append(stamp)
                step.turn.append(turn)
                step.place.append(place)
        elif message.kind in _BOXES:
            for stamp, row in _cubes(message):
                index.boxes.setdefault(stamp, []).append(row)
    for name, step in index.steps.items():
        order = sorted(range(len(step.time_ns)), key=step.time_ns.__getitem__)
        sorted_step = (list(map(column.__getitem__, order)) for column in (step.time_ns, step.turn, step.place))
        index.steps[name] = Step(step.parent, *sorted_step)  # type: ignore[arg-type]
    for times in index.clouds.values():
        times.sort(key=lambda pair: pair[1])
    return index


def _stamp(message: Message) -> int:
    """Return the time of measurement of a cloud, ns: the first field of its header."""
    if isinstance(message.content, dict):
        time = message.content["timestamp"]
        return int(time["sec"]) * 10**9 + int(time["nsec"])
    # CDR: four bytes of encapsulation, whose second tells the byte order, then seconds and nanoseconds.
    order = "<" if message.content[1] & 1 else ">"
    seconds, nanoseconds = np.frombuffer(message.content, f"{order}u4", 2, 4).tolist()
    return int(seconds) * 10**9 + int(nanoseconds)


def _decoded_cloud(path: Path, message: Message) -> tuple[str, NDArray[np.void]]:
    if isinstance(message.content, dict):
        cloud = message.content
        fields = [(field["name"], field["offset"], _FOXGLOVE_TYPES[field["type"]], 1) for field in cloud["fields"]]
        data, stride, order = base64.b64decode(cloud["data"]), int(cloud["point_stride"]), "<"
        rows, row_bytes, frame_id = 1, len(data), cloud["frame_id"]
        if _is_moved(cloud.get("pose")):
            raise DataError(
                complaint(path, f"{message.topic}: pose", "none: transforms place the cloud", cloud["pose"])
            )
    else:
        ros = _store().deserialize_cdr(message.content, message.kind)
        fields = [(field.name, field.offset, _ROS_TYPES[field.datatype], field.count) for field in ros.fields]
        data, stride, order = bytes(ros.data), ros.point_step, ">" if ros.is_bigendian else "<"
        rows, row_bytes, frame_id = ros.height, ros.row_step, ros.header.frame_id
        if ros.width * stride > row_bytes and rows > 1:
            raise DataError(complaint(path, message.topic, f"rows of {ros.width * stride} bytes", row_bytes))
        if rows > 1:  # which may end with padding
            data = b"".join(data[k * row_bytes : k * row_bytes + ros.width * stride] for k in range(rows))
    missing = [axis for axis in "xyz" if axis not in [name for name, *_ in fields]]
    if missing or stride < 1 or len(data) % stride:
        found = " ".join(name for name, *_ in fields)
        raise DataError(complaint(path, message.topic, "whole points with fields x, y, z", found))
    scalar = [(name, offset, kind) for name, offset, kind, count in fields if count <= 1]
    names, offsets, kinds = zip(*scalar, strict=True)
    dtype = np.dtype(
        {"names": names, "offsets": offsets, "formats": [f"{order}{kind}" for kind in kinds], "itemsize": stride}
    )
    return str(frame_id).lstrip("/"), np.frombuffer(data, dtype)


_STILL = 1e-9
"""Largest number of a pose that is none but for rounding."""


def _is_moved(pose: Any) -> bool:
    """Return whether a pose of Foxglove's is another than that of its frame."""
    if not pose:
        return False
    place, turn = pose.get("position") or {}, pose.get("orientation") or {}
    return any(abs(part.get(axis, 0.0)) > _STILL for part in (place, turn) for axis in "xyz")


def _transforms(message: Message) -> Iterator[tuple[str, str, int, list[float], list[float]]]:
    """Yield child, parent, time in ns, turn w, x, y, z and place of the transforms of a message."""
    if isinstance(message.content, dict):
        for one in message.content["transforms"]:
            stamp = int(one["timestamp"]["sec"]) * 10**9 + int(one["timestamp"]["nsec"])
            turn, place = [one["rotation"][k] for k in "wxyz"], [one["translation"][k] for k in "xyz"]
            yield one["child_frame_id"].lstrip("/"), one["parent_frame_id"].lstrip("/"), stamp, turn, place
        return
    for one in _store().deserialize_cdr(message.content, message.kind).transforms:
        stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
        turn = [getattr(one.transform.rotation, k) for k in "wxyz"]
        place = [getattr(one.transform.translation, k) for k in "xyz"]
        yield one.child_frame_id.lstrip("/"), one.header.frame_id.lstrip("/"), stamp, turn, place


def _cubes(message: Message) -> Iterator[tuple[int, Cube]]:
    """Yield time in ns and the cubes, as in `Index`, of a message whose class is one of ours."""
    if isinstance(message.content, dict):
        for entity in message.content["entities"]:
            stamp = int(entity["timestamp"]["sec"]) * 10**9 + int(entity["timestamp"]["nsec"])
            facts = {pair["key"]: pair["value"] for pair in entity["metadata"]}
            for cube in entity["cubes"]:
                pose, size = cube["pose"], [cube["size"][k] for k in "xyz"]
                turn, place = [pose["orientation"][k] for k in "wxyz"], [pose["position"][k] for k in "xyz"]
                name, frame_id = str(facts.get("class", "")), entity["frame_id"].lstrip("/")
                yield stamp, (int(entity["id"]), name, place, turn, size, frame_id)
        return
    for one in _store().deserialize_cdr(message.content, message.kind).markers:
        if one.type != _CUBE or one.action != 0 or one.ns not in CLASSES:
            continue
        stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
        turn = [getattr(one.pose.orientation, k) for k in "wxyz"]
        place, size = ([getattr(of, k) for k in "xyz"] for of in (one.pose.position, one.scale))
        yield stamp, (int(one.id), one.ns, place, turn, size, one.header.frame_id.lstrip("/"))


@lru_cache(maxsize=1)
def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _messages(path: Path, topics: tuple[str, ...] | None = None, time_ns: int | None = None) -> Iterator[Message]:
    """Yield the messages of the kinds that are read, of all topics or of some at one time of writing."""
    if path.suffix == ".mcap" and _is_json(path):
        yield from _of_foxglove(path, topics, time_ns)
        return
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise SettingsError(
            f"{path}: expected the package rosbags, found none; pip install 'dsrc-testbed[ros]'"
        ) from None
    kinds = (*_CLOUDS, *_TRANSFORMS, *_BOXES)
    span: dict[str, Any] = {} if time_ns is None else {"start": time_ns, "stop": time_ns + 1}
    with Reader(path) as reader:
        wanted = [one for one in reader.connections if one.msgtype in kinds and (topics is None or one.topic in topics)]
        for connection, written_ns, content in reader.messages(connections=wanted, **span) if wanted else ():
            yield Message(connection.topic, connection.msgtype, written_ns, bytes(content))


def _mcap_reader(file: Any) -> Any:
    try:
        from mcap.reader import make_reader
    except ImportError:
        raise SettingsError("mcap: expected the package mcap, found none; pip install 'dsrc-testbed[mcap]'") from None
    return make_reader(file)


def _is_json(path: Path) -> bool:
    """Return whether an MCAP file holds Foxglove's messages in JSON."""
    with path.open("rb") as file:
        summary = _mcap_reader(file).get_summary()
    return summary is not None and any(schema.name in _CLOUDS[1:] for schema in summary.schemas.values())


def _of_foxglove(path: Path, topics: tuple[str, ...] | None, time_ns: int | None) -> Iterator[Message]:
    span = {} if time_ns is None else {"start_time": time_ns, "end_time": time_ns + 1}
    with path.open("rb") as file:
        for schema, channel, message in _mcap_reader(file).iter_messages(topics=topics, **span):
            if schema is not None and schema.name in (*_CLOUDS, *_TRANSFORMS, *_BOXES):
                if channel.message_encoding != "json":
                    expected = "messages in json, the one encoding of Foxglove's that is read"
                    raise DataError(complaint(path, channel.topic, expected, channel.message_encoding or "none"))
                content = msgspec.json.decode(message.data)
                yield Message(channel.topic, schema.name, message.log_time, content)
