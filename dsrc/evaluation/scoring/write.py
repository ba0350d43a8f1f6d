"""Detections in the forms that `read_detections` reads: JSON, KITTI's labels with scores, OpenCOOD's arrays."""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti import CAMERA_FROM_LIDAR, CLASS_NAMES
from dsrc.data.formats.kitti_labels import calibration_of, label_folder
from dsrc.evaluation.scoring.read import BoxFile, BoxFrame
from dsrc.ops.detections import Detections
from sim.boxes import CLASSES, Boxes
from sim.files import write_file
from sim.geometry import transform_points, wrap_angle

BOXES = "boxes.json"


class FoundFrame(NamedTuple):
    """Detections of a frame, and its true boxes.

    Attributes:
        drive: name of the drive.
        frame: its number.
        ego: agent that detects.
        found: in the ego LiDAR's frame.
        truth: likewise; empty where there is none.
    """

    drive: str
    frame: int
    ego: int
    found: Detections
    truth: Boxes


def write_json(out: Path, frames: Iterable[FoundFrame]) -> Path:
    """Write `boxes.json`, see `BoxFile`; boxes have millimetres, scores five digits."""
    listed = tuple(
        BoxFrame(
            frame=one.frame,
            boxes=tuple(map(tuple, one.found.boxes.array.round(4).tolist())),
            score=tuple(one.found.score.astype(np.float64).round(5).tolist()),
            drive=one.drive,
            ego=one.ego,
        )
        for one in frames
    )
    content = msgspec.to_builtins(BoxFile(listed))
    plain = [{name: value for name, value in frame.items() if name != "scores"} for frame in content["frames"]]
    path = out / BOXES
    write_file(path, msgspec.json.encode({"frames": plain}) + b"\n")
    return path


def write_kitti(out: Path, frames: Iterable[FoundFrame], trees: Mapping[str, Path]) -> Path:
    """Write `kitti/DRIVE/000123.txt`, label files with scores, without boxes in the image.

    Args:
        trees: of the drives by name; those that are KITTI's have a calibration, the others a nominal camera.
    """
    for one in frames:
        labels = label_folder(trees[one.drive]) if one.drive in trees else None
        matrix = CAMERA_FROM_LIDAR if labels is None else calibration_of(labels, one.frame)
        text = _labels(one.found, matrix)
        write_file(out / "kitti" / one.drive / f"{one.frame:06d}.txt", text)
    return out / "kitti"


def write_opencood(out: Path, frames: Iterable[FoundFrame]) -> Path:
    """Write `opencood/0000_pred.npy` and `0000_gt.npy`, (n, 8, 3) corners by the number of the frame in all drives."""
    for number, one in enumerate(frames):
        for name, boxes in (("pred", one.found.boxes), ("gt", one.truth)):
            buffer = io.BytesIO()
            np.save(buffer, boxes.corners(), allow_pickle=False)
            write_file(out / "opencood" / f"{number:04d}_{name}.npy", buffer.getvalue())
    return out / "opencood"


def _labels(found: Detections, camera_from_lidar: NDArray[np.float64]) -> str:
    boxes, lines = found.boxes, []
    bottom = transform_points(camera_from_lidar, boxes.center)
    bottom[:, 1] += 0.5 * boxes.size[:, 2]  # the inverse of `read_labels`
    turns = wrap_angle(-boxes.yaw - 0.5 * np.pi)
    for row, (length, width, height) in enumerate(boxes.size):
        (x, y, z), turn = bottom[row], float(turns[row])
        alpha = float(wrap_angle(turn - np.arctan2(x, z)))
        lines.append(
            f"{CLASS_NAMES[CLASSES[boxes.label[row]]]} -1 -1 {alpha:.4f} 0 0 0 0 {height:.4f} {width:.4f} {length:.4f}"
            f" {x:.4f} {y:.4f} {z:.4f} {turn:.6f} {found.score[row]:.6f}\n"
        )
    return "".join(lines)
