"""Tables like nuScenes': one scene per drive and agent, every frame a key frame, LIDAR_TOP alone.

    OUT/v1.0-trainval/{scene, sample, sample_data, sample_annotation, ...}.json
    OUT/samples/LIDAR_TOP/SCENE__000000.pcd.bin      x right, y forward, z, intensity to 255, ring from the bottom

The map is the drive's world. Beyond nuScenes' columns a sensor has its `model`, and an instance its `object_id`; vans
have a category of their own, `vehicle.van`. All objects but the agent itself are annotated, with their points.

Source: the schema of nuScenes (docs/schema_nuscenes.md of nuscenes-devkit).
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.intensity import EIGHT_BIT
from dsrc.data.formats.mcap.file import quaternion
from dsrc.data.sweeps.nuscenes import CHANNEL, FORWARD_FROM_RIGHT
from sensors.frame import Frame
from sim.boxes import CLASSES
from sim.files import write_file
from sim.geometry import invert

VERSION = "v1.0-trainval"
CATEGORIES = {
    "car": "vehicle.car",
    "van": "vehicle.van",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult",
}
"""nuScenes' categories by our classes."""
_PARTS = "parts"
"""Folder of the frames' rows while the drives are being written."""


class NuScenesWriter:
    """Writer of frames; the tables are joined at the end."""

    def __init__(self, out: Path) -> None:
        self.out = out

    def done(self, scene: str, number: int) -> bool:
        """Return whether a frame is complete."""
        return self._part(scene, number).is_file()

    def write(self, scene: str, number: int, frame: Frame, row: int) -> None:
        """Write the cloud and the rows of the agent in a row."""
        agent = frame.agents[row]
        sweep = agent.sweep
        rings = int(sweep.ring.max(initial=0)) + 1 if sweep.spec is None else sweep.spec.rings
        points = [-sweep.points[:, 1], sweep.points[:, 0], sweep.points[:, 2]]
        intensity = sweep.intensity.astype(np.float64) * EIGHT_BIT
        cloud = np.column_stack([*points, intensity, rings - 1 - sweep.ring.astype(np.int64)]).astype("<f4")
        name = f"samples/{CHANNEL}/{_token(scene)}__{number:06d}.pcd.bin"
        write_file(self.out / name, cloud.tobytes())
        others = frame.truth.object_id != agent.agent_id
        boxes, points_on, bodies = frame.truth[others], frame.points_on[row, others], frame.bodies()[others]
        mount = invert(agent.world_from_body) @ sweep.world_from_lidar @ FORWARD_FROM_RIGHT
        part = {
            "file": name,
            "time_us": round(frame.time_s * 1e6),
            "model": "" if sweep.spec is None else sweep.spec.name,
            "body": _pose(agent.world_from_body),
            "mount": _pose(mount),
            "objects": [
                {
                    "object_id": int(boxes.object_id[k]),
                    "class": CLASSES[boxes.label[k]],
                    "size": boxes.size[k, [1, 0, 2]].tolist(),
                    "points": int(points_on[k]),
                    **_pose(bodies[k]),
                }
                for k in range(len(boxes))
            ],
        }
        write_file(self._part(scene, number), json.dumps(part).encode())

    def finish(self, scenes: dict[str, int]) -> None:
        """Join the rows of all frames; scenes by name, with their numbers of frames."""
        tables: dict[str, list[dict[str, Any]]] = {
            "log": [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": ""}],
            "map": [{"token": "map", "log_tokens": ["log"], "category": "", "filename": ""}],
            "category": [{"token": ours, "name": name, "description": ""} for ours, name in CATEGORIES.items()],
            "visibility": [{"token": "1", "level": "v0-40", "description": ""}],
            "attribute": [],
            "sensor": [],
        }
        for scene, frames in scenes.items():
            parts = [json.loads(self._part(scene, number).read_bytes()) for number in range(frames)]
            for name, rows in _scene_rows(scene, parts).items():
                tables.setdefault(name, []).extend(rows)
        for name, rows in tables.items():
            once = {row["token"]: row for row in rows}
            write_file(self.out / VERSION / f"{name}.json", json.dumps(list(once.values()), indent=0).encode())
        shutil.rmtree(self.out / _PARTS, ignore_errors=True)

    def _part(self, scene: str, number: int) -> Path:
        return self.out / _PARTS / _token(scene) / f"{number:06d}.json"


def _scene_rows(scene: str, parts: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of a scene by table."""
    key = _token(scene)
    models = sorted({part["model"] for part in parts})
    instances: dict[int, dict[str, Any]] = {}
    notes: list[dict[str, Any]] = []
    latest: dict[int, dict[str, Any]] = {}
    for number, part in enumerate(parts):
        for entry in part["objects"]:
            one, token = entry["object_id"], f"{key}-{number}-{entry['object_id']}"
            instance = f"{key}-{one}"
            note = {
                "token": token,
                "sample_token": f"{key}-{number}",
                "instance_token": instance,
                "visibility_token": "1",
                "attribute_tokens": [],
                "translation": entry["translation"],
                "rotation": entry["rotation"],
                "size": entry["size"],
                "num_lidar_pts": entry["points"],
                "num_radar_pts": 0,
                "prev": "",
                "next": "",
            }
            if one in latest:
                note["prev"], latest[one]["next"] = latest[one]["token"], token
            else:
                instances[one] = {
                    "token": instance,
                    "category_token": entry["class"],
                    "nbr_annotations": 0,
                    "first_annotation_token": token,
                    "object_id": one,
                }
            instances[one]["nbr_annotations"] += 1
            instances[one]["last_annotation_token"] = token
            latest[one] = note
            notes.append(note)
    numbers = range(len(parts))
    around = [{"prev": _near(key, n - 1, len(parts)), "next": _near(key, n + 1, len(parts))} for n in numbers]
    ends = {"first_sample_token": f"{key}-0", "last_sample_token": f"{key}-{len(parts) - 1}"}
    return {
        "scene": [
            {"token": key, "name": key, "description": "", "log_token": "log", "nbr_samples": len(parts), **ends}
        ],
        "sensor": [
            {"token": f"lidar-{model}", "channel": CHANNEL, "modality": "lidar", "model": model} for model in models
        ],
        "sample": [
            {"token": f"{key}-{n}", "timestamp": parts[n]["time_us"], "scene_token": key, **around[n]} for n in numbers
        ],
        "sample_data": [
            {
                "token": f"{key}-{n}",
                "sample_token": f"{key}-{n}",
                "ego_pose_token": f"{key}-{n}",
                "calibrated_sensor_token": f"{key}-{n}",
                "filename": parts[n]["file"],
                "fileformat": "pcd",
                "width": 0,
                "height": 0,
                "timestamp": parts[n]["time_us"],
                "is_key_frame": True,
                **around[n],
            }
            for n in numbers
        ],
        "ego_pose": [{"token": f"{key}-{n}", "timestamp": parts[n]["time_us"], **parts[n]["body"]} for n in numbers],
        "calibrated_sensor": [
            {
                "token": f"{key}-{n}",
                "sensor_token": f"lidar-{parts[n]['model']}",
                "camera_intrinsic": [],
                **parts[n]["mount"],
            }
            for n in numbers
        ],
        "instance": list(instances.values()),
        "sample_annotation": notes,
    }


def _near(key: str, number: int, frames: int) -> str:
    return f"{key}-{number}" if 0 <= number < frames else ""


def _token(scene: str) -> str:
    """Return the name of a scene as a token and as a part of file names."""
    return scene.replace("/", "-")


def _pose(matrix: NDArray[np.float64]) -> dict[str, list[float]]:
    turn = quaternion(matrix)
    return {"translation": matrix[:3, 3].tolist(), "rotation": [turn[axis] for axis in "wxyz"]}
