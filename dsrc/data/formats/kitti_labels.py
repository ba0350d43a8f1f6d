"""KITTI's label files read: boxes with or without a confidence, and the calibration they need.

A line is `type truncated occluded alpha left top right bottom height width length x y z rotation_y`, and `score` after
it in results. The vehicles among the types are read; the writer is `dsrc.data.formats.kitti`.

Source: the development kit of the KITTI object benchmark (readme.txt); A. Geiger et al., CVPR 2012.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti import CAMERA_FROM_LIDAR
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.geometry import invert, transform_points
from sim.reading import parsing, read_text

VEHICLES = {"car": "car", "van": "van", "truck": "truck", "bus": "bus"}
"""Our classes by KITTI's types, in any case; it has no buses, but others' files in its format do."""
_WIDTH = 15
_LARGEST = 1e7


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
    width = _WIDTH + scored
    kept: list[NDArray[np.float64]] = [np.zeros((0, width - 1))]
    labels: list[int] = []
    for number, line in enumerate(read_text(path, "label file").splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if len(words) != width and not (len(words) == _WIDTH + 1 and not scored):
            hint = "; the last one is the score" if scored and len(words) == _WIDTH else ""
            raise DataError(complaint(path, f"line {number}", f"{width} columns", len(words), hint))
        name = VEHICLES.get(words[0].lower())
        if name is None:
            continue
        try:
            values = np.array(words[1:width], np.float64)
        except ValueError:
            raise DataError(complaint(path, f"line {number}", "numbers after the type", line)) from None
        if not (np.abs(values) <= _LARGEST).all() or (values[7:10] <= 0).any():
            raise DataError(complaint(path, f"line {number}", "a box of positive size", line))
        kept.append(values[None])
        labels.append(CLASSES.index(name))
    rows = np.concatenate(kept)
    height, width_m, length = rows[:, 7:10].T
    place = transform_points(invert(camera_from_lidar), rows[:, 10:13] - [[0.0, 0.5, 0.0]] * height[:, None])
    array = np.column_stack([place, length, width_m, height, -rows[:, 13] - 0.5 * np.pi])
    score = rows[:, 14] if scored else np.ones(len(rows))
    image = InImage(height_px=rows[:, 6] - rows[:, 4], occluded=rows[:, 1], truncated=rows[:, 0])
    return Labels(Boxes.from_array(array, np.array(labels, np.int64)), score.astype(np.float32), image)


def calibration_of(folder: Path, number: int) -> NDArray[np.float64]:
    """Return the (4, 4) transform from the LiDAR's frame to the rectified camera's of a frame.

    It is that of `calib` beside the folder of labels, else that of the nominal camera of `dsrc.data.formats.kitti`.

    Raises:
        DataError: the file of the calibration is damaged.
    """
    path = folder.parent / "calib" / f"{number:06d}.txt"
    if not path.is_file():
        return CAMERA_FROM_LIDAR
    with parsing(path, "calibration"):
        lines = (line.partition(":") for line in read_text(path, "calibration").splitlines() if line.strip())
        rows = {name.strip(): np.array(values.split(), np.float64) for name, _, values in lines}
        rectified, camera = np.eye(4), np.eye(4)
        rectified[:3, :3] = rows["R0_rect"].reshape(3, 3)
        camera[:3] = rows["Tr_velo_to_cam"].reshape(3, 4)
        found = rectified @ camera
        if not np.isfinite(found).all() or abs(np.linalg.det(found[:3, :3]) - 1.0) > 1e-2:
            raise ValueError("R0_rect, Tr_velo_to_cam: not rotations")
        return found
