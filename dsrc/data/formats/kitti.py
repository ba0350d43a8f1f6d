"""KITTI writer: the object tree, one frame for one agent at one instant.

    OUT/training/{velodyne/N.bin, label_2/N.txt, calib/N.txt, image_2/N.png}
    OUT/ImageSets/{train,val,trainval,test}.txt
    OUT/frames.csv            drive, frame and agent of each number

Beyond KITTI's lines a calibration has two more, which its readers pass over: the LiDAR's pose in the world of the
drive, `Tr_velo_to_world`, and `time`, s.

KITTI's `testing` holds frames without labels; all of ours have them, those of test drives too.

Velodyne points are x forward, y left, z up, as ours, with intensity from 0 to 1. The camera is a nominal one: KITTI's
intrinsics, 0.27 m before and 0.08 m below the LiDAR, looking along its x axis; the images are black, for loaders that
read their size. A label has the centre of the bottom of its box in the camera's frame (x right, y
down, z forward) and `rotation_y` about y, 0 along x.

Source: the development kit of the KITTI object benchmark (readme.txt); A. Geiger et al., CVPR 2012.
"""

import struct
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.levelling import levelled, occlusion
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.boxes import CLASSES, Boxes
from sim.files import write_file
from sim.geometry import invert, transform_points, wrap_angle

LabelView = Literal["camera", "around"]

CLASS_NAMES = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Misc",
    "motorcycle": "Misc",
    "bicycle": "Cyclist",
    "pedestrian": "Pedestrian",
}
"""KITTI's classes by ours; KITTI has no buses and no motorcycles."""

WIDTH, HEIGHT = 1242, 375
PROJECTION = np.array(
    [[721.5377, 0.0, 609.5593, 0.0], [0.0, 721.5377, 172.854, 0.0], [0.0, 0.0, 1.0, 0.0]],
)
"""(3, 4) P2 without the offset to the left grey camera."""
CAMERA_FROM_LIDAR = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0.0, 0.0, 0.0, 1.0]],
)
WORLD, TIME = "Tr_velo_to_world", "time"
"""Names of lines of a calibration that KITTI does not have."""
_NEAR_M = 0.1
_SETS = {"train": ("train",), "val": ("val",), "test": ("test",), "trainval": ("train", "val")}
"""Splits in each list of frames."""


class KittiWriter:
    """Writer of frames into a folder; the label of a frame is its last file."""

    def __init__(self, out: Path, view: LabelView = "camera") -> None:
        """Set the folder and the labels: those in the camera's image or all around."""
        self.out, self.view = out, view

    def done(self, number: int) -> bool:
        """Return whether a frame is complete."""
        return self._file("label_2", number, "txt").exists()

    def write(self, number: int, frame: Frame, row: int) -> None:
        """Write the frame of the agent in a row."""
        sweep = frame.agents[row].sweep
        if frame.agents[row].kind == "roadside":
            sweep = levelled(sweep)
        cloud = np.concatenate([sweep.points, sweep.intensity[:, None]], axis=1)
        seen = (frame.points_on[row] >= 1) & (frame.truth.object_id != frame.agents[row].agent_id)
        boxes = frame.truth[seen].transform(invert(sweep.world_from_lidar))
        write_file(self._file("velodyne", number, "bin"), cloud.astype("<f4").tobytes())
        write_file(self._file("calib", number, "txt"), _calibration(sweep, frame.time_s).encode())
        write_file(self._file("image_2", number, "png"), _black())
        labels = encode_labels(boxes, self.view, occlusion(frame.visible_fraction[row, seen]))
        write_file(self._file("label_2", number, "txt"), labels.encode())

    def finish(self, places: Sequence[tuple[int, str, str, int, int]]) -> None:
        """Write the lists of frames; places are (number, split, drive, frame, agent), split train, val or test."""
        for name, splits in _SETS.items():
            numbers = (f"{number:06d}\n" for number, split, *_ in places if split in splits)
            write_file(self.out / "ImageSets" / f"{name}.txt", "".join(numbers).encode())
        rows = [f"{number:06d},{split},{drive},{index},{agent}\n" for number, split, drive, index, agent in places]
        write_file(self.out / "frames.csv", ("number,split,drive,frame,agent\n" + "".join(rows)).encode())

    def _file(self, folder: str, number: int, ending: str) -> Path:
        return self.out / "training" / folder / f"{number:06d}.{ending}"


def encode_labels(boxes: Boxes, view: LabelView, hidden: NDArray[np.int64]) -> str:
    """Return the text of a label file for boxes in the LiDAR's frame; `hidden` (N,) are degrees of occlusion.

    Objects out of the image are left out or, all around, have no 2D box, truncation 1 and occlusion 3 (unknown).
    """
    lines = []
    bottom = boxes.center - [0.0, 0.0, 0.5] * boxes.size
    places = transform_points(CAMERA_FROM_LIDAR, bottom)
    turns = wrap_angle(-boxes.yaw - 0.5 * np.pi)
    for row, corners in enumerate(transform_points(CAMERA_FROM_LIDAR, boxes.corners())):
        picture, truncated = _projected(corners)
        if picture is None and view == "camera":
            continue
        x, y, z = places[row]
        length, width, height = boxes.size[row]
        turn = float(turns[row])
        alpha = float(wrap_angle(turn - np.arctan2(x, z)))
        occluded = 3 if picture is None else int(hidden[row])
        left, top, right, under = picture or (0.0, 0.0, 0.0, 0.0)
        lines.append(
            f"{CLASS_NAMES[CLASSES[boxes.label[row]]]} {truncated:.2f} {occluded} {alpha:.4f}"
            f" {left:.2f} {top:.2f} {right:.2f} {under:.2f}"
            f" {height:.7f} {width:.7f} {length:.7f} {x:.7f} {y:.7f} {z:.7f} {turn:.9f}\n"
        )
    return "".join(lines)


def _projected(corners: NDArray[np.float64]) -> tuple[tuple[float, float, float, float] | None, float]:
    """Return the 2D box of (8, 3) corners in the camera's frame, None out of the image, and the truncated share."""
    if corners[:, 2].mean() < _NEAR_M:
        return None, 1.0
    # Corners behind the camera are moved to its near plane; the image's edge cuts the rest.
    shown = np.concatenate([np.maximum(corners, [-np.inf, -np.inf, _NEAR_M]), np.ones((8, 1))], axis=1) @ PROJECTION.T
    pixels = shown[:, :2] / shown[:, 2:]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    inside_low, inside_high = np.maximum(low, 0.0), np.minimum(high, [WIDTH - 1.0, HEIGHT - 1.0])
    if not (inside_high > inside_low).all():
        return None, 1.0
    kept = float(np.prod(inside_high - inside_low) / np.prod(high - low))
    return (*inside_low.tolist(), *inside_high.tolist()), round(1.0 - kept, 2)


def _calibration(sweep: Sweep, time_s: float) -> str:
    """Return the text of a calibration file; all cameras are one."""
    rows = {f"P{camera}": PROJECTION for camera in range(4)}
    rows |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": CAMERA_FROM_LIDAR[:3], "Tr_imu_to_velo": np.eye(4)[:3]}
    lines = [f"{name}: {' '.join(f'{value:.12e}' for value in rows[name].ravel())}\n" for name in rows]
    world = " ".join(map(repr, sweep.world_from_lidar[:3].ravel().tolist()))
    return "".join([*lines, f"{WORLD}: {world}\n", f"{TIME}: {time_s!r}\n"])


@lru_cache(maxsize=1)
def _black() -> bytes:
    """Return a black PNG of KITTI's size."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes((1 + 3 * WIDTH) * HEIGHT), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
