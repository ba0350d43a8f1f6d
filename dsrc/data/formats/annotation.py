"""Annotation of one agent at one instant, from the yaml of another tool's OPV2V tree.

OPV2V's world is CARLA's: left-handed, y to the right, degrees, half extents, km/h. The keys `lidar_pose`,
`true_ego_pos`, `ego_speed` and `vehicles` are read; `predicted_ego_pos`, `plan_trajectory`, the cameras and all others
are ignored. V2XSet's files are the same.

Source of the keys: OPV2V, ICRA 2022, and the documents of OpenCOOD (data_intro.md).
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, complaint
from sim.geometry import matrix_from_carla, wrap_angle

ID_LIMIT = 2**31


@dataclass(frozen=True, slots=True, eq=False)
class Annotation:
    """Content of another tool's file, in our frames and units.

    Attributes:
        world_from_lidar: (4, 4) in our right-handed world.
        world_from_body: (4, 4), that of the LiDAR where the file has none.
        speed: m/s.
        boxes: the vehicles that the agent has annotated, world frame.
        velocity: (N, 2) m/s, along the headings; NaN where the file has none.
        mirrored: the points beside the file are in CARLA's left-handed frame.
        interval_s: time between frames, None for the tick of a simulation.
    """

    world_from_lidar: NDArray[np.float64]
    world_from_body: NDArray[np.float64]
    speed: float
    boxes: Boxes
    velocity: NDArray[np.float64]
    mirrored: bool = True
    interval_s: float | None = None


def annotation(path: Path, content: dict) -> Annotation:
    """Return the annotation of OPV2V's keys.

    Raises:
        DataError: a value is missing or wrong.
    """
    lidar = numbers(path, content, "lidar_pose", 6)
    body = numbers(path, content, "true_ego_pos", 6) if "true_ego_pos" in content else lidar
    speed = number(path, "ego_speed", content.get("ego_speed", 0.0)) / 3.6
    rows = [_vehicle(path, key, entry) for key, entry in vehicles_of(path, content).items()]
    ids = np.array([row[0] for row in rows], np.int64)
    center, angle_deg, extent = (np.array([row[k] for row in rows], np.float64).reshape(-1, 3) for k in (1, 2, 3))
    boxes = flattened(matrix_from_carla(np.concatenate([center, angle_deg], axis=1)), extent, ids)
    speeds = np.array([row[4] for row in rows], np.float64)
    velocity = speeds[:, None] * np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)
    order = np.argsort(ids, kind="stable")
    return Annotation(matrix_from_carla(lidar), matrix_from_carla(body), speed, boxes[order], velocity[order])


def vehicles_of(path: Path, content: dict) -> dict[int, dict]:
    """Return the table `vehicles` by object id; DataError where it is missing or a key is no id."""
    vehicles = content.get("vehicles")
    if vehicles is None and "vehicles" not in content:
        raise DataError(complaint(path, "vehicles", "a mapping of object id to box", "nothing"))
    vehicles = vehicles or {}
    if not isinstance(vehicles, dict):
        raise DataError(complaint(path, "vehicles", "a mapping of object id to box", type(vehicles).__name__))
    found = {}
    for key, entry in vehicles.items():
        # Tools that convert by way of JSON leave the ids as text.
        number = int(key) if isinstance(key, str) and re.fullmatch(r"-?\d{1,19}", key, re.ASCII) else key
        if not isinstance(number, int) or isinstance(number, bool) or abs(number) >= ID_LIMIT:
            raise DataError(complaint(path, "vehicles", "whole numbers as ids", key))
        if not isinstance(entry, dict):
            raise DataError(complaint(path, f"vehicles.{key}", "a mapping", type(entry).__name__))
        if number in found:
            raise DataError(complaint(path, "vehicles", "each id once", f"{number} twice"))
        found[number] = entry
    return found


def _vehicle(path: Path, key: int, entry: dict) -> tuple[int, list[float], list[float], list[float], float]:
    """Return (id, centre in CARLA's world, angle in deg, half extent, m/s or nan) of one entry of `vehicles`."""
    where = f"vehicles.{key}."
    location, center = numbers(path, entry, "location", 3, where), numbers(path, entry, "center", 3, where)
    angle, extent = numbers(path, entry, "angle", 3, where), numbers(path, entry, "extent", 3, where)
    middle = [a + b for a, b in zip(location, center, strict=True)]
    check_box(path, f"{where}extent", middle, [2.0 * half for half in extent], max(angle, key=abs))
    speed = number(path, f"{where}speed", entry["speed"]) / 3.6 if "speed" in entry else math.nan
    return key, middle, angle, extent, speed


def flattened(axes: NDArray[np.float64], extent: NDArray[np.float64], object_id: NDArray[np.int64]) -> Boxes:
    """Return upright boxes, of the class car, for tilted ones: with the mean edges of their corners seen from above.

    So does OpenCOOD.

    Args:
        axes: (N, 4, 4) poses of the boxes.
        extent: (N, 3) half length, width and height, m.
        object_id: (N,) ids.
    """
    along, across = (2.0 * extent[:, i, None] * axes[:, :2, i] for i in (0, 1))
    # Opposite edges of a box are equal, so its mean edges seen from above are its projected axes.
    size = np.stack([np.hypot(*along.T), np.hypot(*across.T), 2.0 * extent[:, 2] * np.abs(axes[:, 2, 2])], axis=1)
    yaw = np.arctan2(along[:, 1], along[:, 0])
    label = np.zeros(len(axes), np.int64)
    return Boxes(axes[:, :3, 3].copy(), size, wrap_angle(yaw), label, object_id)


def with_own_bodies(frame: Frame) -> Frame:
    """Return the frame with the agents' ids on their own boxes, those around their LiDARs seen from above.

    Datasets of the real world number agents apart from objects, and an agent's car is an object to the others. Roadside
    units, and agents whose id an object has already, are left as they are.
    """
    ids = frame.truth.object_id.copy()
    for agent in frame.agents:
        if agent.kind != "vehicle" or agent.agent_id in ids or len(ids) == 0:
            continue
        place = frame.truth.center.copy()
        place[:, :2] = agent.sweep.world_from_lidar[:2, 3]
        inside = frame.truth.contains(place)[np.arange(len(ids)), np.arange(len(ids))]
        away = np.linalg.norm(frame.truth.center[:, :2] - place[:, :2], axis=1)
        if inside.any():
            ids[np.argmin(np.where(inside, away, np.inf))] = agent.agent_id
    order = np.argsort(ids, kind="stable")
    return replace(
        frame,
        truth=replace(frame.truth, object_id=ids)[order],
        velocity=frame.velocity[order],
        points_on=frame.points_on[:, order],
        tilt=frame.tilt[order],
    )


FARTHEST_M = 1e8
"""Farthest place of anything, m: beyond the coordinates of any national grid."""
LARGEST_M = 1e4
"""Largest edge of a box, m."""
_LARGEST_ANGLE = 1e6


def check_box(path: Path, field: str, center: Sequence[float], size: Sequence[float], angle: float) -> None:
    """Check that a box can be one of the world.

    Args:
        field: its name in the file.
        center: its centre, m.
        size: its edges, m.
        angle: its largest angle, in any unit.

    Raises:
        DataError: an edge is not positive or absurdly long, or the box absurdly far away.
    """
    if min(size) <= 0.0 or max(size) > LARGEST_M:
        raise DataError(complaint(path, field, f"positive sizes up to {LARGEST_M:g} m", [float(x) for x in size]))
    if max(map(abs, center)) > FARTHEST_M or abs(angle) > _LARGEST_ANGLE:
        raise DataError(complaint(path, field, f"a place within {FARTHEST_M:g} m", [*map(float, center), float(angle)]))


def numbers(path: Path, content: dict, key: str, count: int, where: str = "") -> list[float]:
    """Return `count` finite numbers under a key; DataError names the file and the field."""
    value = content.get(key)
    if not isinstance(value, list) or len(value) != count:
        raise DataError(complaint(path, where + key, f"{count} numbers", value if value is not None else "nothing"))
    return [number(path, where + key, item) for item in value]


def number(path: Path, field: str, value: object) -> float:
    """Return a finite number, also of text (YAML reads `1e-3` as text); DataError names the file and the field."""
    try:
        number = float(value) if not isinstance(value, bool) else math.nan  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise DataError(complaint(path, field, "a finite number", value))
    return number
