"""Files of a DAIR-V2X-C tree: their paths and the structure of their JSON.

    cooperative-vehicle-infrastructure/
      cooperative/            data_info.json (the pairs)  label_world/ID.json
      vehicle-side/           data_info.json  velodyne/ID.pcd  calib/{lidar_to_novatel,novatel_to_world}/ID.json
      infrastructure-side/    data_info.json  velodyne/ID.pcd  calib/virtuallidar_to_world/ID.json

Downloads have their point clouds in folders beside the tree, `TREE-vehicle-side-velodyne/ID.pcd`, which are found too.
Trees with the complemented (360 degree) labels have the original ones in `label_world_backup`.

Source: AIR-THU/DAIR-V2X, data/README.md; the dataset's own README (label format).
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.data.jsonio import read_json
from sensors.frame import AgentKind
from sensors.spec import LidarSpec
from sensors.sweep import Motion
from sim.boxes import Boxes
from sim.errors import DataError, complaint
from sim.geometry import nearest_rotation, wrap_angle

_log = logging.getLogger(__name__)

TREE = "cooperative-vehicle-infrastructure"
PAIRS = "cooperative/data_info.json"
SIDECAR = "testbed.json"
SPLIT = "cooperative-split-data.json"
SIDES = ("vehicle-side", "infrastructure-side")
_SPLITS = ("train", "val", "test")

LabelSet = Literal["complemented", "original"]
LABEL_FOLDERS: dict[LabelSet, str] = {"complemented": "label_world", "original": "label_world_backup"}

CLASS_NAMES = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Bus",
    "motorcycle": "Motorcyclist",
    "bicycle": "Cyclist",
    "pedestrian": "Pedestrian",
}
"""DAIR-V2X's classes by ours."""
_ROUNDED = 0.05
"""Tolerance of the entries of a rotation in a file."""
_CLASSES = {theirs.lower(): ours for ours, theirs in CLASS_NAMES.items()} | {
    "trunk": "truck",  # as one of the dataset's own documents spells it
    "tricyclist": "motorcycle",
    "barrowlist": "pedestrian",
}
_NO_ACTORS = {"trafficcone"}


class Offset(msgspec.Struct, frozen=True):
    """Offset between the two sides' calibrations, m, found by hand."""

    delta_x: float = 0.0
    delta_y: float = 0.0


class Pair(msgspec.Struct, frozen=True):
    """Entry of `cooperative/data_info.json`; the offset is "" for an unknown one."""

    vehicle_pointcloud_path: str
    infrastructure_pointcloud_path: str
    cooperative_label_path: str = ""
    system_error_offset: Offset | str | None = None

    @property
    def stems(self) -> tuple[str, str]:
        """Ids of the vehicle's and of the infrastructure's frame."""
        return PurePosixPath(self.vehicle_pointcloud_path).stem, PurePosixPath(self.infrastructure_pointcloud_path).stem

    @property
    def offset(self) -> NDArray[np.float64]:
        """(2,) correction of the infrastructure's position, m."""
        found = self.system_error_offset
        return np.array([found.delta_x, found.delta_y]) if isinstance(found, Offset) else np.zeros(2)


class SideInfo(msgspec.Struct, frozen=True):
    """Entry of a side's `data_info.json`."""

    pointcloud_path: str
    pointcloud_timestamp: int = 0
    batch_id: str | int = "0"
    calib_lidar_to_novatel_path: str = ""
    calib_novatel_to_world_path: str = ""
    calib_virtuallidar_to_world_path: str = ""


class Transform(msgspec.Struct, frozen=True):
    """Rotation and translation, in `lidar_to_novatel` inside a table `transform`."""

    rotation: list[list[float]] = []
    translation: list[list[float] | float] = []
    transform: "Transform | None" = None


class Label(msgspec.Struct, frozen=True):
    """Entry of a cooperative label; only the corners give the box."""

    type: str
    world_8_points: list[list[float]]
    track_id: str | int = ""


class SideLabel(msgspec.Struct, frozen=True):
    """Entry of a label of one side, in a tree of ours: an object that this side has points on, and their number."""

    track_id: int
    points_on: Annotated[int, Meta(ge=1, lt=1 << 31)] = 1


class SideRecord(msgspec.Struct, frozen=True):
    """Agent on one side of a batch, in a tree of ours."""

    agent_id: int
    kind: AgentKind
    motion: Motion = "middle"
    lidar: LidarSpec | None = None
    lidar_from_body: list[list[float]] | None = None


class BatchRecord(msgspec.Struct, frozen=True):
    """Batch in a tree of ours."""

    drive: str
    vehicle: SideRecord
    infrastructure: SideRecord


class Sidecar(msgspec.Struct, frozen=True):
    """Content of `testbed.json`: values that DAIR-V2X lacks."""

    version: int
    batches: dict[str, BatchRecord] = {}


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Indices of a tree.

    Attributes:
        root: the folder `cooperative-vehicle-infrastructure`.
        batches: pairs by batch, in the order of the vehicle's frames.
        vehicle: index of the vehicle's side by frame id.
        infrastructure: index of the other side.
        splits: ids of the vehicle's frames by the name of their split.
        sidecar: our own record, None in other trees.
    """

    root: Path
    batches: dict[str, tuple[Pair, ...]]
    vehicle: dict[str, SideInfo]
    infrastructure: dict[str, SideInfo]
    splits: dict[str, frozenset[str]]
    sidecar: Sidecar | None

    def start_us(self, batch: str) -> int:
        """Return the time of a batch's first pair, microseconds."""
        return self.vehicle[self.batches[batch][0].stems[0]].pointcloud_timestamp


def is_tree(folder: Path) -> bool:
    """Return whether a folder is a DAIR-V2X-C tree."""
    return (folder / PAIRS).is_file()


def open_tree(root: Path) -> Tree:
    """Read the indices of a tree; kept until one of them changes.

    Raises:
        DataError: an index is missing or wrong, or no pair is complete.
    """
    names = (PAIRS, *(f"{side}/data_info.json" for side in SIDES), SIDECAR, SPLIT, *(f"{n}.json" for n in _SPLITS))
    stamps = tuple((root / name).stat().st_mtime_ns if (root / name).exists() else 0 for name in names)
    return _open_tree(root, stamps)


@lru_cache(maxsize=4)
def _open_tree(root: Path, stamps: tuple[int, ...]) -> Tree:
    pairs = read_json(root / PAIRS, list[Pair])
    listed = (read_json(root / side / "data_info.json", list[SideInfo]) for side in SIDES)
    vehicle, infrastructure = ({PurePosixPath(info.pointcloud_path).stem: info for info in side} for side in listed)
    sidecar = read_json(root / SIDECAR, Sidecar) if (root / SIDECAR).exists() else None
    clouds = {side: _clouds(root, side) for side in SIDES}
    labels = {path.name for path in (root / "cooperative" / LABEL_FOLDERS["complemented"]).glob("*.json")}
    batches: dict[str, list[Pair]] = {}
    left_out = 0
    for row, pair in enumerate(pairs):
        first, second = pair.stems
        if len(first) >= 20 or not first.isdecimal():
            raise DataError(complaint(root / PAIRS, f"[{row}].vehicle_pointcloud_path", "a number as name", first))
        # The published list has pairs of frames that were held back for testing or lie at the edge of a batch.
        known = first in vehicle and second in infrastructure
        there = first in clouds["vehicle-side"] and second in clouds["infrastructure-side"]
        if not (known and there and f"{first}.json" in labels):
            left_out += 1
            continue
        batches.setdefault(str(vehicle[first].batch_id), []).append(pair)
    if not batches:
        raise DataError(
            complaint(root, "pairs", "at least one whose clouds, label and entries are there", f"{left_out} without")
        )
    if left_out:
        _log.warning(
            "%s: %d of %d pairs are left out: a cloud, the label or an entry is missing", root, left_out, len(pairs)
        )
    ordered = {name: tuple(sorted(found, key=lambda pair: pair.stems[0])) for name, found in batches.items()}
    return Tree(root, dict(sorted(ordered.items(), key=_by_number)), vehicle, infrastructure, _splits(root), sidecar)


class _SplitFile(msgspec.Struct, frozen=True):
    cooperative_split: dict[str, list[str]]


def _splits(root: Path) -> dict[str, frozenset[str]]:
    """Return the frames of each split: of the files named after them, else of the dataset's split file."""
    shared = read_json(root / SPLIT, _SplitFile).cooperative_split if (root / SPLIT).exists() else {}
    own = {name: read_json(root / f"{name}.json", list[str]) for name in _SPLITS if (root / f"{name}.json").exists()}
    return {name: frozenset(frames) for name, frames in {**shared, **own}.items()}


def _by_number(item: tuple[str, object]) -> tuple[int, str]:
    short = len(item[0]) < 20 and item[0].isdecimal()
    return (int(item[0]) if short else 2**31, item[0])


def _clouds(root: Path, side: str) -> set[str]:
    """Return the ids of the existing clouds; one listing is quicker than a look-up of each file."""
    return {path.stem for folder in _cloud_folders(root, side) if folder.is_dir() for path in folder.glob("*.pcd")}


def _cloud_folders(root: Path, side: str) -> Iterator[Path]:
    yield root / side / "velodyne"
    yield from (root.parent / f"{name}-{side}-velodyne" for name in dict.fromkeys((root.name, TREE)))


def cloud_file(root: Path, side: str, stem: str) -> Path:
    """Return the file of a cloud, in the tree or beside it."""
    files = [folder / f"{stem}.pcd" for folder in _cloud_folders(root, side)]
    return next((file for file in files if file.exists()), files[0])


def calib_file(root: Path, side: str, info: SideInfo, name: str) -> Path:
    """Return a calibration file by the index, else its usual path.

    Raises:
        DataError: the index points out of the tree.
    """
    stem = PurePosixPath(info.pointcloud_path).stem
    relative = PurePosixPath(getattr(info, f"calib_{name}_path") or f"calib/{name}/{stem}.json")
    if relative.is_absolute() or ".." in relative.parts:
        raise DataError(
            complaint(root / side / "data_info.json", f"calib_{name}_path", "a path in the tree", str(relative))
        )
    return root / side / relative


def read_transform(path: Path) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a calibration file, its rounded rotation made exact.

    Raises:
        DataError: the file has no rotation and translation.
    """
    found = read_json(path, Transform)
    found = found.transform or found
    try:
        rotation = np.array(found.rotation, np.float64).reshape(3, 3)
        translation = np.array(found.translation, np.float64).reshape(3)
    except ValueError:
        raise DataError(complaint(path, "rotation, translation", "3 x 3 and 3 numbers", "others")) from None
    matrix = np.eye(4)
    if max(np.abs(rotation).max(), np.abs(translation).max()) > 1e9:
        raise DataError(complaint(path, "pose", "numbers up to 1e9", "larger ones"))
    matrix[:3, :3], matrix[:3, 3] = nearest_rotation(rotation), translation
    if not np.allclose(matrix[:3, :3], rotation, atol=_ROUNDED):
        raise DataError(complaint(path, "rotation", "a rotation matrix", np.round(rotation, 3).tolist()))
    return matrix


def read_labels(path: Path) -> tuple[Boxes, list[str], list[str]]:
    """Return the boxes of a cooperative label without ids, their class names and their tracks ("" without one).

    Raises:
        DataError: the file is missing, or an object has an unknown class or no eight corners.
    """
    labels = [label for label in read_json(path, list[Label]) if label.type.lower() not in _NO_ACTORS]
    for row, label in enumerate(labels):
        if label.type.lower() not in _CLASSES:
            raise DataError(complaint(path, f"[{row}].type", f"one of {', '.join(CLASS_NAMES.values())}", label.type))
        if len(label.world_8_points) != 8 or any(len(point) != 3 for point in label.world_8_points):
            raise DataError(complaint(path, f"[{row}].world_8_points", "8 points of 3 numbers", label.world_8_points))
    corners = np.array([label.world_8_points for label in labels], np.float64).reshape(-1, 8, 3)
    boxes = boxes_of(corners)
    flat = np.flatnonzero(~(boxes.size > 0.0).all(axis=1))
    if len(flat):
        raise DataError(complaint(path, f"[{flat[0]}].world_8_points", "corners of a box", corners[flat[0]].tolist()))
    return boxes, [_CLASSES[label.type.lower()] for label in labels], [str(label.track_id) for label in labels]


def boxes_of(corners: NDArray[np.float64]) -> Boxes:
    """Return upright boxes of (N, 8, 3) corners in DAIR-V2X's order: around the bottom, the front first, then on top.

    Left and right may be swapped: the tools of the dataset and of the complemented labels differ there.
    """
    front, rear = corners[:, [0, 1, 4, 5]].mean(axis=1), corners[:, [2, 3, 6, 7]].mean(axis=1)
    along = front - rear
    across = corners[:, [0, 3, 4, 7]].mean(axis=1) - corners[:, [1, 2, 5, 6]].mean(axis=1)
    up = corners[:, 4:].mean(axis=1) - corners[:, :4].mean(axis=1)
    size = np.stack([np.hypot(*along[:, :2].T), np.hypot(*across[:, :2].T), np.abs(up[:, 2])], axis=1)
    yaw = wrap_angle(np.arctan2(along[:, 1], along[:, 0]))
    n = len(corners)
    return Boxes(corners.mean(axis=1), size, np.atleast_1d(yaw), np.zeros(n, np.int64), np.full(n, -1, np.int64))
