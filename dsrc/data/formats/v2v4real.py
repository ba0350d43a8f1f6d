"""V2V4Real's dialect of OPV2V: the same folders, two cars, a real world.

* `lidar_pose` is a 4 x 4 matrix, world_from_lidar; everything is right-handed, the points too, and y is to the left.
* `vehicles.*.location` and `angle` are in the agent's own LiDAR frame, not in the world.
* `ass_id` is the object's number in both agents' files. Where it is -1 only this agent has seen it and the key is its
  number. Ids are moved away from those of the agents (0 and 1) and from each other; an agent's own car, labelled by the
  other one, has the agent's id.
* `obj_type` names the class. There are no speeds: velocities are finite differences.
* Frames are 0.1 s apart. The download's files hold numpy's arrays and numbers, see `yaml`.

Source: V2V4Real, CVPR 2023, and its published loader; issue 5 of its repository shows a file.
"""

from pathlib import Path

import numpy as np

from dsrc.data.formats.annotation import ID_LIMIT, Annotation, check_box, flattened, number, numbers, vehicles_of
from sim.boxes import CLASSES
from sim.errors import DataError, complaint
from sim.geometry import carla_matrix, nearest_rotation

INTERVAL_S = 0.1
_SHARED, _ALONE, _PER_AGENT = 1_000, 1_000_000, 100_000
_WORDS = {"pedestrian": "pedestrian", "cycl": "bicycle", "bus": "bus", "truck": "truck", "van": "van"}


def is_v2v4real(content: dict) -> bool:
    """Return whether a file is in V2V4Real's dialect: its pose is a matrix."""
    pose = content.get("lidar_pose")
    return isinstance(pose, list) and len(pose) == 4 and all(isinstance(row, list) for row in pose)


def annotation(path: Path, content: dict) -> Annotation:
    """Return the annotation of a file, whose folder has the agent's number for its name.

    Raises:
        DataError: a value is missing or wrong.
    """
    world_from_lidar = _matrix(path, "lidar_pose", content["lidar_pose"])
    agent = int(path.parent.name)
    ids, poses, extents, labels = [], [], [], []
    for key, entry in vehicles_of(path, content).items():
        where = f"vehicles.{key}."
        center = np.add(numbers(path, entry, "location", 3, where), numbers(path, entry, "center", 3, where))
        extent = numbers(path, entry, "extent", 3, where)
        check_box(path, f"{where}extent", center.tolist(), [2.0 * half for half in extent], 0.0)
        shared = int(number(path, f"{where}ass_id", entry.get("ass_id", key)))
        object_id = _SHARED + shared if shared >= 0 else _ALONE + _PER_AGENT * abs(agent) + key
        if not 0 <= object_id < ID_LIMIT:
            raise DataError(complaint(path, f"{where}ass_id", "a number of an object", shared))
        ids.append(object_id)
        poses.append([*center, *numbers(path, entry, "angle", 3, where)])
        extents.append(extent)
        name = str(entry.get("obj_type", "Car")).lower()
        labels.append(CLASSES.index(next((ours for word, ours in _WORDS.items() if word in name), "car")))
    # Poses of boxes have CARLA's order and signs of the angles, but are not mirrored.
    axes = world_from_lidar @ carla_matrix(np.array(poses, np.float64).reshape(-1, 6))
    boxes = flattened(axes, np.array(extents, np.float64).reshape(-1, 3), np.array(ids, np.int64))
    boxes.label[:] = labels
    order = np.argsort(boxes.object_id, kind="stable")
    return Annotation(
        world_from_lidar=world_from_lidar,
        world_from_body=world_from_lidar,
        speed=number(path, "ego_speed", content.get("ego_speed", 0.0)) / 3.6,
        boxes=boxes[order],
        velocity=np.full((len(boxes), 2), np.nan),
        mirrored=False,
        interval_s=INTERVAL_S,
    )


def _matrix(path: Path, field: str, rows: list) -> np.ndarray:
    values = [numbers(path, {field: row}, field, 4) for row in rows]
    matrix = np.array(values, np.float64)
    exact = nearest_rotation(matrix[:3, :3])
    if not np.allclose(matrix[:3, :3], exact, atol=0.01):
        raise DataError(complaint(path, field, "a rigid transform", np.round(matrix, 3).tolist()))
    matrix[:3, :3] = exact
    return matrix
