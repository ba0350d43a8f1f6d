"""DAIR-V2X-C writer: the ego as the vehicle, a roadside unit (else another vehicle) as the infrastructure.

Labels are the complemented ones, all around; `label_world_backup` and `label/lidar_backup`, which some loaders read,
have the objects before a sensor, as the originals were annotated in a camera's image. Labels have a `track_id`, clouds
all columns of a sweep; `testbed.json` has the values that the tree lacks. Each frame leaves a part in `.parts`, from
which the indices are written.

The infrastructure's points are in a level frame, like the dataset's virtual LiDAR: a box there has one angle only.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.dair.tree import (
    CLASS_NAMES,
    LABEL_FOLDERS,
    SIDECAR,
    SPLIT,
    TREE,
    BatchRecord,
    Sidecar,
    SideRecord,
)
from dsrc.data.formats.levelling import levelled, occlusion
from dsrc.data.formats.pcd import encode_sensor_pcd
from dsrc.data.jsonio import encode_json, read_json
from sensors.frame import AgentFrame, Frame
from sensors.sweep import Sweep
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.files import Content, write_file
from sim.geometry import invert, transform_points

VERSION = 1
SPLITS = ("train", "val", "test")
_PARTS = ".parts"
_HALF_VIEW = np.radians(50.0)
"""Half the field of view of a camera at a sensor."""
# Around the bottom: front left, front right, rear right, rear left; then the top. Ours begin at the front right.
_CORNERS = [1, 0, 3, 2, 5, 4, 7, 6]
_NO_OFFSET = {"delta_x": 0.0, "delta_y": 0.0}
_VEHICLE, _INFRASTRUCTURE = "vehicle-side", "infrastructure-side"


class DairWriter:
    """Writer of frames into `OUT/cooperative-vehicle-infrastructure`."""

    def __init__(self, out: Path, ego_id: int | None = None) -> None:
        """Set the folder and the ego; None takes each frame's first vehicle."""
        self.tree = out / TREE
        self.ego_id = ego_id

    def done(self, number: int) -> bool:
        """Return whether a frame is complete."""
        return self._part(number).exists()

    def write(self, number: int, batch: int, drive: str, split: str, frame: Frame) -> None:
        """Write one frame.

        Args:
            number: of the frame in the tree; both sides' files have it.
            split: train, val or test.

        Raises:
            DataError: the frame lacks the ego or a second agent.
        """
        rows = sides_of(frame, self.ego_id)
        stem = f"{number:06d}"
        vehicle, infrastructure = (frame.agents[row] for row in rows)
        virtual = levelled(infrastructure.sweep)
        counts = frame.points_on[rows]
        seen = (counts >= 1) & (frame.truth.object_id != np.array([[a.agent_id] for a in (vehicle, infrastructure)]))
        front = np.stack([_before(frame.truth, sweep) for sweep in (vehicle.sweep, virtual)]) & seen
        hidden = occlusion(frame.visible_fraction[rows])
        content: dict[str, Content] = {
            f"{_VEHICLE}/velodyne/{stem}.pcd": encode_sensor_pcd(vehicle.sweep),
            f"{_INFRASTRUCTURE}/velodyne/{stem}.pcd": encode_sensor_pcd(virtual),
        }
        lidar_to_novatel = invert(vehicle.world_from_body) @ vehicle.sweep.world_from_lidar
        for name, table in {
            f"{_VEHICLE}/calib/lidar_to_novatel": {"transform": _transform(lidar_to_novatel)},
            f"{_VEHICLE}/calib/novatel_to_world": {**_transform(vehicle.world_from_body), "relative_error": _NO_OFFSET},
            f"{_INFRASTRUCTURE}/calib/virtuallidar_to_world": {
                **_transform(virtual.world_from_lidar),
                "relative_error": _NO_OFFSET,
            },
            f"{_VEHICLE}/label/lidar": _side_labels(frame, seen[0], vehicle.sweep, hidden[0], counts[0]),
            f"{_VEHICLE}/label/lidar_backup": _side_labels(frame, front[0], vehicle.sweep, hidden[0], counts[0]),
            f"{_INFRASTRUCTURE}/label/virtuallidar": _side_labels(frame, seen[1], virtual, hidden[1], counts[1]),
            f"cooperative/{LABEL_FOLDERS['complemented']}": _world_labels(frame, seen.any(axis=0), hidden.min(axis=0)),
            f"cooperative/{LABEL_FOLDERS['original']}": _world_labels(frame, front.any(axis=0), hidden.min(axis=0)),
        }.items():
            content[f"{name}/{stem}.json"] = encode_json(table)
        for relative, data in content.items():
            write_file(self.tree / relative, data)
        body = invert(virtual.world_from_lidar) @ infrastructure.world_from_body
        part = {
            "split": split,
            "batch_id": str(batch),
            "drive": drive,
            "times_us": [round(sweep.time_s * 1e6) for sweep in (vehicle.sweep, virtual)],
            "vehicle": _record(vehicle, vehicle.sweep, None),
            "infrastructure": _record(infrastructure, virtual, body),
        }
        write_file(self._part(number), encode_json(part))

    def finish(self, numbers: Sequence[int]) -> None:
        """Write the indices, the splits and our record, and remove the parts."""
        parts = {number: read_json(self._part(number), dict[str, Any]) for number in numbers}
        members: dict[str, list[int]] = {}
        for number, part in parts.items():
            members.setdefault(part["batch_id"], []).append(number)
        index: dict[str, list[dict[str, Any]]] = {"cooperative": [], _VEHICLE: [], _INFRASTRUCTURE: []}
        for number, part in parts.items():
            stem, same = f"{number:06d}", members[part["batch_id"]]
            index["cooperative"].append(_pair(stem))
            for row, side in enumerate((_VEHICLE, _INFRASTRUCTURE)):
                index[side].append(_side_info(stem, side, part, row, f"{same[0]:06d}", f"{same[-1]:06d}"))
        for folder, entries in index.items():
            write_file(self.tree / folder / "data_info.json", encode_json(entries))
        stems = {split: [f"{n:06d}" for n, part in parts.items() if part["split"] == split] for split in SPLITS}
        for split, names in stems.items():
            if names:
                write_file(self.tree / f"{split}.json", encode_json(names))
        batches = {
            split: [b for b, numbers in members.items() if parts[numbers[0]]["split"] == split] for split in SPLITS
        }
        shared = {name: stems for name in ("vehicle_split", "infrastructure_split", "cooperative_split")}
        write_file(self.tree / SPLIT, encode_json({"batch_split": batches, **shared}))
        records = {}
        for batch, numbers in members.items():
            part = parts[numbers[0]]
            sides = {side: msgspec.convert(part[side], SideRecord) for side in ("vehicle", "infrastructure")}
            records[batch] = BatchRecord(part["drive"], **sides)
        write_file(self.tree / SIDECAR, encode_json(Sidecar(VERSION, records)))
        shutil.rmtree(self.tree / _PARTS)

    def _part(self, number: int) -> Path:
        return self.tree / _PARTS / f"{number:06d}.json"


def sides_of(frame: Frame, ego_id: int | None) -> list[int]:
    """Return the rows of the vehicle and of the infrastructure: a roadside unit, else the next vehicle.

    Raises:
        DataError: the ego or a second agent is missing.
    """
    agents = list(enumerate(frame.agents))
    ids = [agent.agent_id for agent in frame.agents]
    vehicles = [
        row for row, agent in agents if (agent.kind == "vehicle" if ego_id is None else agent.agent_id == ego_id)
    ]
    if not vehicles:
        wanted = "a vehicle" if ego_id is None else f"agent {ego_id}"
        raise DataError(complaint(f"frame {frame.index}", "agents", wanted, str(ids)))
    others = [row for row, agent in agents if row != vehicles[0] and agent.kind == "roadside"]
    others += [row for row, agent in agents if row != vehicles[0] and agent.kind == "vehicle"]
    if not others:
        raise DataError(complaint(f"frame {frame.index}", "agents", "two, one for each side of DAIR-V2X-C", str(ids)))
    return [vehicles[0], others[0]]


def _before(truth: Boxes, sweep: Sweep) -> NDArray[np.bool_]:
    """Return (N,) whether objects stand before a sensor."""
    place = transform_points(invert(sweep.world_from_lidar), truth.center)
    return np.abs(np.arctan2(place[:, 1], place[:, 0])) <= _HALF_VIEW


def _record(agent: AgentFrame, sweep: Sweep, body: NDArray[np.float64] | None) -> dict[str, Any]:
    return {
        "agent_id": int(agent.agent_id),
        "kind": agent.kind,
        "motion": sweep.motion,
        "lidar": None if sweep.spec is None else msgspec.to_builtins(sweep.spec),
        "lidar_from_body": None if body is None else body.tolist(),
    }


def _transform(matrix: NDArray[np.float64]) -> dict[str, Any]:
    return {"rotation": matrix[:3, :3].tolist(), "translation": matrix[:3, 3:].tolist()}


def _world_labels(frame: Frame, kept: NDArray[np.bool_], hidden: NDArray[np.int64]) -> list[dict[str, Any]]:
    boxes = frame.truth[kept]
    corners = boxes.corners()[:, _CORNERS]
    return [
        {**entry, "world_8_points": np.round(points, 6).tolist(), "system_error_offset": _NO_OFFSET}
        for entry, points in zip(_entries(boxes, hidden[kept]), corners, strict=True)
    ]


def _side_labels(
    frame: Frame, kept: NDArray[np.bool_], sweep: Sweep, hidden: NDArray[np.int64], counts: NDArray[np.int32]
) -> list[dict[str, Any]]:
    entries = _entries(frame.truth[kept].transform(invert(sweep.world_from_lidar)), hidden[kept])
    return [{**entry, "points_on": count} for entry, count in zip(entries, counts[kept].tolist(), strict=True)]


def _entries(boxes: Boxes, hidden: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Return labels of one side of boxes with their occlusion."""
    entries = []
    rows = np.round(boxes.array, 6).tolist()
    for row, object_id, label, occluded in zip(rows, boxes.object_id, boxes.label, hidden.tolist(), strict=True):
        x, y, z, length, width, height, yaw = row
        entries.append(
            {
                "type": CLASS_NAMES[CLASSES[label]],
                "track_id": str(object_id),
                "truncated_state": 0,
                "occluded_state": occluded,
                "2d_box": {"xmin": 0.0, "ymin": 0.0, "xmax": 0.0, "ymax": 0.0},
                "3d_dimensions": {"h": height, "w": width, "l": length},
                "3d_location": {"x": x, "y": y, "z": z},
                "rotation": yaw,
            }
        )
    return entries


def _pair(stem: str) -> dict[str, Any]:
    return {
        "infrastructure_image_path": f"{_INFRASTRUCTURE}/image/{stem}.jpg",
        "infrastructure_pointcloud_path": f"{_INFRASTRUCTURE}/velodyne/{stem}.pcd",
        "vehicle_image_path": f"{_VEHICLE}/image/{stem}.jpg",
        "vehicle_pointcloud_path": f"{_VEHICLE}/velodyne/{stem}.pcd",
        "cooperative_label_path": f"cooperative/{LABEL_FOLDERS['complemented']}/{stem}.json",
        "system_error_offset": _NO_OFFSET,
    }


def _side_info(stem: str, side: str, part: dict[str, Any], row: int, first: str, last: str) -> dict[str, Any]:
    lidar, calib = "lidar", ["lidar_to_novatel", "novatel_to_world"]
    if side == _INFRASTRUCTURE:
        lidar, calib = "virtuallidar", ["virtuallidar_to_world"]
    time_us = str(part["times_us"][row])
    return {
        "image_path": f"image/{stem}.jpg",
        "image_timestamp": time_us,
        "pointcloud_path": f"velodyne/{stem}.pcd",
        "pointcloud_timestamp": time_us,
        f"label_{lidar}_std_path": f"label/{lidar}/{stem}.json",
        **{f"calib_{name}_path": f"calib/{name}/{stem}.json" for name in calib},
        "batch_id": part["batch_id"],
        "batch_start_id": first,
        "batch_end_id": last,
        "intersection_loc": part["drive"],
    }
