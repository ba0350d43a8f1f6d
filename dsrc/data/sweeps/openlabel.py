"""OpenLABEL with 3D cuboids, as the TUM Traffic data sets use it: A9, Intersection, V2X Cooperative Perception.

    SPLIT/labels_point_clouds/SENSOR/STEM.json      `openlabel`: frames of objects; a file for a scan, or for many
    SPLIT/point_clouds/SENSOR/STEM.pcd              clouds, found by `point_cloud_file_names` of a frame, else by STEM
    SPLIT/SENSOR        the path of a drive, which need not exist; SPLIT where labels are in no folder of a sensor

A cuboid is x, y, z, qx, qy, qz, qw, length, width, height, or has Euler angles rx, ry, rz in place of the quaternion.
It is in the coordinate system that it names, else in that of the sensor with whose name the labels' folder begins.
Sensors whose systems lead to one root are the agents, and the root is the world; a cloud that was merged of theirs is
left out. Where none is known the labels' own cloud is the one agent, in its own frame. `pose_wrt_parent` maps points
to the parent, `transform_src_to_dst` from the source to the destination. Systems of the types `sensor_cs` and
`scene_cs` keep the first where a frame has both: the development kit writes its inverse into the second.

Sensors with names such as `s110_lidar` stand at the road. What clouds do not say may stand in `scans.toml` beside them.

Sources: ASAM OpenLABEL 1.0.0, sections on coordinate systems, frames and cuboids, and its JSON schema; the TUM Traffic
dataset development kit; W. Zimmer et al., CVPR 2024 (TUMTraf V2X) and ITSC 2023 (TUMTraf Intersection).
"""

import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.jsonio import read_json
from dsrc.data.sweeps.layout import FARTHEST_M, IGNORED, BoxRows, Labels, Layout, poses_of
from dsrc.data.sweeps.scans import Scans
from sensors.frame import Region, agent_order
from sensors.sweep import Sweep
from sim.boxes import Boxes, concatenate
from sim.errors import DataError, complaint
from sim.geometry import invert

CLASSES = {
    "CAR": "car",
    "VAN": "van",
    "TRUCK": "truck",
    "BUS": "bus",
    "EMERGENCY_VEHICLE": "van",
    "MOTORCYCLE": "motorcycle",
    "BICYCLE": "bicycle",
    "PEDESTRIAN": "pedestrian",
    "TRAILER": IGNORED,
    "OTHER": IGNORED,
}
_LABELS, _CLOUDS = "labels_point_clouds", "point_clouds"
_ROADSIDE = re.compile(r"[a-z]\d{3}_|rsu|roadside|infrastructure")
_STAMP = re.compile(r"(\d{9,10})_(\d{9})")
_FIXED = ("sensor_cs", "scene_cs")
_QUATERNION, _EULER = 10, 9
_TURN_TOLERANCE = 1e-2


class TransformData(msgspec.Struct):
    """`transform_data` of the schema: a matrix, 16 numbers or 4 rows, or a quaternion x, y, z, w and a translation."""

    matrix4x4: list[float | list[float]] | None = None
    quaternion: tuple[float, float, float, float] | None = None
    translation: tuple[float, float, float] | None = None


class CoordinateSystem(msgspec.Struct):
    """Coordinate system, by its name in `coordinate_systems`."""

    type: str = ""
    parent: str = ""
    pose_wrt_parent: TransformData | None = None


class Transform(msgspec.Struct):
    """Transform of a frame."""

    src: str
    dst: str
    transform_src_to_dst: TransformData


class FrameProperties(msgspec.Struct):
    """Properties of a frame; time in s."""

    timestamp: float | None = None
    point_cloud_file_names: list[str] = []
    point_cloud_file_name: str | None = None
    transforms: dict[str, Transform] = {}


class Cuboid(msgspec.Struct):
    """Box of an object; see the module."""

    val: list[float]
    coordinate_system: str | None = None


class ObjectData(msgspec.Struct):
    """Data of an object in a frame; its class stands here in TUMTraf's files."""

    type: str | None = None
    cuboid: Cuboid | list[Cuboid] | None = None


class Object(msgspec.Struct):
    """Object of a frame, or of the whole file, where the standard has its class."""

    type: str | None = None
    object_data: ObjectData = msgspec.field(default_factory=ObjectData)


class FrameRow(msgspec.Struct):
    """One frame."""

    objects: dict[str, Object] = {}
    frame_properties: FrameProperties = msgspec.field(default_factory=FrameProperties)


class OpenLabelContent(msgspec.Struct):
    """Content of `openlabel`, as far as it is read."""

    frames: dict[str, FrameRow] = {}
    objects: dict[str, Object] = {}
    coordinate_systems: dict[str, CoordinateSystem] = {}


class OpenLabelFile(msgspec.Struct):
    """Content of a file."""

    openlabel: OpenLabelContent


class Moment(NamedTuple):
    """One frame of a drive.

    Attributes:
        file: that it stands in.
        place: name of its field there.
        clouds: by the sensor, those of the agents.
        world_from: (4, 4) by the coordinate system, of all that lead to the world.
        reference: coordinate system of cuboids that name none.
    """

    file: Path
    place: str
    content: OpenLabelContent
    row: FrameRow
    clouds: dict[str, Path]
    world_from: dict[str, NDArray[np.float64]]
    reference: str


class OpenLabel(Layout):
    """Frames of the labels of one sensor, or of several registered ones."""

    format = "OpenLABEL"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        split, labels = _folders_of(path) or (path, path)
        clouds = {file.name: file for file in sorted((split / _CLOUDS).rglob("*.pcd"), reverse=True)}
        self._moments = [
            _moment(file, number, content, clouds)
            for file in sorted(labels.glob("*.json"))
            for number, content in _numbered(file)
        ]
        numbers = [int(moment.place.rpartition(".")[2]) for moment in self._moments]
        rising = all(a < b for a, b in pairwise(numbers))
        self.frames = tuple(numbers if rising else range(len(numbers)))
        names = sorted(self._moments[0].clouds) if self._moments else []
        roadside = [name for name in names if _ROADSIDE.match(name)]
        vehicles = [name for name in names if name not in roadside]
        ids = {name: number for number, name in enumerate(vehicles)}
        ids |= {name: -number for number, name in enumerate(roadside, 1)}
        self.agents = tuple(agent_order(list(ids.values())))
        self._sensors = {number: name for name, number in ids.items()}
        self.kinds = tuple("roadside" if number < 0 else "vehicle" for number in self.agents)
        for moment in self._moments:
            if sorted(moment.clouds) != names:
                found = ", ".join(sorted(moment.clouds)) or "none"
                raise DataError(complaint(moment.file, moment.place, f"clouds and poses of {', '.join(names)}", found))
        self._scans = lru_cache(maxsize=None)(Scans)
        self.height_m = tuple(self._scans(self._cloud(0, agent).parent).height_m[0] for agent in self.agents if names)
        self.tracked = all(name in roadside or len(self._moments[0].world_from) > 1 for name in names)
        objects = sorted({name for moment in self._moments for name in moment.row.objects})
        self._ids = {name: number for number, name in enumerate(objects, max(1, len(vehicles)))}

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the drives of a split, of its folder of labels or one in it, or the path itself."""
        if _folders_of(folder) is not None:
            return [folder]
        if folder.name == _LABELS or folder.parent.name == _LABELS:
            split = folder.parent if folder.name == _LABELS else folder.parent.parent
            below = cls.below(split)
            return below if folder.name == _LABELS else [path for path in below if path.name == folder.name]
        names = sorted(path.name for path in (folder / _LABELS).glob("*/"))
        return [folder / name for name in names if _folders_of(folder / name) is not None]

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a drive."""
        return None if _folders_of(path) is None else cls(path)

    def time_s(self, i: int) -> float:
        """Return the time since the first frame by `timestamp`, else by the file's name, else 0.1 s a number, s."""
        first, now = _time_of(self._moments[0]), _time_of(self._moments[i])
        return super().time_s(i) if first is None or now is None else now - first

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of each sensor in the world."""
        moment = self._moments[i]
        names = (self._sensors[agent] for agent in self.agents)
        return [moment.world_from.get(name, moment.world_from[moment.reference]) for name in names]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of each sensor."""
        files = [self._cloud(i, agent) for agent in self.agents]
        rows = zip(files, self.poses(i), strict=True)
        return [self._scans(file.parent).sweep(file, pose, self.time_s(i)) for file, pose in rows]

    def labelled(self, i: int) -> bool:
        """Return True: every frame is one of a label file."""
        return True

    def labels(self, i: int) -> Labels:
        """Return the cuboids of a frame."""
        moment = self._moments[i]
        found: list[Boxes] = []
        spared: list[Boxes] = []
        for name, row in moment.row.objects.items():
            place = f"{moment.place}.objects.{name}.object_data.cuboid"
            whole = moment.content.objects.get(name)
            kind = row.object_data.type or row.type or (None if whole is None else whole.type) or ""
            given = row.object_data.cuboid
            cuboids = [] if given is None else given if isinstance(given, list) else [given]
            for cuboid in cuboids[:1]:
                system = cuboid.coordinate_system or moment.reference
                if system not in moment.world_from:
                    expected = f"one of {', '.join(sorted(moment.world_from))}"
                    raise DataError(complaint(moment.file, f"{place}.coordinate_system", expected, system))
                rows = BoxRows(CLASSES)
                box = _box(moment.file, f"{place}.val", cuboid.val)
                rows.add(kind.upper().replace(" ", "_"), box, self._ids[name])
                boxes, ignored = rows.boxes(moment.file, f"{place}.val")
                found.append(boxes.transform(moment.world_from[system]))
                spared.append(ignored.transform(moment.world_from[system]))
        return Labels(concatenate(found), None, Region(ignored=concatenate(spared)))

    def files(self, i: int) -> list[Path]:
        """Return the clouds and the label file."""
        return [*(self._cloud(i, agent) for agent in self.agents), self._moments[i].file]

    def _cloud(self, i: int, agent: int) -> Path:
        return self._moments[i].clouds[self._sensors[agent]]


def _folders_of(path: Path) -> tuple[Path, Path] | None:
    """Return the folders of a drive's split and of its label files, None where the path is of no drive."""
    for split, labels in ((path.parent, path.parent / _LABELS / path.name), (path, path / _LABELS)):
        if (split / _CLOUDS).is_dir() and any(labels.glob("*.json")):
            return split, labels
    return None


def _numbered(file: Path) -> list[tuple[str, OpenLabelContent]]:
    """Return the numbers of the frames of a file, ascending, and its content."""
    content = read_json(file, OpenLabelFile).openlabel
    for name in content.frames:
        if not (name.isascii() and name.isdecimal() and len(name) < 10):
            raise DataError(complaint(file, "openlabel.frames", "whole numbers as names", name))
    return [(name, content) for name in sorted(content.frames, key=int)]


def _moment(file: Path, number: str, content: OpenLabelContent, clouds: dict[str, Path]) -> Moment:
    """Return one frame, with its clouds of those there are by name, and the poses."""
    row, place = content.frames[number], f"openlabel.frames.{number}"
    properties = row.frame_properties
    listed = [*properties.point_cloud_file_names, properties.point_cloud_file_name or f"{file.stem}.pcd"]
    there = {cloud.parent.name: cloud for name in listed if (cloud := clouds.get(Path(name).name)) is not None}
    if not there:
        expected = f"a file in {_CLOUDS}"
        raise DataError(complaint(file, f"{place}.frame_properties.point_cloud_file_names", expected, listed[0]))
    parents = _parents(file, place, content, properties)
    known = sorted({*parents, *(parent for parent, _ in parents.values())}, key=len)
    labels = file.parent.name
    own = labels if labels in there else next(iter(there))
    reference = next((name for name in reversed(known) if labels.startswith(name)), own)
    roots = {name: _root(file, place, name, parents) for name in {*known, *there, reference}}
    world = roots[reference][0]
    world_from = {name: pose for name, (root, pose) in roots.items() if root == world}
    agents = {name: cloud for name, cloud in there.items() if name in world_from}
    return Moment(file, place, content, row, agents or {own: there[own]}, world_from, reference)


_Parents = dict[str, tuple[str, NDArray[np.float64]]]


def _parents(file: Path, place: str, content: OpenLabelContent, properties: FrameProperties) -> _Parents:
    """Return the parent of each coordinate system whose pose is known, and (4, 4) parent_from_system."""
    systems = content.coordinate_systems
    found: _Parents = {}
    for name, system in systems.items():
        if system.parent and system.pose_wrt_parent not in (None, TransformData()):
            where = f"openlabel.coordinate_systems.{name}.pose_wrt_parent"
            found[name] = system.parent, _matrix(file, where, system.pose_wrt_parent)
    for name, transform in properties.transforms.items():
        where = f"{place}.frame_properties.transforms.{name}.transform_src_to_dst"
        matrix = _matrix(file, where, transform.transform_src_to_dst)
        child, parent = transform.src, transform.dst
        if parent in systems and systems[parent].parent == child:
            child, parent, matrix = parent, child, invert(matrix)
        if child not in found or child not in systems or systems[child].type not in _FIXED:
            found[child] = parent, matrix
    return found


def _root(file: Path, place: str, name: str, parents: _Parents) -> tuple[str, NDArray[np.float64]]:
    """Return the root to which a coordinate system leads, and (4, 4) root_from_system."""
    pose, seen = np.eye(4), {name}
    while name in parents:
        name, matrix = parents[name]
        pose = matrix @ pose
        if name in seen:
            raise DataError(complaint(file, f"{place}: coordinate systems", "parents that end in a root", "a circle"))
        seen.add(name)
    return name, pose


def _matrix(file: Path, place: str, given: TransformData | None) -> NDArray[np.float64]:
    """Return the (4, 4) pose of `transform_data`; DataError where it is no rigid one."""
    if given is not None and given.matrix4x4 is None and given.quaternion is not None and given.translation is not None:
        x, y, z, w = given.quaternion
        turn, at = np.array([[w, x, y, z]], np.float64), np.array([given.translation], np.float64)
        pose: NDArray[np.float64] = poses_of(file, turn, at, place)[0]
        return pose
    rows = [] if given is None or given.matrix4x4 is None else given.matrix4x4
    values = [value for row in rows for value in (row if isinstance(row, list) else [row])]
    if len(values) != 16:
        found = f"{len(values)} numbers" if values else "neither"
        raise DataError(complaint(file, place, "matrix4x4 of 16 numbers, or quaternion and translation", found))
    matrix = np.array(values, np.float64).reshape(4, 4)
    turn = np.clip(matrix[:3, :3], -2.0, 2.0)
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _TURN_TOLERANCE and np.linalg.det(turn) > 0.0
    if not (rigid and (np.abs(matrix[:3, 3]) <= FARTHEST_M).all() and matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0]):
        expected = "a rotation and a place, the last row 0 0 0 1"
        raise DataError(complaint(file, f"{place}.matrix4x4", expected, "another matrix"))
    return matrix


def _box(file: Path, place: str, val: list[float]) -> list[float]:
    """Return x, y, z, length, width, height, yaw of a cuboid."""
    if len(val) not in (_QUATERNION, _EULER):
        expected = "x, y, z, a quaternion qx, qy, qz, qw or angles rx, ry, rz, and three sizes"
        raise DataError(complaint(file, place, expected, f"{len(val)} numbers"))
    if len(val) == _EULER:
        from scipy.spatial.transform import Rotation  # a third of a second, and few trees are OpenLABEL's

        turn = Rotation.from_euler("xyz", val[3:6]).as_matrix()
    else:
        x, y, z, w = val[3:7]
        turn = poses_of(file, np.array([[w, x, y, z]]), np.array([val[:3]]), place)[0]
    return [*val[:3], *val[-3:], float(np.arctan2(turn[1, 0], turn[0, 0]))]


def _time_of(moment: Moment) -> float | None:
    """Return the time of a frame by its timestamp, else by seconds and nanoseconds in the file's name, s."""
    if moment.row.frame_properties.timestamp is not None:
        return moment.row.frame_properties.timestamp
    stamp = _STAMP.match(moment.file.stem)
    return None if stamp is None or len(moment.content.frames) > 1 else int(stamp[1]) + int(stamp[2]) * 1e-9
