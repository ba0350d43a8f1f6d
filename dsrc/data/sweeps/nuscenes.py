"""nuScenes: tables in JSON, a scene is a drive, its key frames are the frames; LIDAR_TOP alone is read.

    TREE/VERSION/{scene, sample, sample_data, sample_annotation, instance, category, ego_pose, calibrated_sensor,
    sensor}.json, VERSION such as v1.0-mini; clouds at the `filename` of a row of `sample_data`, below TREE
    TREE/VERSION/SCENE      the path of a drive, which need not exist

Points are x right, y forward in their files and are turned here to x forward, y left. Intensities are of 0 to 255,
rings count from the bottom. The LiDAR is a Velodyne HDL-32E. A scene of the test split has no annotations.

Source: the schema of nuScenes (docs/schema_nuscenes.md of nuscenes-devkit); H. Caesar et al., CVPR 2020.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.cloud import columns_of
from dsrc.data.clouds.files import NUSCENES_SENSOR
from dsrc.data.jsonio import read_json
from dsrc.data.sweeps.layout import (
    IGNORED,
    BoxRows,
    Labels,
    Layout,
    eight_bit_intensity,
    finite,
    poses_of,
    read_floats,
)
from sensors.frame import Region
from sensors.presets import LIDARS, get_lidar
from sensors.sweep import Sweep, make_sweep
from sim.errors import DataError, complaint

CHANNEL = "LIDAR_TOP"
_MOST_RINGS = 1 << 12
FORWARD_FROM_RIGHT = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""(4, 4) from nuScenes' axes of a LiDAR, x right and y forward, to ours, x forward and y left."""
CLASSES = {
    "vehicle.car": "car",
    "vehicle.emergency.police": "car",
    "vehicle.emergency.ambulance": "van",
    "vehicle.truck": "truck",
    "vehicle.construction": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.trailer": IGNORED,
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "human.pedestrian.personal_mobility": IGNORED,
    "human.pedestrian.stroller": IGNORED,
    "human.pedestrian.wheelchair": IGNORED,
}
EXTRA_CLASSES = {"vehicle.van": "van"}
"""Classes that nuScenes has not, and `dsrc dataset convert` writes."""

Vector = tuple[float, float, float]
Turn = tuple[float, float, float, float]


class Scene(msgspec.Struct):
    """Row of `scene`."""

    token: str
    name: str


class SampleRow(msgspec.Struct):
    """Row of `sample`; time in µs."""

    token: str
    timestamp: int
    scene_token: str


class SampleData(msgspec.Struct):
    """Row of `sample_data`."""

    token: str
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str
    timestamp: int
    is_key_frame: bool


class Pose(msgspec.Struct):
    """Row of `ego_pose` or `calibrated_sensor`."""

    token: str
    translation: Vector
    rotation: Turn
    sensor_token: str = ""


class Sensor(msgspec.Struct):
    """Row of `sensor`; a model, "" for unknown, in tables of ours alone."""

    token: str
    channel: str
    model: str = NUSCENES_SENSOR


class Annotation(msgspec.Struct):
    """Row of `sample_annotation`; size is width, length, height."""

    sample_token: str
    instance_token: str
    translation: Vector
    size: Vector
    rotation: Turn


class Instance(msgspec.Struct):
    """Row of `instance`; an object id in tables of ours alone."""

    token: str
    category_token: str
    object_id: int | None = None


class Category(msgspec.Struct):
    """Row of `category`."""

    token: str
    name: str


class Key(NamedTuple):
    """Key frame of a scene."""

    time_us: int
    file: Path
    pose: NDArray[np.float64]
    sensor: str
    annotations: tuple[Annotation, ...]


class Tables(NamedTuple):
    """Content of the tables, as far as it is read.

    Attributes:
        scenes: key frames by the name of a scene, in time.
        height_m: of the LiDAR above the car's origin, which is on the ground.
        category: by instance.
        row: number of each instance, from 1 on.
    """

    scenes: dict[str, list[Key]]
    height_m: float
    category: dict[str, str]
    row: dict[str, int]
    annotated: bool


class NuScenes(Layout):
    """Key frames of a scene."""

    format = "nuScenes"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._tables = read_tables(path.parent)
        self._keys = self._tables.scenes[path.name]
        self.frames = tuple(range(len(self._keys)))
        self.height_m = (self._tables.height_m,)
        self.tracked = True

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the scenes of the tables of a folder, or of the folders in it."""
        versions = [folder, *sorted(folder.glob("v1.*"))] if folder.is_dir() else []
        if folder.parent.is_dir() and _is_version(folder.parent) and folder.name in read_tables(folder.parent).scenes:
            return [folder]
        tables = [version for version in versions if _is_version(version)]
        return [version / name for version in tables for name in sorted(read_tables(version).scenes)]

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a scene."""
        known = _is_version(path.parent) and path.name in read_tables(path.parent).scenes
        return cls(path) if known else None

    def time_s(self, i: int) -> float:
        """Return the time since the first frame, s."""
        return (self._keys[i].time_us - self._keys[0].time_us) * 1e-6

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of LIDAR_TOP, with our axes, in the map."""
        return [self._keys[i].pose]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of a key frame."""
        path = self._keys[i].file
        rows = read_floats(path, 5, "nuScenes scan")
        finite(path, rows)
        points = np.column_stack([rows[:, 1], -rows[:, 0], rows[:, 2]])
        sensor, below = self._keys[i].sensor, rows[:, 4]
        spec = get_lidar(sensor) if sensor in LIDARS else None
        rings = _MOST_RINGS if spec is None else spec.rings
        if not ((below >= 0) & (below < rings) & (below == np.floor(below))).all():
            raise DataError(complaint(path, "ring", f"whole numbers from 0 to {rings - 1}", "others"))
        if spec is None:
            rings = int(below.max(initial=0)) + 1
        ring = rings - 1 - below.astype(np.int64)
        columns: dict[str, Any] = {"intensity": eight_bit_intensity(path, rows[:, 3]), "ring": ring}
        if spec is not None and not spec.prisms:
            columns["column"] = column = columns_of(points, ring, spec)
            columns["time_offset"] = spec.time_offset[ring, column]
        return [make_sweep(points, self._keys[i].pose, self.time_s(i), spec, **columns)]

    def labelled(self, i: int) -> bool:
        """Return whether the tables have annotations."""
        return self._tables.annotated

    def labels(self, i: int) -> Labels | None:
        """Return the annotated objects of a key frame."""
        if not self._tables.annotated:
            return None
        found, rows = BoxRows(CLASSES | EXTRA_CLASSES), self._keys[i].annotations
        where = self.path.parent / "sample_annotation.json"
        turns = np.array([row.rotation for row in rows], np.float64).reshape(-1, 4)
        axes = poses_of(where, turns, np.array([row.translation for row in rows], np.float64).reshape(-1, 3))
        for row, pose in zip(rows, axes, strict=True):
            width, length, height = row.size
            category = self._tables.category.get(row.instance_token, "")
            found.add_body(category, pose, (length, width, height), self._tables.row.get(row.instance_token, 0))
        boxes, ignored = found.boxes(where, "boxes")
        if len(np.unique(boxes.object_id)) < len(boxes):
            raise DataError(complaint(where, "instance_token", "each instance once in a sample", "one twice"))
        return Labels(boxes, None, Region(ignored=ignored), found.tilt())

    def files(self, i: int) -> list[Path]:
        """Return the scan and the tables."""
        names = ("sample_annotation", "ego_pose", "calibrated_sensor", "instance", "category")
        return [self._keys[i].file, *(self.path.parent / f"{name}.json" for name in names)]


def _is_version(folder: Path) -> bool:
    return all((folder / f"{name}.json").is_file() for name in ("scene", "sample", "sample_data", "ego_pose"))


def read_tables(version: Path) -> Tables:
    """Return the tables of a version, kept while its files stay as they are; DataError where one is damaged."""
    state = tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(version.glob("*.json")))
    return _read_tables(version, state)


@lru_cache(maxsize=2)
def _read_tables(version: Path, state: tuple[tuple[str, int, int], ...]) -> Tables:
    lidars = {row.token: row.model for row in _rows(version, "sensor", Sensor) if row.channel == CHANNEL}
    mounts = {row.token: row for row in _rows(version, "calibrated_sensor", Pose) if row.sensor_token in lidars}
    places = {row.token: row for row in _rows(version, "ego_pose", Pose)}
    mount_poses = _poses(version / "calibrated_sensor.json", mounts)
    body_poses = _poses(version / "ego_pose.json", places)
    listed = version / "sample_annotation.json"
    notes: dict[str, list[Annotation]] = {}
    for note in _rows(version, "sample_annotation", Annotation) if listed.is_file() else ():
        notes.setdefault(note.sample_token, []).append(note)
    samples = {row.token: row for row in _rows(version, "sample", SampleRow)}
    names = {row.token: row.name for row in _rows(version, "scene", Scene)}
    scenes: dict[str, list[Key]] = {name: [] for name in names.values()}
    where = version / "sample_data.json"
    for row in _rows(version, "sample_data", SampleData):
        if not row.is_key_frame or row.calibrated_sensor_token not in mounts:
            continue
        sample = samples.get(row.sample_token)
        if sample is None or sample.scene_token not in names or row.ego_pose_token not in body_poses:
            raise DataError(complaint(where, f"row {row.token}", "a sample, its scene and an ego pose", "one missing"))
        file = version.parent / row.filename
        if not file.resolve().is_relative_to(version.parent.resolve()):
            raise DataError(complaint(where, "filename", f"a file below {version.parent}", row.filename))
        forward = np.linalg.inv(FORWARD_FROM_RIGHT)
        pose = body_poses[row.ego_pose_token] @ mount_poses[row.calibrated_sensor_token] @ forward
        model = lidars[mounts[row.calibrated_sensor_token].sensor_token]
        key = Key(row.timestamp, file, pose, model, tuple(notes.get(sample.token, ())))
        scenes[names[sample.scene_token]].append(key)
    for keys in scenes.values():
        keys.sort(key=lambda key: key.time_us)
    categories = {row.token: row.name for row in _rows(version, "category", Category)}
    instances = _rows(version, "instance", Instance) if (version / "instance.json").is_file() else []
    heights = [float(pose[2, 3]) for pose in mount_poses.values()]
    return Tables(
        scenes={name: keys for name, keys in scenes.items() if keys},
        height_m=heights[0] if heights else 0.0,
        category={row.token: categories.get(row.category_token, "") for row in instances},
        row={
            row.token: number if row.object_id is None else row.object_id
            for number, row in enumerate(sorted(instances, key=lambda one: one.token), 1)
        },
        annotated=bool(notes),
    )


T = TypeVar("T")


def _rows(version: Path, name: str, kind: type[T]) -> list[T]:
    return read_json(version / f"{name}.json", list[kind])  # type: ignore[valid-type]


def _poses(path: Path, rows: dict[str, Pose]) -> dict[str, NDArray[np.float64]]:
    turns = np.array([row.rotation for row in rows.values()], np.float64).reshape(-1, 4)
    places = np.array([row.translation for row in rows.values()], np.float64).reshape(-1, 3)
    return dict(zip(rows, poses_of(path, turns, places), strict=True))
