"""KITTI's sequences: the tracking benchmark, and SemanticKITTI with the odometry benchmark's layout.

    TREE/training/velodyne/0000/N.bin, label_02/0000.txt, calib/0000.txt, oxts/0000.txt     tracking
    TREE/training/0000              the path of a drive, which need not exist
    TREE/sequences/00/{velodyne/N.bin, poses.txt, times.txt, calib.txt}                     SemanticKITTI

Tracking: a label is that of the object benchmark after the numbers of its frame and track; the world is level, with the
first frame's GPS at its origin, x east and y north. SemanticKITTI has no boxes; its poses are of the left camera, in
the frame of the first one, and become those of the LiDAR in the frame of the first sweep.

Sources: the development kits of KITTI's tracking and raw data (oxts: latitude, longitude, altitude, roll, pitch, yaw;
Mercator's projection scaled at the first latitude); A. Geiger et al., IJRR 2013; J. Behley et al., ICCV 2019, README of
semantic-kitti-api.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti_labels import KittiCalibration, read_calibration
from dsrc.data.sweeps.kitti import HEIGHT_M, kitti_truth, picture_region, scan_sweep
from dsrc.data.sweeps.layout import Labels, Layout, numbered
from sensors.sweep import Sweep
from sim.errors import DataError, complaint
from sim.geometry import invert, pose_matrix
from sim.reading import parsing, read_text

_EARTH_M = 6378137.0
_SPLITS = ("training", "testing")
_TRACK_LIMIT = 1 << 30


class KittiTracking(Layout):
    """Sequence of the tracking benchmark."""

    format = "KITTI tracking"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._split, self._name = path.parent, path.name
        self._scans = numbered(self._split / "velodyne" / self._name, ".bin")
        self.frames = tuple(self._scans)
        self.height_m = (HEIGHT_M,)
        self._labels, self._oxts = (self._split / part / f"{self._name}.txt" for part in ("label_02", "oxts"))
        self.tracked = True
        self._lines = lru_cache(maxsize=1)(self._read_lines)
        self._places = lru_cache(maxsize=1)(self._read_places)
        self._calibration = lru_cache(maxsize=1)(self._read_calibration)

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the sequences of a tree, of a split, or the path itself."""
        if cls._is_sequence(folder):
            return [folder]
        splits = [folder, *(folder / name for name in _SPLITS)]
        found = [path for split in splits for path in sorted((split / "velodyne").glob("*/"))]
        return [path.parents[1] / path.name for path in found if cls._is_sequence(path.parents[1] / path.name)]

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a sequence."""
        return cls(path) if cls._is_sequence(path) else None

    @staticmethod
    def _is_sequence(path: Path) -> bool:
        calibrated = (path.parent / "calib" / f"{path.name}.txt").is_file()
        return calibrated and (path.parent / "velodyne" / path.name).is_dir()

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of the LiDAR by GPS and inertial unit; above the origin without these."""
        places = self._places()
        if places is None:
            return [pose_matrix([0.0, 0.0, HEIGHT_M])]
        if self.frames[i] >= len(places):
            raise DataError(complaint(self._oxts, "lines", f"one of frame {self.frames[i]}", f"{len(places)} lines"))
        calibration = self._calibration()
        imu = calibration.camera_from_imu
        lidar = np.eye(4) if imu is None else invert(imu) @ calibration.camera_from_lidar
        return [places[self.frames[i]] @ lidar]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of a frame."""
        return [scan_sweep(self._scans[self.frames[i]], self.poses(i)[0], self.time_s(i))]

    def labelled(self, i: int) -> bool:
        """Return whether the sequence has labels."""
        return self._labels.is_file()

    def labels(self, i: int) -> Labels | None:
        """Return the tracked objects in the picture of a frame."""
        if not self.labelled(i):
            return None
        calibration, ids = self._calibration(), {}
        rows: list[tuple[int, str]] = []
        for number, line in self._lines().get(self.frames[i], ()):
            words = line.split(maxsplit=2)
            ids[number] = int(words[1]) + 1
            rows.append((number, words[2]))
        truth, spared = kitti_truth(self._labels, rows, calibration)
        truth = replace(truth, object_id=np.array([ids[line] for line in truth.object_id.tolist()], np.int64))
        if len(np.unique(truth.object_id)) < len(truth):
            raise DataError(complaint(self._labels, f"frame {self.frames[i]}", "each track once", "one twice"))
        picture = self._split / "image_02" / self._name / f"{self.frames[i]:06d}.png"
        pose = self.poses(i)[0]
        region = picture_region(self._labels, rows, calibration, picture, spared).transform(pose)
        return Labels(truth.transform(pose), None, region)

    def files(self, i: int) -> list[Path]:
        """Return the scan and the files of the sequence."""
        calibration = self._split / "calib" / f"{self._name}.txt"
        return [self._scans[self.frames[i]], self._labels, self._oxts, calibration]

    def _read_calibration(self) -> KittiCalibration:
        return read_calibration(self._split / "calib" / f"{self._name}.txt")

    def _read_lines(self) -> dict[int, list[tuple[int, str]]]:
        """Return the label lines of each frame, with their numbers."""
        found: dict[int, list[tuple[int, str]]] = {}
        for number, line in enumerate(read_text(self._labels, "label file").splitlines(), 1):
            words = line.split(maxsplit=2)
            if not words:
                continue
            whole = len(words) == 3 and all(word.removeprefix("-").isdecimal() for word in words[:2])
            if not whole or abs(int(words[0])) >= _TRACK_LIMIT or abs(int(words[1])) >= _TRACK_LIMIT:
                raise DataError(complaint(self._labels, f"line {number}", "frame, track and a label", line))
            found.setdefault(int(words[0]), []).append((number, line))
        return found

    def _read_places(self) -> NDArray[np.float64] | None:
        """Return the (N, 4, 4) poses of the inertial unit, None without its file."""
        if not self._oxts.is_file():
            return None
        rows = _rows(self._oxts, 6, "GPS and inertial unit")
        scale = np.cos(np.radians(rows[0, 0]))
        east = scale * _EARTH_M * np.radians(rows[:, 1])
        north = scale * _EARTH_M * np.log(np.tan(np.pi / 4 + np.radians(rows[:, 0]) / 2))
        place = np.column_stack([east, north, rows[:, 2]])
        if not np.isfinite(place).all():
            raise DataError(complaint(self._oxts, "latitude", "degrees within -90 and 90", "others"))
        place += [0.0, 0.0, _IMU_M] - place[0]
        roll, pitch, yaw = rows[:, 3:6].T
        return pose_matrix(place, yaw, pitch, roll)


_IMU_M = 0.93
"""Height of the inertial unit above the ground, m."""


class SemanticKitti(Layout):
    """Sequence of SemanticKITTI or of KITTI's odometry; without boxes."""

    format = "SemanticKITTI"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._scans = numbered(path / "velodyne", ".bin")
        self.frames = tuple(self._scans)
        self.height_m = (HEIGHT_M,)
        self.tracked = self._file("poses").is_file()
        self._tables = lru_cache(maxsize=1)(self._read_tables)

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the sequences of a tree, or the folder itself."""
        folders = [folder, *sorted((folder / "sequences").glob("*/"))]
        return [path for path in folders if (path / "calib.txt").is_file() and (path / "velodyne").is_dir()]

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a sequence."""
        return cls(path) if path in cls.below(path) else None

    def time_s(self, i: int) -> float:
        """Return the time by `times.txt`, 0.1 s a frame without it."""
        times, _ = self._tables()
        return super().time_s(i) if times is None else float(times[self._row(i, len(times), "times")])

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of the LiDAR; above the origin without `poses.txt`."""
        _, poses = self._tables()
        start = pose_matrix([0.0, 0.0, HEIGHT_M])
        return [start if poses is None else start @ poses[self._row(i, len(poses), "poses")]]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of a frame."""
        return [scan_sweep(self._scans[self.frames[i]], self.poses(i)[0], self.time_s(i))]

    def files(self, i: int) -> list[Path]:
        """Return the scan and the files of the sequence."""
        return [self._scans[self.frames[i]], *(self._file(name) for name in ("poses", "times", "calib"))]

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.txt"

    def _row(self, i: int, rows: int, name: str) -> int:
        if self.frames[i] >= rows:
            raise DataError(complaint(self._file(name), "lines", f"one of frame {self.frames[i]}", f"{rows} lines"))
        return self.frames[i]

    def _read_tables(self) -> tuple[NDArray[np.float64] | None, list[NDArray[np.float64]] | None]:
        times = _rows(self._file("times"), 1, "times")[:, 0] if self._file("times").is_file() else None
        if not self.tracked:
            return times, None
        path = self._file("calib")
        with parsing(path, "calibration"):
            lines = (line.partition(":") for line in read_text(path, "calibration").splitlines() if line.strip())
            rows = {name.strip(): np.array(values.split(), np.float64) for name, _, values in lines}
            camera_from_lidar = np.vstack([rows["Tr"].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
            lidar_from_camera = np.linalg.inv(camera_from_lidar)
        table = _rows(self._file("poses"), 12, "poses")
        first = np.vstack([table[0].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        from_first = np.linalg.inv(first)
        poses = [
            lidar_from_camera @ from_first @ np.vstack([row.reshape(3, 4), [0, 0, 0, 1]]) @ camera_from_lidar
            for row in table
        ]
        return times, poses


def _rows(path: Path, width: int, what: str) -> NDArray[np.float64]:
    """Return (N, at least width) finite numbers of a text, a line each; DataError for anything else."""
    with parsing(path, what):
        rows = [np.array(line.split(), np.float64) for line in read_text(path, what).splitlines() if line.strip()]
        if not rows or min(map(len, rows)) < width:
            raise DataError(complaint(path, "lines", f"{width} numbers in each", "fewer"))
        table = np.stack([row[:width] for row in rows])
        if not np.isfinite(table).all() or (np.abs(table) > 1e12).any():
            raise DataError(complaint(path, "lines", "finite numbers", "others"))
        return table
