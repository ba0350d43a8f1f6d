"""KITTI's object benchmark: frames without order, labels in the picture of camera 2.

    TREE/training/{velodyne/N.bin, label_2/N.txt, calib/N.txt, image_2/N.png}
    TREE/testing/{velodyne, calib, image_2}

A drive is `training` or `testing`. The world of a frame is its own, with the ground below the car at 0; in trees of
`dsrc dataset convert` it is the drive's. Objects are judged where the picture shows their centre and no `DontCare`
does; trams, what is `Misc` and people who sit are neither found nor missed. Without a picture its size is KITTI's.

Source: the development kit of the KITTI object benchmark (readme.txt); A. Geiger et al., CVPR 2012: the Velodyne
HDL-64E stands 1.73 m above the ground.
"""

from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti import HEIGHT, WIDTH
from dsrc.data.formats.kitti_labels import KittiCalibration, parse_labels, read_calibration, regions_of
from dsrc.data.jsonio import read_json
from dsrc.data.sweeps.layout import (
    Labels,
    Layout,
    finite,
    numbered,
    png_size,
    read_floats,
    unit_intensity,
)
from sensors.frame import Region
from sensors.sweep import Sweep, make_sweep
from sim.boxes import CLASSES, Boxes, concatenate
from sim.errors import notice, one_line
from sim.reading import read_text

HEIGHT_M = 1.73
"""Of KITTI's LiDAR above the ground, m."""
USERS = {
    "car": "car",
    "van": "van",
    "truck": "truck",
    "bus": "bus",
    "motorcycle": "motorcycle",
    "cyclist": "bicycle",
    "pedestrian": "pedestrian",
}
"""Our classes by KITTI's in lower case; it has neither buses nor motorcycles, but others' files in its format do."""
SPARED = {"tram": "truck", "misc": "car", "person_sitting": "pedestrian"}
"""Objects that are neither found nor missed."""
_TYPES = {*USERS, *SPARED, "dontcare"}
_SPLITS = ("training", "testing")
_OWN = "conversion.json"
_BUS_M = 4.0
"""Length between the motorcycles and the buses that are both `Misc` in our trees."""


def scan_sweep(path: Path, world_from_lidar: NDArray[np.float64], time_s: float) -> Sweep:
    """Return the sweep of KITTI's `.bin`: x, y, z, intensity from 0 to 1."""
    rows = read_floats(path, 4, "Velodyne scan")
    finite(path, rows)
    return make_sweep(rows[:, :3], world_from_lidar, time_s, intensity=unit_intensity(path, rows[:, 3], 1.0))


def kitti_truth(
    path: Path, lines: list[tuple[int, str]], calibration: KittiCalibration, own: bool = False
) -> tuple[Boxes, Boxes]:
    """Return the objects of label lines and those to ignore, in the LiDAR's frame, with the numbers of lines as ids.

    Args:
        own: of a tree of ours, where `Misc` are buses and motorcycles.
    """
    camera = calibration.camera_from_lidar
    types = {line.split(maxsplit=1)[0] for _, line in lines if line.strip()}
    for name in sorted(name for name in types if name.lower() not in _TYPES):
        notice(f"{path.parent}: objects of type {one_line(name, 40)}, which KITTI does not have, are left out")
    found = []
    for users in (USERS, SPARED):
        boxes = parse_labels(path, lines, camera, users=users).boxes
        kept = [number for number, line in lines if line.split(maxsplit=1)[:1] and line.split()[0].lower() in users]
        found.append(replace(boxes, object_id=np.array(kept, np.int64)))
    boxes, spared = found
    if not own:
        return boxes, spared
    rest = spared[spared.label == CLASSES.index("car")]
    label = np.where(rest.size[:, 0] > _BUS_M, CLASSES.index("bus"), CLASSES.index("motorcycle"))
    return concatenate([boxes, replace(rest, label=label)]), Boxes.zeros()


def calibration_beside(path: Path) -> KittiCalibration:
    """Return the calibration of a label file; without one that of the nominal camera, with a notice."""
    beside = path.parent.parent / "calib" / path.name
    if not beside.is_file():
        notice(f"{beside.parent}: a calibration is missing: labels are read by a nominal camera")
    return read_calibration(beside)


def picture_region(
    path: Path, lines: list[tuple[int, str]], calibration: KittiCalibration, picture: Path, spared: Boxes
) -> Region:
    """Return where labels of a picture are complete, in the LiDAR's frame."""
    size = png_size(picture) or (WIDTH, HEIGHT)
    return Region(calibration.projection @ calibration.camera_from_lidar, size, regions_of(path, lines), spared)


def labels_of_scan(
    path: Path, calibration: KittiCalibration, picture: Path, pose: NDArray[np.float64], own: bool = False
) -> Labels:
    """Return the boxes of a scan's label file, in the picture.

    Args:
        pose: (4, 4) world_from_lidar.
        own: see `kitti_truth`.
    """
    lines = list(enumerate(read_text(path, "label file").splitlines(), 1))
    boxes, spared = kitti_truth(path, lines, calibration, own)
    boxes = replace(boxes, object_id=np.arange(1, len(boxes) + 1))
    region = picture_region(path, lines, calibration, picture, spared).transform(pose)
    return Labels(boxes.transform(pose), None, region)


class KittiObject(Layout):
    """Frames of `training` or `testing`."""

    format = "KITTI object"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._scans = numbered(path / "velodyne", ".bin")
        self.frames = tuple(self._scans)
        self.height_m = (HEIGHT_M,)
        mark = path.parent / _OWN
        # Of a tree of `dsrc dataset convert`, whose labels may lie all around.
        self._own = read_json(mark, dict) if mark.is_file() else {}
        self._around = self._own.get("view") == "around"

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the splits of a tree, or the split that the folder is."""
        return [path for path in (folder, *(folder / name for name in _SPLITS)) if _is_split(path)]

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a split."""
        return cls(path) if _is_split(path) else None

    def time_s(self, i: int) -> float:
        """Return the time of a frame, s: 0.1 s a number, or that of a tree of ours."""
        time_s = self._calibration(i).time_s if self._own else None
        return super().time_s(i) if time_s is None else time_s

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of the LiDAR: above the ground, or that of a tree of ours."""
        return [self._pose(self._calibration(i))]

    def _pose(self, calibration: KittiCalibration) -> NDArray[np.float64]:
        if calibration.world_from_lidar is not None:
            return calibration.world_from_lidar
        pose = np.eye(4)
        pose[2, 3] = HEIGHT_M
        return pose

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of a frame."""
        return [scan_sweep(self._scans[self.frames[i]], self.poses(i)[0], self.time_s(i))]

    def labelled(self, i: int) -> bool:
        """Return whether the frame has a label file."""
        return self._file("label_2", i, "txt").is_file()

    def labels(self, i: int) -> Labels | None:
        """Return the boxes in the picture, or all around in trees of ours."""
        if not self.labelled(i):
            return None
        path, picture = self._file("label_2", i, "txt"), self._file("image_2", i, "png")
        calibration = calibration_beside(path)
        found = labels_of_scan(path, calibration, picture, self._pose(calibration), bool(self._own))
        return replace(found, region=None) if self._around else found

    def files(self, i: int) -> list[Path]:
        """Return scan, labels and calibration."""
        named = (("label_2", "txt"), ("calib", "txt"))
        return [self._scans[self.frames[i]], *(self._file(name, i, ending) for name, ending in named)]

    def _file(self, folder: str, i: int, ending: str) -> Path:
        return self.path / folder / f"{self._scans[self.frames[i]].stem}.{ending}"

    def _calibration(self, i: int) -> KittiCalibration:
        return read_calibration(self._file("calib", i, "txt"))


def _is_split(path: Path) -> bool:
    """Return whether a folder has scans, and calibrations or labels beside them as KITTI's object tree."""
    beside = (path / "calib").is_dir() or (path / "label_2").is_dir()
    return beside and (path / "velodyne").is_dir() and any((path / "velodyne").glob("*.bin"))
