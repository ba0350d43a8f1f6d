"""Layout of a data set of sweeps: what a reader needs to know of it.

A module of this folder holds a layout or two: it lists the frames of a drive and reads clouds, poses, boxes and the
region of the labels of one frame. All that follows from these, `reader` does once.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.intensity import EIGHT_BIT, Intensities
from sensors.frame import AgentKind, Region
from sensors.sweep import Sweep
from sim.boxes import CLASSES, Boxes, upright_of
from sim.errors import DataError, complaint
from sim.reading import read_bytes

INTERVAL_S = 0.1
"""Time between frames of data sets that tell none, s: that of a LiDAR at 10 Hz."""
FARTHEST_M = 1e8
"""Largest coordinate of a pose or box, m."""
IGNORED = "ignored"
"""Class of objects that are neither to be found nor wrong to find."""


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Ground truth of one frame.

    Attributes:
        boxes: objects in the world frame, with ids from 1 on.
        velocity: (N, 2) in the world, m/s; None where the data set has none.
        region: where the boxes are complete, world frame; None for everywhere.
        tilt: (N, 2) pitch and roll of the bodies, rad; None where the data set has none.
    """

    boxes: Boxes
    velocity: NDArray[np.float64] | None = None
    region: Region | None = None
    tilt: NDArray[np.float64] | None = None


class Layout:
    """One drive in the layout of a data set; positions `i` count its frames.

    Attributes:
        format: name of the data set, for people.
        path: of the drive.
        agents: ids of the sensors.
        kinds: of these.
        frames: numbers of the frames, ascending.
        height_m: of each sensor above the ground.
        tracked: ids are one object's over time and poses are in one world.
    """

    format: ClassVar[str] = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.agents: tuple[int, ...] = (0,)
        self.kinds: tuple[AgentKind, ...] = ("vehicle",)
        self.frames: tuple[int, ...] = ()
        self.height_m: tuple[float, ...] = (0.0,)
        self.tracked = False

    @classmethod
    def below(cls, folder: Path) -> list[Path]:
        """Return the paths of the drives of a file or folder itself; none where it is of another layout."""
        raise NotImplementedError

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Open the drive of a path that `below` gave; None for another layout's.

        Raises:
            DataError: the drive is damaged.
        """
        raise NotImplementedError

    def time_s(self, i: int) -> float:
        """Return the time of a frame, s."""
        return self.frames[i] * INTERVAL_S

    def poses(self, i: int) -> list[NDArray[np.float64]]:
        """Return the (4, 4) world_from_lidar of each sensor."""
        return [np.eye(4) for _ in self.agents]

    def sweeps(self, i: int) -> list[Sweep]:
        """Return the sweep of each sensor; DataError where a file is damaged."""
        raise NotImplementedError

    def labelled(self, i: int) -> bool:
        """Return whether a frame has ground truth, an empty one included."""
        return False

    def labels(self, i: int) -> Labels | None:
        """Return the ground truth of a frame, None without any; DataError where a file is damaged."""
        return None

    def files(self, i: int) -> list[Path]:
        """Return the files that a frame depends on; some may be of all frames."""
        raise NotImplementedError


@dataclass(slots=True)
class BoxRows:
    """Boxes being collected, one object after the other, in one frame of reference."""

    names: dict[str, str]
    rows: list[Sequence[float]] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    tilts: list[tuple[float, float]] = field(default_factory=list)

    def add_body(self, name: str, pose: NDArray[np.float64], size: Sequence[float], object_id: int) -> None:
        """Add an object by the (4, 4) pose of its middle, which may be tilted, and l, w, h; see `add`."""
        center, yaw, tilt = upright_of(pose, size[2])
        self.add(name, [*center.tolist(), *size, yaw], object_id, tilt)

    def add(self, name: str, row: Sequence[float], object_id: int, tilt: tuple[float, float] = (0.0, 0.0)) -> None:
        """Add an object of a data set's class, (7) x, y, z, l, w, h, yaw; unknown classes are left out."""
        ours = self.names.get(name)
        if ours is not None:
            self.rows.append(row)
            self.classes.append(ours)
            self.ids.append(object_id)
            self.tilts.append(tilt)

    def tilt(self) -> NDArray[np.float64]:
        """Return (N, 2) pitch and roll of the objects that are not to be ignored, rad."""
        kept = [tilt for tilt, name in zip(self.tilts, self.classes, strict=True) if name != IGNORED]
        return np.array(kept, np.float64).reshape(-1, 2)

    def boxes(self, place: Path | str, field_name: str) -> tuple[Boxes, Boxes]:
        """Return the objects and those to ignore; DataError where a number is none or a size not positive."""
        array = np.array(self.rows, np.float64).reshape(-1, 7)
        if not (np.abs(array) <= FARTHEST_M).all() or (array[:, 3:6] <= 0.0).any():
            raise DataError(complaint(place, field_name, "finite places and positive sizes", "others"))
        label = np.array([0 if name == IGNORED else CLASSES.index(name) for name in self.classes], np.int64)
        found = Boxes.from_array(array, label, np.array(self.ids, np.int64))
        ignored = np.array([name == IGNORED for name in self.classes], bool)
        return found[~ignored], found[ignored]


def read_floats(path: Path, width: int, what: str = "scan") -> NDArray[np.float32]:
    """Read (P, width) float32 of a binary file; DataError where it holds no whole points."""
    content = read_bytes(path, what)
    if len(content) % (4 * width):
        raise DataError(complaint(path, "size", f"whole points of {4 * width} bytes", f"{len(content)} bytes"))
    return np.frombuffer(content, "<f4").reshape(-1, width)


def unit_intensity(path: Path, values: NDArray, full_scale: float) -> NDArray[np.float32]:
    """Return (P,) intensities of 0 to 1; DataError where one does not fit the scale of the data set."""
    lowest, highest = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    if not (lowest >= 0.0 and highest <= full_scale * _OVER):
        raise DataError(complaint(path, "intensity", f"0 to {full_scale:g}", f"{lowest:g} to {highest:g}"))
    return np.minimum(values / np.float64(full_scale), 1.0).astype(np.float32)


def eight_bit_intensity(path: Path, values: NDArray) -> NDArray[np.float32]:
    """Return (P,) intensities of 0 to 255 as those of 0 to 1; fractions, which others write, stay as they are."""
    fractions = Intensities.of(values, path.name).fractions is not None
    return unit_intensity(path, values, 1.0 if fractions else EIGHT_BIT)


_OVER = 1.01
"""Of full scale, what still rounds to it: one value of 1.004 is no other scale."""


def finite(path: Path, points: NDArray) -> NDArray:
    """Return points; DataError where one is not finite."""
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise DataError(complaint(path, "points", "finite coordinates", f"{bad} of {len(points)} that are not"))
    return points


def png_size(path: Path) -> tuple[int, int] | None:
    """Return width and height of a PNG by its header, px; None for a missing or another file."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        return None
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        return None
    width, height = struct.unpack(">II", head[16:24])
    return int(width), int(height)


def numbered(folder: Path, ending: str) -> dict[int, Path]:
    """Return the files of a folder with numbers for names, by these, ascending."""
    found = [path for path in folder.glob(f"*{ending}") if path.stem.isascii() and path.stem.isdecimal()]
    return dict(sorted((int(path.stem), path) for path in found if len(path.stem) < 19))


def poses_of(
    path: Path, turns: NDArray[np.float64], places: NDArray[np.float64], field_name: str = "pose"
) -> NDArray[np.float64]:
    """Return (N, 4, 4) poses of (N, 4) quaternions w, x, y, z and (N, 3) places; DataError where one is none."""
    length = np.linalg.norm(turns, axis=1)
    if not (np.isfinite(turns).all() and (np.abs(places) <= FARTHEST_M).all() and (np.abs(length - 1.0) < 0.01).all()):
        raise DataError(complaint(path, field_name, "quaternions of length 1 and finite places", "others"))
    w, x, y, z = (turns / length[:, None]).T
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    poses[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    poses[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    poses[:, :3, 3] = places
    return poses
