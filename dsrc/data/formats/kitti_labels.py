"""KITTI's label files read: boxes with or without a confidence, and the calibration they need.

A line is `type truncated occluded alpha left top right bottom height width length x y z rotation_y`, and `score` after
it in results. The vehicles among the types are read; the writer is `dsrc.data.formats.kitti`.

Source: the development kit of the KITTI object benchmark (readme.txt); A. Geiger et al., CVPR 2012.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti import CAMERA_FROM_LIDAR, PROJECTION, TIME, WORLD
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.geometry import invert, transform_points
from sim.reading import parsing, read_text

VEHICLES = {"car": "car", "van": "van", "truck": "truck", "bus": "bus"}
"""Our classes by KITTI's types, in any case; it has no buses, but others' files in its format do."""
_WIDTH = 15
_FULL_TURN = 2.0 * np.pi + 1e-6
_LARGEST = 1e7
_NO_NUMBERS = ("calib_time:",)
"""Lines of KITTI's raw calibrations that hold a date."""


class InImage(NamedTuple):
    """What a label file says of N boxes in the image.

    Attributes:
        height_px: (N,) height, px.
        occluded: (N,) degree of occlusion, 0 none to 3 unknown.
        truncated: (N,) share that is out of the image, 0 to 1.
    """

    height_px: NDArray[np.float64]
    occluded: NDArray[np.float64]
    truncated: NDArray[np.float64]


class Labels(NamedTuple):
    """N vehicles of a label file.

    Attributes:
        boxes: in the LiDAR's frame.
        score: (N,) confidence, 1 where lines have none.
        image: of each box; of detections, which have no occlusion and no truncation, the height alone is meant.
    """

    boxes: Boxes
    score: NDArray[np.float32]
    image: InImage


def label_folder(tree: Path) -> Path | None:
    """Return the folder of the labels of KITTI's object tree, None for another folder."""
    places = [tree, tree / "label_2", tree / "training" / "label_2"]
    return next((place for place in places if place.name == "label_2" and place.is_dir()), None)


def list_labels(folder: Path) -> dict[int, Path]:
    """Return the label files of a folder by the number of their frame."""
    numbered = ((re.fullmatch(r"\d{1,9}", path.stem), path) for path in sorted(folder.glob("*.txt")))
    return {int(path.stem): path for number, path in numbered if number}


def read_labels(path: Path, camera_from_lidar: NDArray[np.float64], scored: bool = False) -> Labels:
    """Read the vehicles of a label file.

    Args:
        camera_from_lidar: (4, 4) from the LiDAR's frame to the rectified camera's.
        scored: lines end with a confidence.

    Raises:
        DataError: a line is not as described; names line and field.
    """
    lines = enumerate(read_text(path, "label file").splitlines(), 1)
    return parse_labels(path, list(lines), camera_from_lidar, scored)


def parse_labels(
    path: Path,
    lines: Sequence[tuple[int, str]],
    camera_from_lidar: NDArray[np.float64],
    scored: bool = False,
    users: Mapping[str, str] = VEHICLES,
) -> Labels:
    """Return the objects of label lines, each with its number in the file; raises as `read_labels`.

    Args:
        users: our classes by the types to keep, in lower case.
    """
    width = _WIDTH + scored
    kept: list[NDArray[np.float64]] = [np.zeros((0, width - 1))]
    labels: list[int] = []
    for number, line in lines:
        words = line.split()
        if not words:
            continue
        if len(words) != width and not (len(words) == _WIDTH + 1 and not scored):
            hint = "; the last one is the score" if scored and len(words) == _WIDTH else ""
            raise DataError(complaint(path, f"line {number}", f"{width} columns", len(words), hint))
        name = users.get(words[0].lower())
        if name is None:
            continue
        values = _values(path, number, line, words[1:width])
        if not (np.abs(values) <= _LARGEST).all() or (values[7:10] <= 0).any():
            raise DataError(complaint(path, f"line {number}", "a box of positive size", line))
        if abs(values[13]) > _FULL_TURN:
            raise DataError(complaint(path, f"line {number}", "rotation_y in radians, within 2 pi", f"{values[13]:g}"))
        kept.append(values[None])
        labels.append(CLASSES.index(name))
    rows = np.concatenate(kept)
    height, width_m, length = rows[:, 7:10].T
    place = transform_points(invert(camera_from_lidar), rows[:, 10:13] - [[0.0, 0.5, 0.0]] * height[:, None])
    array = np.column_stack([place, length, width_m, height, -rows[:, 13] - 0.5 * np.pi])
    score = rows[:, 14] if scored else np.ones(len(rows))
    image = InImage(height_px=rows[:, 6] - rows[:, 4], occluded=rows[:, 1], truncated=rows[:, 0])
    return Labels(Boxes.from_array(array, np.array(labels, np.int64)), score.astype(np.float32), image)


def _values(path: Path, number: int, line: str, words: list[str]) -> NDArray[np.float64]:
    try:
        return np.array(words, np.float64)
    except ValueError:
        raise DataError(complaint(path, f"line {number}", "numbers after the type", line)) from None


def regions_of(path: Path, lines: Sequence[tuple[int, str]]) -> NDArray[np.float64]:
    """Return (K, 4) left, top, right, bottom of the `DontCare` regions of label lines, px; DataError as `read_labels`.

    These are parts of the picture with objects that nobody has labelled.
    """
    words = [(number, line, line.split()) for number, line in lines]
    rows = [
        _values(path, number, line, word[4:8]) for number, line, word in words if word[:1] and word[0] == "DontCare"
    ]
    if any(row.shape != (4,) or not np.isfinite(row).all() for row in rows):
        raise DataError(complaint(path, "DontCare", "left, top, right and bottom, px", "others"))
    return np.array(rows, np.float64).reshape(-1, 4)


class KittiCalibration(NamedTuple):
    """Content of a calibration file, as far as it is used.

    Attributes:
        camera_from_lidar: (4, 4) to the rectified camera's frame.
        projection: (3, 4) P2, from there to the pixels of camera 2.
        world_from_lidar: (4, 4) in trees of ours, else None.
        time_s: of the frame in trees of ours, else None.
        camera_from_imu: (4, 4) where the file has one, to the rectified camera's frame.
    """

    camera_from_lidar: NDArray[np.float64]
    projection: NDArray[np.float64]
    world_from_lidar: NDArray[np.float64] | None = None
    time_s: float | None = None
    camera_from_imu: NDArray[np.float64] | None = None


def calibration_of(folder: Path, number: int) -> NDArray[np.float64]:
    """Return the (4, 4) transform from the LiDAR's frame to the rectified camera's of a frame.

    It is that of `calib` beside the folder of labels, else that of the nominal camera of `dsrc.data.formats.kitti`.

    Raises:
        DataError: the file of the calibration is damaged.
    """
    return read_calibration(folder.parent / "calib" / f"{number:06d}.txt").camera_from_lidar


def read_calibration(path: Path) -> KittiCalibration:
    """Return the calibration of a file, of the object or the tracking benchmark; the nominal one without a file.

    Raises:
        DataError: the file is damaged.
    """
    if not path.is_file():
        return KittiCalibration(CAMERA_FROM_LIDAR, PROJECTION)
    with parsing(path, "calibration"):
        lines = [line.split() for line in read_text(path, "calibration").splitlines() if line.strip()]
        # The tracking benchmark writes some of the names without a colon, and others than the object benchmark.
        rows = {words[0].rstrip(":"): np.array(words[1:], np.float64) for words in lines if words[0] not in _NO_NUMBERS}
        rectified = np.eye(4)
        rectified[:3, :3] = _first(path, rows, "R0_rect", "R_rect").reshape(3, 3)
        found = rectified @ _rigid(_first(path, rows, "Tr_velo_to_cam", "Tr_velo_cam"))
        if not np.isfinite(found).all() or abs(np.linalg.det(found[:3, :3]) - 1.0) > 1e-2:
            raise ValueError("R0_rect, Tr_velo_to_cam: not rotations")
        projection = rows["P2"].reshape(3, 4) if "P2" in rows else PROJECTION
        world = _rigid(rows[WORLD]) if WORLD in rows else None
        imu = next((rows[name] for name in ("Tr_imu_to_velo", "Tr_imu_velo") if name in rows), None)
        time_s = float(rows[TIME][0]) if TIME in rows else None
        known = [projection, *(part for part in (world, time_s, imu) if part is not None)]
        if not all(np.isfinite(part).all() for part in known):
            raise ValueError("a number is not finite")
        return KittiCalibration(found, projection, world, time_s, None if imu is None else found @ _rigid(imu))


def _first(path: Path, rows: dict[str, NDArray[np.float64]], *names: str) -> NDArray[np.float64]:
    """Return the numbers of a calibration by the first of their names that it has."""
    name = next((name for name in names if name in rows), None)
    if name is None:
        raise DataError(complaint(path, names[0], f"a line of numbers, as {' or '.join(names)}", "none"))
    return rows[name]


def _rigid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of 12 numbers."""
    return np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
