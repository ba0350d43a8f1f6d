"""Folder of scans: `.bin`, `.pcd`, `.ply` or `.npy` files of one sensor, one file for a frame; or a single such file.

Boxes are optional: `boxes.json` in the folder or beside it, of the form that `dsrc score` reads,

    {"frames": [{"frame": 7, "boxes": [[x, y, z, l, w, h, yaw]], "classes": ["car"], "ids": [3]}]}

with boxes in the sensor's frame, m and rad, classes of `sim.boxes.CLASSES` (all cars without) and ids that are one
object's in all frames; a frame that it does not list is not labelled. Or KITTI's text, `label_2/NAME.txt` beside the
folder, with its `calib`.

What files do not say may stand in `scans.toml` in the folder: `columns`, `intensity_scale` and `sensor` as the options
of `dsrc corrupt`, and `height`, of the sensor above the ground, m. Without a scale of the intensities it is found in 64
scans spread over the folder.

A frame's number is that at the end of its file's name, 0.1 s apart, where these differ; else files are counted in the
order of all numbers in their names. 16 digits are microseconds, 19 nanoseconds and `1700000000.850000000` the seconds
of ROS; of these two the frame's number is the time in microseconds.
"""

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.columns import parse_columns
from dsrc.data.clouds.files import ending_of, is_scan, read_scan, scale_of
from dsrc.data.clouds.intensity import Scale, parse_scale
from dsrc.data.jsonio import read_json
from dsrc.data.sweeps.kitti import calibration_beside, labels_of_scan
from dsrc.data.sweeps.layout import BoxRows, Labels, Layout
from sensors.presets import get_lidar
from sensors.sweep import STATIC, Sweep
from sim.boxes import CLASSES, check_radians
from sim.errors import DataError, complaint
from sim.settings import read_toml

BOXES, SETTINGS = "boxes.json", "scans.toml"
_LOOKED_INTO = 64
_NUMBER = re.compile(r"(\d+)\D*$")
_SECONDS = re.compile(r"(?<!\d)([1-9]\d{9})(?:\.(\d{1,9})|_(\d{9}))$")
_MICROSECONDS, _NANOSECONDS = 16, 19


class FrameBoxes(msgspec.Struct, frozen=True):
    """True boxes of one scan in `boxes.json`; see the module."""

    frame: int
    boxes: list[tuple[float, float, float, float, float, float, float]]
    classes: list[str] | None = None
    ids: list[int] | None = None


class ScanSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of `scans.toml`; see the module."""

    columns: str | list[str] | None = None
    intensity_scale: float | str | None = None
    sensor: str | None = None
    height: float = 0.0


class BoxesFile(msgspec.Struct, frozen=True):
    """Content of `boxes.json`."""

    frames: list[FrameBoxes]


class Scans(Layout):
    """Scans of a folder."""

    format = "folder of scans"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        listed = [path] if is_scan(path) else sorted((file for file in path.iterdir() if is_scan(file)), key=_in_order)
        numbers = [_number(file) for file in listed]
        known = [number for number in numbers if number is not None]
        if len(set(known)) < len(listed):
            known = list(range(len(listed)))
        self._single = is_scan(path)
        self._scans = dict(sorted(zip(known, listed, strict=True)))
        self._folder = path.parent if is_scan(path) else path
        self.frames = tuple(self._scans)
        self._in_us = bool(self.frames) and self.frames[0] >= 10 ** (_MICROSECONDS - 1)
        places = [self._folder / BOXES, self._folder.parent / BOXES]
        self._boxes_file = next((place for place in places if place.is_file()), None)
        self._listed = lru_cache(maxsize=1)(self._read_boxes)
        place = self._folder / SETTINGS
        settings = read_toml(place, ScanSettings, DataError) if place.is_file() else ScanSettings()
        self._columns, self._sensor = parse_columns(settings.columns), settings.sensor
        self._declared = parse_scale(settings.intensity_scale)
        self._scale = lru_cache(maxsize=1)(self._find_scale)
        self.height_m = (settings.height,)

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the folder itself where scans are in it, or a file that is a scan."""
        if folder.is_file():
            return [folder] if is_scan(folder) else []
        return [folder] if folder.is_dir() and any(is_scan(path) for path in folder.iterdir()) else []

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open a folder of scans."""
        return cls(path) if cls.below(path) else None

    def time_s(self, i: int) -> float:
        """Return the time by the file's number, since the first frame where it counts microseconds, s."""
        return (self.frames[i] - self.frames[0]) * 1e-6 if self._in_us else super().time_s(i)

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of a scan."""
        return [self.sweep(self._scans[self.frames[i]], self.poses(i)[0], self.time_s(i))]

    def sweep(self, path: Path, world_from_lidar: NDArray[np.float64], time_s: float) -> Sweep:
        """Return the sweep of one of the folder's files, read as the folder's settings say.

        Args:
            world_from_lidar: (4, 4).

        Raises:
            DataError: the file is damaged or does not fit the settings.
        """
        scan = read_scan(path, self._columns, self._scale())
        sensor = self._sensor or scan.sensor
        try:
            sweep = scan.cloud.sweep(None if sensor is None else get_lidar(sensor))
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
        if not (sweep.intensity >= 0.0).all():
            bad = np.count_nonzero(~(sweep.intensity >= 0.0))
            raise DataError(complaint(path, "intensity", "numbers from 0 on", f"{bad} of {len(sweep)} that are not"))
        ids = np.full(len(sweep), STATIC, np.int32)
        intensity = np.minimum(sweep.intensity, np.float32(1.0))
        return replace(sweep, object_id=ids, time_s=time_s, world_from_lidar=world_from_lidar, intensity=intensity)

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the pose of the sensor: above the ground at the origin."""
        pose = np.eye(4)
        pose[2, 3] = self.height_m[0]
        return [pose]

    def labelled(self, i: int) -> bool:
        """Return whether `boxes.json` lists the frame, or KITTI's labels are beside it."""
        return self.frames[i] in self._listed() if self._boxes_file is not None else self._text(i).is_file()

    def labels(self, i: int) -> Labels | None:
        """Return the boxes of a scan."""
        if not self.labelled(i):
            return None
        if self._boxes_file is None:
            return self._kitti(i)
        entry, where = self._listed()[self.frames[i]], f"boxes of frame {self.frames[i]}"
        names = ["car"] * len(entry.boxes) if entry.classes is None else entry.classes
        ids = list(range(1, len(entry.boxes) + 1)) if entry.ids is None else entry.ids
        if not len(names) == len(ids) == len(entry.boxes) or len(set(ids)) < len(ids):
            raise DataError(complaint(self._boxes_file, where, "a class and an id of its own for each box", "others"))
        if odd := [name for name in names if name not in CLASSES]:
            raise DataError(complaint(self._boxes_file, where, f"classes of {', '.join(CLASSES)}", odd[0]))
        if any(not 0 <= one < 2**31 for one in ids):
            raise DataError(complaint(self._boxes_file, where, "ids from 0 to 2147483647", max(ids, key=abs)))
        check_radians(self._boxes_file, where, np.array([row[6] for row in entry.boxes], np.float64))
        rows = BoxRows(dict(zip(CLASSES, CLASSES, strict=True)))
        for name, row, one in zip(names, entry.boxes, ids, strict=True):
            rows.add(name, row, one)
        return Labels(rows.boxes(self._boxes_file, where)[0].transform(self.poses(i)[0]))

    def files(self, i: int) -> list[Path]:
        """Return the scan and the labels."""
        return [self._scans[self.frames[i]], self._boxes_file or self._text(i), self._folder / SETTINGS]

    def _kitti(self, i: int) -> Labels:
        path = self._text(i)
        calibration = calibration_beside(path)
        picture = path.parent.parent / "image_2" / f"{path.stem}.png"
        return labels_of_scan(path, calibration, picture, self.poses(i)[0])

    def _find_scale(self) -> Scale:
        """Return the scale declared, or that of scans spread over the folder."""
        if self._declared is not None:
            return self._declared
        files = list(self._scans.values())
        some = files[:: max(1, len(files) // _LOOKED_INTO)]
        return scale_of(some, self._columns, self._folder)

    def _text(self, i: int) -> Path:
        scan = self._scans[self.frames[i]]
        return self._folder.parent / "label_2" / f"{scan.name.removesuffix(ending_of(scan) or '')}.txt"

    def _read_boxes(self) -> dict[int, FrameBoxes]:
        if self._boxes_file is None:
            return {}
        found: dict[int, FrameBoxes] = {}
        for entry in read_json(self._boxes_file, BoxesFile).frames:
            if entry.frame in found:
                raise DataError(complaint(self._boxes_file, "frames", "each frame once", f"{entry.frame} twice"))
            found[entry.frame] = entry
        own = not self._single and self._boxes_file.parent == self._folder
        if found and own and not found.keys() & set(self.frames):
            expected = f"numbers of the scans, from {self.frames[0]} to {self.frames[-1]}"
            raise DataError(complaint(self._boxes_file, "frames", expected, f"{min(found)} to {max(found)}"))
        return found


def _number(path: Path) -> int | None:
    """Return the number at the end of a scan's name, of times the microseconds; None without one."""
    name = path.name.removesuffix(ending_of(path) or "")
    if found := _SECONDS.search(name):  # as ROS writes times: seconds.nanoseconds
        return int(f"{found[1]}{found[2] or found[3]:0<6.6}")
    found = _NUMBER.search(name)
    if found and len(found[1]) == _NANOSECONDS:
        return int(found[1]) // 1000
    return int(found[1]) if found and len(found[1]) <= _MICROSECONDS else None


def _in_order(path: Path) -> list[str | int]:
    """Key by which names are sorted as one reads them: scan 2 before scan 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", path.name)]
