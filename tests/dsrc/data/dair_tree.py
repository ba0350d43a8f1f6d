"""A DAIR-V2X-C tree made by hand, with what is odd about the real one.

* Frames have other numbers on the two sides, times are text in microseconds, the sides are 0.1 s and 0.15 s apart.
* `lidar_to_novatel` has its rotation in a table `transform`, the others have not; rotations are rounded.
* The infrastructure is displaced by `system_error_offset`, which is "" where nobody has measured it.
* Clouds lie beside the tree, compressed, with intensity to 255 and nan for lost beams.
* Classes are written in several ways, a traffic cone is labelled, numbers are text here and there.
* One pair lacks its cloud, as some do in the download.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.dsrc.data.formats.test_pcd import compressed

TYPES = ("Car", "truck", "Van")
SIZES = np.array([[4.5, 1.8, 1.5], [8.0, 2.5, 3.2], [5.0, 2.0, 2.2]])
YAWS = np.array([0.6, -2.5, 3.0])
OFFSETS: dict[str, Any] = {"015344": {"delta_x": 0.75, "delta_y": "-0.5"}, "015345": "", "015346": ""}
TIMES_US = {"015344": 1626155124000000, "015345": 1626155124100000, "015346": 1626155125000000}
BEHIND_US = {"015344": 100000, "015345": 150000, "015346": 0}
BATCHES = {"015344": "12", "015345": "12", "015346": "3"}


def turn(yaw: float, pitch: float = 0.0) -> np.ndarray:
    c, s, d, t = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[d, 0, t], [0, 1, 0], [-t, 0, d]])


def pose(xyz: list[float], yaw: float, pitch: float = 0.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn(yaw, pitch), xyz
    return matrix


def boxes(frame: str) -> np.ndarray:
    """(3, 7) x, y, z, l, w, h, yaw in the world; the first drives 10 m/s along its heading."""
    place = np.array([[2650.0, 1750.0, 22.3], [2661.0, 1738.0, 23.1], [2640.0, 1760.0, 22.6]])
    seconds = (TIMES_US[frame] - TIMES_US["015344"]) / 1e6
    place[0, :2] += 10.0 * seconds * np.array([np.cos(YAWS[0]), np.sin(YAWS[0])])
    return np.concatenate([place, SIZES, YAWS[:, None]], axis=1)


def corners(box: np.ndarray) -> list[list[float]]:
    """Front left, front right, rear right, rear left at the bottom, then on top."""
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    local = np.array([[*(sign * box[3:5]), z * box[5] / 2] for z in (-1, 1) for sign in signs])
    return (local @ turn(box[6]).T + box[:3]).tolist()


LIDAR_TO_NOVATEL = pose([-0.3, 0.1, 0.4], 0.02, -0.01)
VIRTUALLIDAR_TO_WORLD = pose([2630.0, 1725.0, 27.5], 0.9)


def novatel_to_world(frame: str) -> np.ndarray:
    seconds = (TIMES_US[frame] - TIMES_US["015344"]) / 1e6
    return pose([2636.2 + 5.0 * seconds, 1745.0, 21.4], 2.6, 0.01)


def world_points(frame: str, seed: int) -> np.ndarray:
    """60 points in each box."""
    rng = np.random.default_rng(seed)
    parts = []
    for box in boxes(frame):
        local = rng.uniform(-0.45, 0.45, (60, 3)) * box[3:6]
        parts.append(local @ turn(box[6]).T + box[:3])
    return np.concatenate(parts)


def cloud(points: np.ndarray, world_from_lidar: np.ndarray) -> bytes:
    """A compressed file of the points and three lost beams."""
    local = (points - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
    table = np.zeros(len(local) + 3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    for k, name in enumerate("xyz"):
        table[name] = np.append(local[:, k], [np.nan] * 3)
    table["intensity"] = np.arange(len(table)) % 256
    return compressed(table)


def put(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(value if isinstance(value, bytes) else json.dumps(value).encode())


def table(matrix: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"rotation": matrix[:3, :3].round(9).tolist(), "translation": matrix[:3, 3:].tolist(), **more}


def label(frame: str, row: int, name: str | None = None, track: str | None = None) -> dict[str, Any]:
    box = boxes(frame)[row]
    entry = {
        "type": name or TYPES[row],
        "occluded_state": "0",
        "3d_location": {"x": str(box[0]), "y": str(box[1]), "z": str(box[2])},
        "world_8_points": corners(box),
        "system_error_offset": OFFSETS[frame],
    }
    return entry if track is None else {**entry, "track_id": track}


def make(folder: Path, tracks: bool = False) -> Path:
    """Write the tree; returns its root."""
    root = folder / "cooperative-vehicle-infrastructure"
    pairs, vehicle, infrastructure = [], [], []
    missing = {"015347": ("3", 1626155126000000)}
    for row, frame in enumerate([*TIMES_US, *missing]):
        other = f"{9 + 2 * row:06d}"
        there = frame in TIMES_US
        time_us = TIMES_US[frame] if there else missing[frame][1]
        vehicle.append(
            {
                "pointcloud_path": f"velodyne/{frame}.pcd",
                "pointcloud_timestamp": str(time_us),
                "batch_id": BATCHES.get(frame, "3"),
                "label_lidar_std_path": f"label/lidar/{frame}.json",
                "calib_lidar_to_novatel_path": f"calib/lidar_to_novatel/{frame}.json",
                "calib_novatel_to_world_path": f"calib/novatel_to_world/{frame}.json",
            }
        )
        infrastructure.append(
            {
                "pointcloud_path": f"velodyne/{other}.pcd",
                "pointcloud_timestamp": str(time_us - BEHIND_US.get(frame, 0)),
                "batch_id": BATCHES.get(frame, "3"),
                "intersection_loc": "yizhuang09",
            }
        )
        pairs.append(
            {
                "infrastructure_image_path": f"infrastructure-side/image/{other}.jpg",
                "infrastructure_pointcloud_path": f"infrastructure-side/velodyne/{other}.pcd",
                "vehicle_image_path": f"vehicle-side/image/{frame}.jpg",
                "vehicle_pointcloud_path": f"vehicle-side/velodyne/{frame}.pcd",
                "cooperative_label_path": f"cooperative/label_world/{frame}.json",
                "system_error_offset": OFFSETS.get(frame, ""),
            }
        )
        if not there:
            continue
        put(root / f"vehicle-side/calib/lidar_to_novatel/{frame}.json", {"transform": table(LIDAR_TO_NOVATEL)})
        put(root / f"vehicle-side/calib/novatel_to_world/{frame}.json", table(novatel_to_world(frame)))
        relative = {"relative_error": {"delta_x": "", "delta_y": ""}}
        put(
            root / f"infrastructure-side/calib/virtuallidar_to_world/{other}.json",
            table(VIRTUALLIDAR_TO_WORLD, **relative),
        )
        name = {"vehicle-side": frame, "infrastructure-side": other}
        true = VIRTUALLIDAR_TO_WORLD.copy()
        if OFFSETS[frame]:
            true[:2, 3] += [0.75, -0.5]
        lidars = {"vehicle-side": novatel_to_world(frame) @ LIDAR_TO_NOVATEL, "infrastructure-side": true}
        for side, lidar in lidars.items():
            beside = folder / f"cooperative-vehicle-infrastructure-{side}-velodyne"
            put(beside / f"{name[side]}.pcd", cloud(world_points(frame, len(side)), lidar))
        labels = [label(frame, k, track=str(40 + k) if tracks else None) for k in range(3)]
        cone = {"type": "TrafficCone", "world_8_points": corners(boxes(frame)[0] / 10)}
        put(root / f"cooperative/label_world/{frame}.json", [*labels, cone])
        put(root / f"cooperative/label_world_backup/{frame}.json", labels[:1])
    put(root / "cooperative/data_info.json", pairs)
    put(root / "vehicle-side/data_info.json", vehicle)
    put(root / "infrastructure-side/data_info.json", infrastructure)
    put(root / "val.json", ["015345", "015346"])
    put(root / "cooperative-split-data.json", {"cooperative_split": {"train": ["015344"], "val": [], "test": []}})
    return root
