"""Argoverse 2 sensor data set: a log is a drive, its two stacked LiDARs one sensor.

    LOG/sensors/lidar/TIMESTAMP_NS.feather      x, y, z in the car's frame, intensity (0 to 255), laser_number (0 to 63)
    LOG/city_SE3_egovehicle.feather             pose of the car at each timestamp: qw, qx, qy, qz, tx_m, ty_m, tz_m
    LOG/calibration/egovehicle_SE3_sensor.feather   pose of each sensor on the car: sensor_name, the same columns
    LOG/annotations.feather                     boxes in the car's frame; not in the test split

The sweep is in the frame of the upper LiDAR; points are compensated to the timestamp. The car's origin is the middle of
its rear axle, about 0.33 m above the ground. Lasers are numbered as they fire, one LiDAR after the other; rings go from
the top, by the elevations of the first sweep; logs without that column have none. Bicycles and motorcycles in use are
labelled apart from their riders.

Needs the package `pyarrow`. Source: B. Wilson et al., NeurIPS 2021; the user guide of the API `av2` (sensor dataset).
"""

from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sweeps.layout import IGNORED, BoxRows, Labels, Layout, eight_bit_intensity, finite, poses_of
from sensors.frame import Region
from sensors.sweep import Sweep, make_sweep
from sim.errors import DataError, SettingsError, complaint
from sim.geometry import invert, transform_points
from sim.reading import parsing, read_bytes

AXLE_M = 0.33
"""Height of the car's origin above the ground, m: the radius of its wheels."""
CLASSES = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "MOTORCYCLE": "motorcycle",
    "BICYCLE": "bicycle",
    "PEDESTRIAN": "pedestrian",
    "OFFICIAL_SIGNALER": "pedestrian",
    "VEHICULAR_TRAILER": IGNORED,
    "RAILED_VEHICLE": IGNORED,
    "MESSAGE_BOARD_TRAILER": IGNORED,
    "TRAFFIC_LIGHT_TRAILER": IGNORED,
    "BICYCLIST": IGNORED,
    "MOTORCYCLIST": IGNORED,
    "WHEELED_RIDER": IGNORED,
    "WHEELED_DEVICE": IGNORED,
    "STROLLER": IGNORED,
    "WHEELCHAIR": IGNORED,
}
_POSES, _CALIBRATION, _BOXES = "city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather", "annotations"
_LIDARS = Path("sensors") / "lidar"
_LASERS = 64
_SENSOR = "up_lidar"


class Argoverse(Layout):
    """Sweeps of a log."""

    format = "Argoverse 2"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        files = [file for file in sorted((path / _LIDARS).glob("*.feather")) if file.stem.isdecimal()]
        self._scans = sorted(files, key=lambda file: int(file.stem))
        self._stamps = [int(file.stem) for file in self._scans]
        self.frames = tuple(range(len(self._scans)))
        self.tracked = True
        table = _columns(path / _CALIBRATION, ("sensor_name", *_POSE))
        names = [str(name) for name in table["sensor_name"]]
        if _SENSOR not in names:
            raise DataError(complaint(path / _CALIBRATION, "sensor_name", _SENSOR, ", ".join(names[:8])))
        row = names.index(_SENSOR)
        self._body_from_lidar = _pose_rows(path / _CALIBRATION, table)[row]
        self.height_m = (float(self._body_from_lidar[2, 3]) + AXLE_M,)
        self._cars = lru_cache(maxsize=1)(self._read_cars)
        self._objects = lru_cache(maxsize=1)(self._read_objects)
        self._rings = lru_cache(maxsize=1)(self._read_rings)

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the folder itself where it is a log."""
        return [folder] if (folder / _POSES).is_file() and (folder / _LIDARS).is_dir() else []

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a log."""
        return cls(path) if cls.below(path) else None

    def time_s(self, i: int) -> float:
        """Return the time since the first sweep, s."""
        return (self._stamps[i] - self._stamps[0]) * 1e-9

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of the upper LiDAR in the city."""
        car = self._cars().get(self._stamps[i])
        if car is None:
            raise DataError(complaint(self.path / _POSES, "timestamp_ns", f"one of {self._stamps[i]}", "none"))
        return [car @ self._body_from_lidar]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of both LiDARs in the frame of the upper one."""
        placed, intensity, laser = self._read_scan(self._scans[i])
        ring = np.zeros(len(placed), np.int16) if laser is None else self._rings()[laser]
        return [make_sweep(placed, self.poses(i)[0], self.time_s(i), intensity=intensity, ring=ring)]

    def labelled(self, i: int) -> bool:
        """Return whether the log has annotations."""
        return self._file.is_file()

    def labels(self, i: int) -> Labels | None:
        """Return the boxes of a sweep."""
        if not self.labelled(i):
            return None
        stamps, names, ids, rows = self._objects()
        found = BoxRows(CLASSES)
        for row in np.flatnonzero(stamps == self._stamps[i]):
            found.add(names[row], rows[row].tolist(), int(ids[row]))
        boxes, ignored = found.boxes(self._file, "boxes")
        car = self.poses(i)[0] @ invert(self._body_from_lidar)
        return Labels(boxes.transform(car), None, Region(ignored=ignored).transform(car))

    def files(self, i: int) -> list[Path]:
        """Return the sweep and the tables of the log."""
        return [self._scans[i], self.path / _POSES, self.path / _CALIBRATION, self._file]

    @property
    def _file(self) -> Path:
        return self.path / f"{_BOXES}.feather"

    def _read_scan(self, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int64] | None]:
        """Return (P, 3) points in the frame of the upper LiDAR, their intensities and lasers (None: no column)."""
        table = _columns(path, ("x", "y", "z", "intensity"), ("laser_number",))
        points = finite(path, np.column_stack([table[name].astype(np.float32) for name in "xyz"]))
        placed = np.asarray(transform_points(invert(self._body_from_lidar), points.astype(np.float64)))
        intensity = np.asarray(eight_bit_intensity(path, table["intensity"].astype(np.float32)))
        laser = table.get("laser_number")
        if laser is None:
            return placed, intensity, None
        if not ((laser >= 0) & (laser < _LASERS) & (laser == np.floor(laser))).all():
            raise DataError(complaint(path, "laser_number", f"whole numbers from 0 to {_LASERS - 1}", "others"))
        return placed, intensity, laser.astype(np.int64)

    def _read_rings(self) -> NDArray[np.int16]:
        """Return the (64,) ring of each laser; those without a point in the first sweep that is whole are the last."""
        for path in self._scans:
            with suppress(DataError):
                points, _, laser = self._read_scan(path)
                if laser is not None:
                    break
        else:
            raise DataError(complaint(self.path / _LIDARS, "laser_number", "a sweep that has it", "none"))
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        count = np.bincount(laser, minlength=_LASERS)
        mean = np.bincount(laser, elevation, _LASERS) / np.maximum(count, 1)
        order = np.argsort(np.where(count > 0, -mean, np.inf), kind="stable")
        return np.argsort(order).astype(np.int16)

    def _read_cars(self) -> dict[int, NDArray[np.float64]]:
        path = self.path / _POSES
        table = _columns(path, ("timestamp_ns", *_POSE))
        return dict(zip(table["timestamp_ns"].astype(np.int64).tolist(), _pose_rows(path, table), strict=True))

    def _read_objects(self) -> tuple[NDArray[np.int64], list[str], NDArray[np.int64], NDArray[np.float64]]:
        """Return of all boxes the times, classes, ids and (M, 7) rows in the car's frame."""
        sizes = ("length_m", "width_m", "height_m")
        table = _columns(self._file, ("timestamp_ns", "track_uuid", "category", *sizes, *_POSE))
        poses = _pose_rows(self._file, table)
        yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
        size = np.column_stack([table[name].astype(np.float64) for name in sizes])
        # A track's id is its place among the log's tracks by name, from 1 on.
        _, ids = np.unique(np.array([str(one) for one in table["track_uuid"]]), return_inverse=True)
        rows = np.column_stack([poses[:, :3, 3], size, yaw])
        names = [str(one) for one in table["category"]]
        return table["timestamp_ns"].astype(np.int64), names, np.asarray(ids, np.int64) + 1, rows


_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def _pose_rows(path: Path, table: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    values = np.column_stack([table[name].astype(np.float64) for name in _POSE])
    return poses_of(path, values[:, :4], values[:, 4:])


def _columns(path: Path, names: tuple[str, ...], more: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Return columns of a feather file, and of more those that it has; DataError where it is damaged or lacks one."""
    try:
        from pyarrow import BufferReader, feather
    except ImportError:
        raise SettingsError(
            f"{path}: expected the package pyarrow, found none; pip install 'dsrc-testbed[argoverse]'"
        ) from None
    content = read_bytes(path, "feather file")
    with parsing(path, "feather file"):
        table = feather.read_table(BufferReader(content))
        table.validate(full=True)  # arrow trusts offsets, and would read beyond its buffers
        missing = [name for name in names if name not in table.column_names]
        if missing:
            raise DataError(complaint(path, "columns", missing[0], ", ".join(table.column_names[:12])))
        found = {name: table.column(name).to_numpy() for name in [*names, *set(more).intersection(table.column_names)]}
        for name, column in found.items():
            if name not in _TEXTS and column.dtype.kind not in "fiu":
                raise DataError(complaint(path, name, "numbers", str(column.dtype)))
        return found


_TEXTS = ("sensor_name", "track_uuid", "category")
